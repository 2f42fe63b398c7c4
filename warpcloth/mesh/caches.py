"""Files of animations: the point caches .pc2 and .mdd, .npz files, and sequences of .obj and .ply files.

A point cache has no triangles; an .obj file of the same name beside it has them. .pc2 is little-endian: "POINTCACHE2", version
1, numbers of points, first frame, frames per sample, number of samples, float32 points. .mdd is big-endian: numbers of frames
and of points, float32 times [s], float32 points.

Functions that write take an open binary file.
"""

import os
import re
import struct
import zipfile
from pathlib import Path

import numpy as np

CACHES = (".pc2", ".mdd")
# Endings that are written as one file for each frame.
NUMBERED = (".obj", ".ply")
_PC2, _MDD = struct.Struct("<12siiffi"), struct.Struct(">ii")
_SIGNATURE = b"POINTCACHE2\0"
_DIGITS = 4  # of a frame number, at least


def open_pc2(path):
    """Opens a .pc2 file: frame numbers (F,) float64, and points (F, n, 3) float32 that are read when used; refuses broken
    files.
    """
    with open(path, "rb") as file:
        head = file.read(_PC2.size)
    if len(head) < _PC2.size or not head.startswith(_SIGNATURE):
        raise ValueError("is no .pc2 file, which must begin with POINTCACHE2")
    _name, version, count, first, spacing, frames = _PC2.unpack(head)
    if version != 1:
        raise ValueError(f"has version {version} of .pc2; it must be 1")
    if frames > 1 and not (np.isfinite(first) and np.isfinite(spacing) and spacing > 0.0):
        raise ValueError(f"has a frame each {spacing:g} from {first:g}; the first must be finite and the interval above 0")
    points = _mapped(path, "<f4", _PC2.size, frames, count)
    return first + spacing * np.arange(frames), points


def open_mdd(path):
    """Opens an .mdd file: times (F,) [s] float64, points (F, n, 3) float32 that are read when used; refuses broken files."""
    with open(path, "rb") as file:
        head = file.read(_MDD.size)
        if len(head) < _MDD.size:
            raise ValueError("is no .mdd file, which must begin with the numbers of frames and points")
        frames, count = _MDD.unpack(head)
        start = _MDD.size + 4 * max(frames, 0)
        points = _mapped(path, ">f4", start, frames, count)
        times = np.frombuffer(file.read(4 * frames), ">f4").astype(np.float64)
    return times, points


def _mapped(path, dtype, start, frames, count):
    if frames < 1 or count < 1:
        raise ValueError(f"has {frames} frames of {count} points; there must be one at least of each")
    expected, size = start + 12 * frames * count, os.path.getsize(path)
    if size != expected:
        raise ValueError(f"has {size} bytes; {frames} frames of {count} points must have {expected}")
    return np.memmap(path, dtype, "r", start, (frames, count, 3))


def write_pc2(file, frames, labels, count):
    """Writes a .pc2 file of ``count`` points (n, 3) [m] in each of the frames with evenly spaced labels (F,)."""
    spacing = float(labels[1] - labels[0]) if len(labels) > 1 else 1.0
    file.write(_PC2.pack(_SIGNATURE, 1, count, float(labels[0]), spacing, len(labels)))
    for points in frames:
        file.write(points.astype("<f4").tobytes())


def write_mdd(file, frames, times, count):
    """Writes an .mdd file with times (F,) [s], as :func:`write_pc2`."""
    file.write(_MDD.pack(len(times), count) + np.asarray(times, ">f4").tobytes())
    for points in frames:
        file.write(points.astype(">f4").tobytes())


def write_npz(file, frames, shape, dtype, arrays):
    """Writes an .npz file for :func:`warpcloth.open_sequence`: frames (n, 3) by name, to (F, n, 3) of a dtype, and other
    arrays.
    """
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False, "shape": tuple(shape)}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, rows in frames.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, header)
                for row in rows:
                    member.write(row.astype(dtype).tobytes())
        for name, array in arrays.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w") as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)


def write_obj(file, points, mesh, digits=17):
    """Writes an .obj file: points (n, 3) [m] in order, texture coordinates, and a group for each part.

    9 ``digits`` keep all bits of float32, 17 those of float64.
    """
    coordinates = mesh.texture_coordinates
    corner = "%d" if coordinates is None else "%d/%d"
    parts = [(name, part.first) for name, part in (mesh.parts or {}).items()]
    owner = np.searchsorted([first for _, first in parts], mesh.triangles[:, 0], side="right") - 1
    np.savetxt(file, points, fmt="v" + 3 * f" %.{digits}g")
    if coordinates is not None:
        np.savetxt(file, coordinates.reshape(-1, 2), fmt="vt %.9g %.9g")
        textured = mesh.triangles if coordinates.ndim == 2 else np.arange(mesh.triangles.size).reshape(-1, 3)
    for k, name in enumerate([name for name, _ in parts] or [None]):
        if name is not None:
            file.write(f"g {'_'.join(name.split())}\n".encode())
        faces = mesh.triangles if coordinates is None else np.stack([mesh.triangles, textured], axis=2).reshape(-1, 6)
        np.savetxt(file, 1 + (faces if name is None else faces[owner == k]), fmt=f"f {corner} {corner} {corner}")


def write_ply(file, points, mesh):
    """Writes a binary .ply file: float32 points (n, 3) [m] and the triangles of a mesh."""
    import trimesh
    from trimesh.exchange.ply import export_ply

    shape = trimesh.Trimesh(points, mesh.triangles, process=False, validate=False)
    file.write(export_ply(shape, encoding="binary", vertex_normal=False))


def numbered_paths(path, labels):
    """Returns the path of each frame: its number, of four digits or more, is added to the name.

    In cloth.####.obj it replaces the signs, with at least as many digits. Negative or fractional labels are numbered from 0.

    Raises:
        ValueError: The name has # or a digit after these signs, or a file with another number exists.
    """
    path, numbers = Path(path), np.asarray(labels)
    if numbers.dtype.kind != "i" or numbers.min() < 0:
        numbers = np.arange(len(numbers))
    before, signs, after = re.fullmatch(r"([^#]*)(#*)(.*)", path.stem).groups()
    if re.search(r"[#\d]", after):
        raise ValueError(f"{path}: has # or a digit after {signs}; the last number of a name must be that of the frame")
    if not signs:
        before, after = f"{path.stem}_", ""
    width = max(len(signs) or _DIGITS, len(str(numbers.max())))
    paths = [path.with_name(f"{before}{number:0{width}}{after}{path.suffix}") for number in numbers.tolist()]
    kept = {each.name for each in paths}
    if path.parent.is_dir():
        pattern = re.compile(rf"{re.escape(before)}\d+{re.escape(after + path.suffix)}")
        for other in sorted(os.listdir(path.parent)):
            if pattern.fullmatch(other) and other not in kept:
                raise ValueError(f"{path.parent / other}: is a frame of another sequence; remove it, or give another name")
    return paths
