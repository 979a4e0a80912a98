"""A cloud → a cloud-optimised point cloud (COPC): LAZ whose chunks are the nodes of an octree [1]_.

Clouds larger than memory are first divided into cubes on the disk, see `octree`.

References
----------
.. [1] COPC specification 1.0, https://copc.io, 2021.
"""

import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import LasZipVlr
from numpy.typing import NDArray

from colmap_sph.products.clouds.las_points import Extent, las_header, las_points
from colmap_sph.products.clouds.octree import CELLS, CELLS_LOG2, cells_of, levels_of
from colmap_sph.products.clouds.source import Cloud
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.publishing import published, scratch_beside

Node = tuple[int, int, int, int]
"""Level, and place along each axis."""

# What is worked on at a time, about 300 bytes each.
_POINTS_IN_MEMORY = 1 << 20
# A surface, not a volume: half the size, a quarter of the points.
_CUBES_A_LEVEL = 4
# User, number and description of the records.
_USER = "copc"
_INFO = 1
_HIERARCHY = 1000
_INFO_FORMAT = "<5d2Q2d11Q"
_EVLR_HEADER = "<H16sHQ32s"
_ENTRY = "<iiiiQii"


@dataclass(frozen=True, eq=False)
class _Root:
    """The root node: its middle, half its side, and how coordinates in points become places in it."""

    center: NDArray[np.float64]
    half: float
    header: laspy.LasHeader

    def places(self, points: NDArray[np.void]) -> NDArray[np.float64]:
        """(n, 3) from 0 to 1."""
        xyz = np.column_stack([points[name] for name in "XYZ"]) * self.header.scales + self.header.offsets
        return np.asarray((xyz - self.center + self.half) / (2 * self.half))

    def info(self, offset: int, size: int) -> bytes:
        """The record that a file begins with, with the place of its hierarchy."""
        spacing = 2 * self.half / CELLS
        return struct.pack(_INFO_FORMAT, *self.center, self.half, spacing, offset, size, 0, 0, *[0] * 11)


def write_copc(
    cloud: Cloud, extent: Extent, georeference: Georeference, path: Path, *, scale: float | None = None
) -> None:
    """Write a cloud as COPC; for parameters and errors see `las.write_las`."""
    header = las_header(cloud, extent, georeference, scale)
    middle = (extent.low + extent.high) / 2
    # Rounding moves points by half a step of their coordinates.
    half = float((extent.high - extent.low).max()) / 2 * (1 + 1e-9) + 2 * float(header.scales[0])
    root = _Root(middle, half, header)
    with published(path) as temporary, scratch_beside(temporary) as scratch, temporary.open("x+b") as file:
        try:
            cubes = _divided(cloud, extent, georeference, root, scratch)
            writer = _Writer(file, root)
            for cube in cubes:
                for node, points in _nodes_of(cube, root):
                    if node[0] >= cube.level:
                        writer.write(node, points)
                    else:
                        _append(scratch / _name(node), points)
                        writer.later.add(node)
            for node in sorted(writer.later):
                writer.write(node, np.fromfile(scratch / _name(node), header.point_format.dtype()))
                (scratch / _name(node)).unlink()
            writer.finish()
        except lazrs.LazrsError as error:
            raise OSError(str(error)) from error


def _name(node: Node) -> str:
    return "-".join(map(str, node))


# ---- cubes on the disk --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Cube:
    """A node of the octree with all its points, in a file, and how many these are."""

    path: Path
    level: int
    count: int


def _divided(
    cloud: Cloud, extent: Extent, georeference: Georeference, root: _Root, scratch: Path
) -> Iterator[_Cube]:
    """Divide a cloud into cubes that fit memory, as far as the octree's cells allow."""
    level = 0
    while level < CELLS_LOG2 and extent.count > _POINTS_IN_MEMORY * _CUBES_A_LEVEL**level:
        level += 1
    pieces = (las_points(piece, root.header, georeference).array for piece in cloud.measured_pieces())
    waiting = _distributed(pieces, level, root, scratch)
    while waiting:
        cube = waiting.pop()
        if cube.count > _POINTS_IN_MEMORY and cube.level < CELLS_LOG2:
            blocks = _blocks(cube.path, root.header.point_format.dtype())
            waiting += _distributed(blocks, cube.level + 1, root, scratch)
        else:
            yield cube
        cube.path.unlink()


def _distributed(pieces: Iterator[NDArray[np.void]], level: int, root: _Root, scratch: Path) -> list[_Cube]:
    """Put points into the files of the nodes of a level."""
    counts: dict[int, int] = defaultdict(int)
    for points in pieces:
        cells = cells_of(root.places(points), level)
        numbers = (cells[:, 0] << (2 * level)) | (cells[:, 1] << level) | cells[:, 2]
        for number, rows in _groups(numbers):
            _append(scratch / f"cube-{level}-{number}", points[rows])
            counts[number] += len(rows)
    return [_Cube(scratch / f"cube-{level}-{number}", level, counts[number]) for number in sorted(counts)]


def _groups(numbers: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Each number that occurs, and where."""
    order = np.argsort(numbers, kind="stable")
    values, starts = np.unique(numbers[order], return_index=True)
    yield from zip(values.tolist(), np.split(order, starts[1:]), strict=True)


def _append(path: Path, points: NDArray[np.void]) -> None:
    with path.open("ab") as file:
        file.write(points.tobytes())


def _blocks(path: Path, kind: np.dtype[np.void]) -> Iterator[NDArray[np.void]]:
    with path.open("rb") as file:
        while len(points := np.fromfile(file, kind, _POINTS_IN_MEMORY // 4)):
            yield points


def _nodes_of(cube: _Cube, root: _Root) -> Iterator[tuple[Node, NDArray[np.void]]]:
    """Nodes that have points of a cube, with these."""
    points = np.fromfile(cube.path, root.header.point_format.dtype())
    places = root.places(points)
    levels = levels_of(places, cube.level)
    for level, of_level in _groups(levels.astype(np.int64)):
        cells = cells_of(places[of_level], level)
        for _, rows in _groups((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]):
            x, y, z = cells[rows[0]].tolist()
            yield (level, x, y, z), points[of_level[rows]]


# ---- the file -----------------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Writer:
    """A COPC file: node after node, then the hierarchy, and at last what its head must know of both."""

    file: BinaryIO
    root: _Root
    nodes: list[tuple[Node, int]] = field(default_factory=list)
    later: set[Node] = field(default_factory=set)

    def __post_init__(self) -> None:
        header = self.root.header
        extra_bytes = header.point_format.num_extra_bytes
        self._vlr = lazrs.LazVlr.new_for_compression(header.point_format.id, extra_bytes, True)
        header.are_points_compressed = True
        header.vlrs.insert(0, laspy.VLR(_USER, _INFO, "COPC info", self.root.info(0, 0)))
        header.vlrs.insert(1, LasZipVlr(self._vlr.record_data()))
        header.partial_reset()
        header.write_to(self.file)
        self._start = self.file.tell()
        self._compressor = lazrs.LasZipCompressor(self.file, self._vlr)

    def write(self, node: Node, points: NDArray[np.void]) -> None:
        """Add a node with all its points."""
        record = laspy.PackedPointRecord(points, self.root.header.point_format)
        self.root.header.grow(record)
        if self.nodes:  # the last chunk ends with the file
            self._compressor.finish_current_chunk()
        self._compressor.compress_many(np.frombuffer(points.tobytes(), np.uint8))
        self.nodes.append((node, len(points)))

    def finish(self) -> None:
        """Write the hierarchy, and the head again."""
        header = self.root.header
        self._compressor.done()
        self.file.seek(self._start)
        chunks = lazrs.read_chunk_table(self.file, self._vlr)
        entries = b"".join(self._entries([number for _, number in chunks]))
        self.file.seek(0, 2)
        header.start_of_first_evlr = self.file.tell()
        header.number_of_evlrs = 1
        title = struct.pack(_EVLR_HEADER, 0, _USER.encode(), _HIERARCHY, len(entries), b"EPT hierarchy")
        self.file.write(title + entries)
        header.vlrs[0] = laspy.VLR(
            _USER, _INFO, "COPC info", self.root.info(header.start_of_first_evlr + len(title), len(entries))
        )
        self.file.seek(0)
        header.write_to(self.file, ensure_same_size=True)

    def _entries(self, sizes: list[int]) -> Iterator[bytes]:
        place = self._start + 8  # behind the place of the table of chunks
        for (node, count), size in zip(self.nodes, sizes, strict=True):
            yield struct.pack(_ENTRY, *node, place, size, count)
            place += size
