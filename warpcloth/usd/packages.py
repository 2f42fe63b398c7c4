"""Packages, .usdz: one file of a layer and of what it shows, with nothing else of the machine in it."""

import glob
import os
import warnings
import zipfile
from itertools import chain

from pxr import Ar, Sdf, UsdUtils

_TILES = "<UDIM>"


class Contents:
    """The files that a layer refers to, and what they are called in a package.

    A stage can name any file of the machine, and who packs it need not know: only what lies in the folders of its layers, or
    below them, is packed. `UsdUtils.CreateNewUsdzPackage` would pack all.
    """

    def __init__(self, folder):
        """Starts with nothing.

        Args:
            folder: A folder for files that come out of packages.
        """
        self._folder, self._names = folder, {}

    def named(self, path, stage):
        """The path of a file in the package; or, with a warning, as it was where it is not packed, and "" of none.

        Args:
            path: As a flattened layer has it.
            stage: The stage that was flattened.
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
        """The files that a path stands for: one, or the tiles of a texture, or none; and these or the package of one."""
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
                return [archive.extract(member, os.path.join(self._folder, "unpacked"))], [package]
        except (OSError, KeyError, zipfile.BadZipFile):  # of a package in a package
            return [], []

    def write(self, layer, package, meant):
        """Writes a package of a layer's file and all that was named.

        Args:
            layer: The file.
            package: The file to write.
            meant: The path that it is for, for the error.

        Raises:
            OSError: It could not be written.
        """
        writer = Sdf.ZipFileWriter.CreateNew(str(package))
        for file, name in {str(layer): os.path.basename(layer), **self._names}.items():
            writer.AddFile(file, name)
        if not (writer.Save() and _is_whole(package)):
            raise OSError(f"{meant}: could not be written")


def _folders(stage):
    """Real paths of the folders that the layers of a stage lie in."""
    return {os.path.dirname(os.path.realpath(layer.realPath)) for layer in stage.GetUsedLayers() if layer.realPath}


def _is_below(file, folders):
    real = os.path.realpath(file)
    return any(os.path.commonpath([real, folder]) == folder for folder in folders)


def _as_authored(path, stage):
    """The path as a layer of a stage has it: flattening makes it absolute."""
    for layer in stage.GetUsedLayers():
        if layer.realPath:
            for authored in chain(*UsdUtils.ExtractExternalReferences(layer.realPath)):
                if layer.ComputeAbsolutePath(authored) == path:
                    return authored
    return path


def _is_whole(package):
    """Whether all of a package is on the disk: pxr does not notice one that is full."""
    try:
        with zipfile.ZipFile(package) as archive:
            return archive.testzip() is None
    except zipfile.BadZipFile:
        return False
