"""PLY files, text or binary, little- or big-endian → vertices and triangles.

Nothing is taken for granted: counts are held against what is left of the file before anything is allocated, and
every number must be one. (trimesh 5.2 takes words that are no numbers for the end of a line, refuses meshes of
triangles and quads together, and lets faces refer to vertices that are not there.)
"""

from __future__ import annotations

import io
import os
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from colmap_sph.evaluation.neighbours import Points
from colmap_sph.evaluation.polygons import Faces, Polygons

_HEADER_BYTES = 1 << 20
_START = re.compile(rb"ply\s*\n")
_END = re.compile(rb"\nend_header[ \t]*\r?\n")
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_KINDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_KINDS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_KINDS |= {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
# Looked at for something that is no white space, behind the last element.
_SPACE_BYTES = 64
_CORNERS = ("vertex_indices", "vertex_index")


class DamagedError(ValueError):
    """A file that is not what it says; the text is the reason, for the brackets of a sentence."""


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: np.dtype[np.generic]
    count: np.dtype[np.generic] | None
    """Type of the length of a list; None: a single number."""


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(each.count is not None for each in self.properties)

    @property
    def row_bytes(self) -> int:
        """Bytes of a row, at least."""
        return sum((each.count or each.dtype).itemsize for each in self.properties)

    def place(self, names: Sequence[str], *, in_list: bool) -> int:
        """Which of the properties has one of these names."""
        for index, each in enumerate(self.properties):
            if each.name in names and (each.count is not None) == in_list:
                return index
        raise DamagedError(f"the element {self.name} has no {'list' if in_list else 'number'} {names[0]}")


def read_ply(path: Path) -> tuple[Points, Faces]:
    """Read a cloud or a mesh.

    Parameters
    ----------
    path : Path
        A regular file.

    Returns
    -------
    points : (N, 3) float64 ndarray
    faces : (F, 3) int64 ndarray
        Rows of `points`, as the file says; polygons are cut into triangles. F = 0 for a cloud.

    Raises
    ------
    DamagedError, ValueError, OverflowError
        The file is not a whole PLY file with vertices; the text says why.
    """
    with path.open("rb") as file:
        elements, style = _read_header(file)
        reader = _TextRows(file) if style == "ascii" else _BinaryRows(file, _ORDERS[style])
        points: Points | None = None
        polygons = Polygons()
        for element in elements:
            if element.name == "vertex":
                points = reader.points(element)
            elif element.name == "face" and element.count:
                polygons = reader.polygons(element, element.place(_CORNERS, in_list=True))
            elif element.name == "tristrips" and element.count:
                raise DamagedError("its triangles are strips: write them as faces")
            else:
                reader.polygons(element, None)
        if reader.has_more():
            raise DamagedError("it goes on behind what its header counts")
    if points is None:
        raise DamagedError("it has no element vertex")
    return points, polygons.triangles()


def _read_header(file: BinaryIO) -> tuple[list[_Element], str]:
    """Read up to the line end_header; the file is left behind it."""
    start = file.read(_HEADER_BYTES)
    end = _END.search(start)
    if not _START.match(start) or end is None:
        raise DamagedError("its header has no end" if _START.match(start) else "it has no PLY header")
    file.seek(end.end())
    words = start[: end.start()].decode("utf-8", errors="replace")
    lines = [line.split() for line in words.splitlines()[1:]]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    if not lines or len(lines[0]) < 2 or lines[0][0] != "format" or lines[0][1] not in _ORDERS:
        raise DamagedError("its header does not begin with a known format")
    style = lines[0][1]
    elements: list[_Element] = []
    for line in lines[1:]:
        if line[0] == "element" and len(line) == 3 and line[2].isascii() and line[2].isdigit():
            elements.append(_Element(line[1], int(line[2][:19])))
        elif line[0] == "property" and elements:
            elements[-1].properties.append(_property_of(line, _ORDERS[style]))
        else:
            raise DamagedError(f"its header has the line {' '.join(line)[:60]!r}")
    for names in ([e.name for e in elements], *([p.name for p in e.properties] for e in elements)):
        if len(set(names)) < len(names):
            raise DamagedError("its header has a name twice")
    if not all(element.properties or not element.count for element in elements):
        raise DamagedError("its header has an element without properties")
    return elements, style


def _property_of(line: list[str], order: str) -> _Property:
    *kinds, name = line[1:] or [""]
    counts = None
    if kinds[:1] == ["list"]:
        counts = _KINDS.get(kinds[1]) if len(kinds) == 3 else None
        kinds = kinds[2:] if counts in ("i1", "u1", "i2", "u2", "i4", "u4") else []
    if len(kinds) != 1 or kinds[0] not in _KINDS:
        raise DamagedError(f"its header has the line {' '.join(line)[:60]!r}")
    return _Property(
        name, np.dtype(order + _KINDS[kinds[0]]), None if counts is None else np.dtype(order + counts)
    )


class _BinaryRows:
    """Rows of elements, one after the other, from where a binary file is."""

    def __init__(self, file: BinaryIO, order: str) -> None:
        self._file = file
        self._order = order or "="
        self._left = os.fstat(file.fileno()).st_size - file.tell()

    def points(self, element: _Element) -> Points:
        """Coordinates of the next rows."""
        if element.has_lists:
            raise DamagedError("its vertices have lists of numbers: write x, y and z alone")
        offsets = np.cumsum([0, *(each.dtype.itemsize for each in element.properties)])
        places = [element.place([axis], in_list=False) for axis in "xyz"]
        row = np.dtype(
            {
                "names": ["x", "y", "z"],
                "formats": [element.properties[place].dtype for place in places],
                "offsets": [int(offsets[place]) for place in places],
                "itemsize": int(offsets[-1]),
            }
        )
        rows = np.frombuffer(self._take(element.count * row.itemsize), row)
        return np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)

    def polygons(self, element: _Element, place: int | None) -> Polygons:
        """Lists of property `place` of the next rows; None: pass over them."""
        if not element.has_lists:
            self._take(element.count * element.row_bytes)
            return Polygons()
        if element.count * element.row_bytes > self._left:
            raise DamagedError("it is cut off")
        data = self._file.read(self._left)
        polygons, length = self._uniform(element, place, data) or self._mixed(element, place, data)
        self._left -= length
        self._file.seek(length - len(data), io.SEEK_CUR)
        return polygons

    def has_more(self) -> bool:
        """Whether anything but the end of a line follows."""
        return bool(self._file.read(_SPACE_BYTES).strip())

    def _take(self, count: int) -> bytes:
        if count > self._left:
            raise DamagedError("it is cut off")
        self._left -= count
        data = self._file.read(count)
        if len(data) < count:
            raise DamagedError("it is cut off")
        return data

    def _uniform(self, element: _Element, place: int | None, data: bytes) -> tuple[Polygons, int] | None:
        """All at once, where the lists of all rows are as long as that of the first; else None."""
        lists = [index for index, each in enumerate(element.properties) if each.count is not None]
        if len(lists) > 1 or not element.count:
            return None
        before = sum(each.dtype.itemsize for each in element.properties[: lists[0]])
        counts = element.properties[lists[0]].count
        assert counts is not None
        length = int(np.frombuffer(data, counts, 1, before)[0])
        fields: list[tuple[str, object]] = []
        for index, each in enumerate(element.properties):
            if index in lists:
                fields += [("length", counts), ("list", (each.dtype, (length,)))] if length >= 0 else []
            else:
                fields.append((f"f{index}", each.dtype))
        row_bytes = element.row_bytes + max(length, 0) * element.properties[lists[0]].dtype.itemsize
        if length < 0 or element.count * row_bytes > len(data):
            return None
        rows = np.frombuffer(data, np.dtype(fields), element.count)
        if not (rows["length"] == length).all():
            return None
        polygons = Polygons()
        if place is not None:
            polygons.add(rows["list"])
        return polygons, element.count * row_bytes

    def _mixed(self, element: _Element, place: int | None, data: bytes) -> tuple[Polygons, int]:
        """Row by row."""
        steps = [
            (each.dtype.itemsize, None if each.count is None else struct.Struct(self._order + each.count.char))
            for each in element.properties
        ]
        offset = 0
        starts: list[tuple[int, int]] = []
        for _ in range(element.count):
            for index, (size, counts) in enumerate(steps):
                length = 1
                if counts is not None:
                    if offset + counts.size > len(data):
                        raise DamagedError("it is cut off")
                    (length,) = counts.unpack_from(data, offset)
                    offset += counts.size
                    if index == place:
                        starts.append((length, offset))
                if length < 0:
                    raise DamagedError("a list has a negative length")
                offset += length * size
            if offset > len(data):
                raise DamagedError("it is cut off")
        return Polygons() if place is None else _gathered(starts, element.properties[place].dtype, data), offset


def _gathered(starts: list[tuple[int, int]], dtype: np.dtype[np.generic], data: bytes) -> Polygons:
    """Lists that lie scattered in `data`, given by length and offset."""
    polygons = Polygons()
    table = np.array(starts, np.int64).reshape(-1, 2)
    raw = np.frombuffer(data, np.uint8)
    for length in np.unique(table[:, 0]):
        offsets = table[table[:, 0] == length, 1]
        parts = raw[offsets[:, None] + np.arange(length * dtype.itemsize)]
        polygons.add(parts.view(dtype).reshape(len(offsets), length))
    return polygons


class _TextRows:
    """Rows of elements, one after the other, from where a text file is: one on a line."""

    def __init__(self, file: BinaryIO) -> None:
        self._lines = filter(None, map(bytes.strip, file.read().split(b"\n")))

    def points(self, element: _Element) -> Points:
        """As `_BinaryRows.points`."""
        if element.has_lists:
            raise DamagedError("its vertices have lists of numbers: write x, y and z alone")
        places = [element.place([axis], in_list=False) for axis in "xyz"]
        lines = list(self._next(element.count))
        if not lines:
            return np.empty((0, 3))
        table = np.loadtxt(lines, np.float64, comments=None, ndmin=2)
        if table.shape[1] != len(element.properties):
            raise DamagedError(f"its vertices have {table.shape[1]} numbers, not {len(element.properties)}")
        return np.ascontiguousarray(table[:, places])

    def polygons(self, element: _Element, place: int | None) -> Polygons:
        """As `_BinaryRows.polygons`."""
        polygons = Polygons()
        for line in self._next(element.count):
            words = line.split()
            position = 0
            for index, each in enumerate(element.properties):
                length = 1
                if each.count is not None:
                    length = int(words[position]) if position < len(words) else -1
                    position += 1
                if length < 0 or position + length > len(words):
                    raise DamagedError(f"an element {element.name} has the line {line[:60]!r}")
                if index == place:
                    polygons.add_one(words[position : position + length])
                position += length
        return polygons

    def has_more(self) -> bool:
        """As `_BinaryRows.has_more`."""
        return next(self._lines, None) is not None

    def _next(self, count: int) -> Iterator[bytes]:
        found = 0
        while found < count:
            line = next(self._lines, None)
            if line is None:
                raise DamagedError("it is cut off")
            found += 1
            yield line
