"""Writes fields of many rows as arrays of an NPZ file."""

import math
import shutil
import tempfile
import zipfile

import numpy as np

from ..base.outputs import Output


class NpzWriter(Output):
    """Writes fields of all rows, (rows, E, *shape), and ``frames``, ``references`` (NaN: rest) and ``times`` [s], (rows,)
    float64.

    Memory holds one row. Fields go to files beside the output, which `close` copies into one.

    Attributes:
        rows: Number of rows appended.
    """

    def __init__(self, path, rows, fields):
        """Starts the files for at most ``rows`` rows of fields, (shape of a row, dtype) by name; raises ValueError for a
        reserved name.
        """
        self._heads = {name: np.empty(rows) for name in ("frames", "references", "times")}
        self._fields = {name: (tuple(shape), np.dtype(dtype)) for name, (shape, dtype) in fields.items()}
        taken = sorted(self._heads.keys() & self._fields.keys())
        if taken:
            raise ValueError(f"field {taken[0]}: the name is taken by the {taken[0]} of the rows; it must be another")
        self.rows, self._promised = 0, rows
        super().__init__(path, "xb")
        self._parts = {name: tempfile.TemporaryFile(dir=self.folder) for name in self._fields}

    def append(self, frame, reference, time, values):
        """Adds a row: labels of the frame and its reference (None: rest), time [s], and fields (E, *shape) by name."""
        if self.rows == self._promised:
            raise ValueError(f"{self.path}: {self._promised} rows were promised, and this is one more")
        arrays = {name: np.asarray(values[name]) for name in self._fields}
        for name, (shape, dtype) in self._fields.items():
            found = arrays[name]
            if (found.shape, found.dtype) != (shape, dtype):
                raise ValueError(f"field {name} has shape {found.shape} and dtype {found.dtype}; it must be {shape}, {dtype}")
        for name, array in arrays.items():
            self._parts[name].write(array.tobytes())
        for name, head in zip(self._heads, (frame, np.nan if reference is None else reference, time), strict=True):
            self._heads[name][self.rows] = head
        self.rows += 1  # last, so that an interrupted row does not count

    def parts(self):
        return self._parts.values()

    def finish(self):
        with zipfile.ZipFile(self.file, "w", zipfile.ZIP_STORED) as archive:
            for name, head in self._heads.items():
                with _member(archive, name) as member:
                    np.lib.format.write_array(member, head[: self.rows])
            for name, (shape, dtype) in self._fields.items():
                with _member(archive, name) as member, self._parts[name] as part:  # closing a part frees its disk space
                    _copy(part, member, (self.rows, *shape), dtype)


def _copy(part, member, shape, dtype):
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(member, header)
    part.truncate(math.prod(shape) * dtype.itemsize)
    part.seek(0)
    shutil.copyfileobj(part, member, 1 << 16)


def _member(archive, name):
    """Opens a member of an archive, above 4 GiB too, without a date, so equal arrays give equal files."""
    info = zipfile.ZipInfo(f"{name}.npy")
    return archive.open(info, "w", force_zip64=True)
