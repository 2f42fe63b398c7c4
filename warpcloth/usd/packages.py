"""Writes packages (.usdz): one file with a layer and the files to which it refers."""

import glob
import os
import warnings
import zipfile
from itertools import chain

from .modules import Ar, Sdf, UsdUtils

_TILES = "<UDIM>"


class Contents:
    """The files to which a layer refers, with their names in a package.

    Only files in or below the folders of the stage's layers are packed, as a stage can refer to any file of the machine.
    """

    def __init__(self, folder):
        """Starts empty, with a folder for files extracted from packages."""
        self._folder, self._names = folder, {}

    def named(self, path, stage):
        """Returns the path in the package of a file of the flattened ``stage``.

        A file outside keeps its path, a missing one gets "", both with a warning.
        """
        files, origins = self._files(path)
        if not files:
            warnings.warn(f"{path}: there is no such file, the package is made without it", stacklevel=2)
            return ""
        if not all(_is_below(file, _folders(stage)) for file in origins):
            authored = _as_authored(path, stage)
            warnings.warn(f"{authored}: lies outside the folders of the stage, the package is made without it", stacklevel=2)
            return authored
        number = len({os.path.dirname(name) for name in self._names.values()})
        for file in files:
            if file.endswith((".usd", ".usda", ".usdc")) and any(UsdUtils.ExtractExternalReferences(file)):
                warnings.warn(f"{file}: refers to more files, which are not packed", stacklevel=2)
            self._names.setdefault(file, f"{number}/{os.path.basename(file)}")
        return f"{os.path.dirname(self._names[files[0]])}/{os.path.basename(path.removesuffix(']'))}"

    def _files(self, path):
        if _TILES in path:
            head, tail = map(glob.escape, path.split(_TILES, 1))
            files = sorted(glob.glob(f"{head}[0-9][0-9][0-9][0-9]{tail}"))
            return files, files
        found = str(Ar.GetResolver().Resolve(path))
        if not Ar.IsPackageRelativePath(found):
            files = [found] if os.path.isfile(found) else []
            return files, files
        package, member = Ar.SplitPackageRelativePathOuter(found)
        try:
            with zipfile.ZipFile(package) as archive:
                return [archive.extract(member, self._folder)], [package]
        except (OSError, KeyError, zipfile.BadZipFile):  # a package in a package
            return [], []

    def write(self, layer, package, meant):
        """Writes a package, ``meant`` for a path, of a layer's file and all files of :meth:`named`; raises OSError."""
        writer = Sdf.ZipFileWriter.CreateNew(str(package))
        for file, name in {str(layer): os.path.basename(layer), **self._names}.items():
            writer.AddFile(file, name)
        if not (writer.Save() and _is_whole(package)):
            raise OSError(f"{meant}: could not be written")


def _folders(stage):
    return {os.path.dirname(os.path.realpath(layer.realPath)) for layer in stage.GetUsedLayers() if layer.realPath}


def _is_below(file, folders):
    real = os.path.realpath(file)
    return any(os.path.commonpath([real, folder]) == folder for folder in folders)


def _as_authored(path, stage):
    """Returns the path as authored; flattening makes it absolute."""
    for layer in stage.GetUsedLayers():
        if layer.realPath:
            for authored in chain(*UsdUtils.ExtractExternalReferences(layer.realPath)):
                if layer.ComputeAbsolutePath(authored) == path:
                    return authored
    return path


def _is_whole(package):
    """Returns whether the package is complete; pxr does not notice a full disk."""
    try:
        with zipfile.ZipFile(package) as archive:
            return archive.testzip() is None
    except zipfile.BadZipFile:
        return False
