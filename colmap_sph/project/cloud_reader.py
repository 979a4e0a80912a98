"""A cloud on disk → some of its points with their colours, however many it has."""

import os
import re
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, counted, reason_of
from colmap_sph.project.cloud_tiles import TileIndex
from colmap_sph.project.files import open_regular
from colmap_sph.project.map_coordinates import is_plausible

# As of other clouds and meshes (`evaluation/ply_files.py`): scanners' programs write long comments.
_HEADER_BYTES = 1 << 20
_END = re.compile(rb"\nend_header[ \t]*\r?\n")
_KINDS = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4",
    "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float": "<f4", "double": "<f8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_COLOURS = ("red", "green", "blue")
# What is read of a large cloud: so many pieces, evenly spread, of so many bytes.
_PIECES = 4096
_PIECE_BYTES = 1 << 18


@dataclass(frozen=True)
class PlyLayout:
    """Type of a point, the number of points, and where in the file the first begins."""

    kind: np.dtype[Any]
    count: int
    begin: int


def read_some_points(path: Path, most: int) -> tuple[NDArray[np.float64], NDArray[np.uint8], int]:
    """Read points of a cloud, evenly spread over its file.

    Parameters
    ----------
    path : Path
        A binary little-endian PLY file whose first element is the vertices, without lists: what COLMAP's fusion
        and ours write.
    most : int
        Points to read at most, about.

    Returns
    -------
    xyz : (n, 3) float64 ndarray
        Points that are finite and not absurdly far.
    rgb : (n, 3) uint8 ndarray
        Their colours; grey where the cloud has none.
    count : int
        Points of the whole cloud.

    Raises
    ------
    InputError
        The file is missing, cannot be read, or is no such cloud.
    """
    try:
        with open_regular(path) as file:
            layout = read_layout(path, file)
            points = _read_pieces(file, layout, most)
    except OSError as error:
        raise InputError(f"The cloud {path} cannot be read ({reason_of(error)}); fuse again.") from error
    return *points_of(points), layout.count


def read_some_of_tiles(
    folder: Path, index: TileIndex, most: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8], int]:
    """Do what `read_some_points` does for a cloud in tiles: of each as many points as it has of all."""
    share = min(most / max(index.points, 1), 1.0)
    some = [
        read_some_points(folder / tile.file, max(round(share * tile.points), 1))
        for tile in index.tiles
        if tile.points
    ]
    if not some:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8), 0
    xyz, rgb, counts = zip(*some, strict=True)
    return np.concatenate(xyz), np.concatenate(rgb), sum(counts)


def points_of(points: NDArray[np.void]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """(n, 3) places and (n, 3) colours of a file's points, less those that are not finite or absurdly far."""
    kind = points.dtype
    xyz = np.column_stack([points[name].astype(np.float64) for name in "xyz"])
    rgb = np.full(xyz.shape, 128, np.uint8)
    if all(name in (kind.names or ()) and kind[name] == np.uint8 for name in _COLOURS):
        rgb = np.column_stack([points[name] for name in _COLOURS])
    likely = is_plausible(xyz)
    return (xyz, rgb) if likely.all() else (xyz[likely], rgb[likely])


def read_layout(path: Path, file: BufferedReader) -> PlyLayout:
    """Read how a cloud lies in a file, and check it against the file's size; raises as `read_some_points`."""
    start = file.read(_HEADER_BYTES)
    end = _END.search(start)
    header = start[: end.start()].decode("ascii", "replace").splitlines() if end else []
    lines = [line.split() for line in header if line.strip() and not line.startswith(("comment", "obj_info"))]
    if lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]] or end is None:
        raise InputError(f"{path} is no binary little-endian PLY file; write it as one, or fuse again.")
    names: list[str] = []
    kinds: list[str] = []
    for words in lines[3:]:
        if words[0] != "property":
            break
        if len(words) != 3 or words[1] not in _KINDS:
            raise InputError(f"The points of {path} are in no known format; fuse again.")
        names.append(words[2])
        kinds.append(_KINDS[words[1]])
    element = lines[2] if len(lines) > 2 else []
    if len(element) != 3 or element[:2] != ["element", "vertex"] or not element[2].isdecimal():
        raise InputError(f"{path} does not begin with points; fuse again.")
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise InputError(f"The points of {path} are in no known format; fuse again.")
    kind = np.dtype(list(zip(names, kinds, strict=True)))
    count = int(element[2][:15])
    length = os.fstat(file.fileno()).st_size - end.end() - count * kind.itemsize
    if length < 0:
        raise InputError(f"{path} is cut off; fuse again.")
    if length > 0 and [words[0] for words in lines].count("element") == 1:
        raise InputError(
            f"{path} goes on behind the {counted(count, 'point')} that its header counts; fuse again."
        )
    return PlyLayout(kind, count, end.end())


def _read_pieces(file: BufferedReader, layout: PlyLayout, most: int) -> NDArray[np.void]:
    """Points of evenly spread pieces of the file, all of it where it is small."""
    kind = layout.kind
    count = layout.count
    begin = layout.begin
    length = max(_PIECE_BYTES // kind.itemsize, 1)
    pieces = min(-(-count // length), _PIECES)
    is_whole = pieces * length >= count
    starts = np.arange(pieces) * length if is_whole else np.linspace(0, count - length, pieces).astype(np.int64)
    step = max(-(-min(count, pieces * length) // most), 1)
    parts: list[NDArray[np.void]] = []
    for first in starts:
        file.seek(begin + int(first) * kind.itemsize)
        data = file.read(min(length, count - int(first)) * kind.itemsize)
        points = np.frombuffer(data[: len(data) // kind.itemsize * kind.itemsize], kind)
        # Where to begin differs from piece to piece: images are written row by row. A view would keep all of it.
        parts.append(points[len(parts) % step :: step].copy())
    return np.concatenate(parts) if parts else np.empty(0, kind)
