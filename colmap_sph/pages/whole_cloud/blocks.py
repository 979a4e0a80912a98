"""A cloud's file → a tree of fair samples of it, read piece by piece: the root has few points of all of it.

Points that lie one after the other in the file of a fusion are mostly of one image. So blocks of them are nodes of
a tree, which are joined by fours towards the root, and divided by fours into quarters and leaves, along planes.
Each block is put into one random order: the root takes the first points of all blocks, the nodes below it the next
of theirs, and the leaves the rest. What is drawn of nodes, down to whichever, is a fair sample. Nothing is
written, and little kept in memory.
"""

import threading
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.cloud_reader import PlyLayout, points_of, read_layout
from colmap_sph.project.files import open_regular

FAN = 4
"""Nodes below each."""
# Height of a block, of whose points those of leaves are told by so many planes, one after the other.
_BLOCK_HEIGHT = 2
_PLANES = 4
LEAVES = 1 << _PLANES
"""Of each block."""
# Points of a block; of these those of a block's own node, and of the nodes of its quarters together.
_BLOCK = 1 << 18
_NODE = 1 << 15
_QUARTERS = 1 << 16
# Points that tell where the leaves of a block are; from which height on nodes are kept in memory; blocks that are.
_TELLING = 4096
_KEPT_HEIGHT = 4
_KEPT_BLOCKS = 12
# Percentiles of the points of a leaf between which its box reaches.
_INSIDE = (2.0, 98.0)

Points = tuple[NDArray[np.float32], NDArray[np.uint8]]
"""(n, 3) places, and (n, 3) red, green and blue."""
Box = NDArray[np.float32]
"""Least x, y and z, and largest."""


@dataclass(frozen=True, eq=False)
class CloudFrame:
    """Where a cloud is looked at from: the frame in which its points are given.

    Attributes
    ----------
    axes : (3, 3) float64 ndarray
        Rows: to the right, to the top, and up, in the frame of the file.
    middle : (3,) float64 ndarray
        Its origin, in the frame of the file.
    reach : float
        Its unit.
    """

    axes: NDArray[np.float64]
    middle: NDArray[np.float64]
    reach: float

    def place(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """(n, 3) points of the file in this frame."""
        return ((points - self.middle) @ self.axes.T / self.reach).astype(np.float32)


class Planes:
    """Planes that divide points in halves, these again in halves, and so on; (n, 3) points tell where.

    Attributes
    ----------
    boxes : list of Box
        Of each part.
    """

    def __init__(self, points: NDArray[np.float32]) -> None:
        part = np.zeros(len(points), np.int64)
        self._axes = []
        self._values = []
        for level in range(_PLANES):
            own = [points[part == k] for k in range(1 << level)]
            axes = np.array([int(np.ptp(each, axis=0).argmax()) if len(each) else 0 for each in own])
            values = [np.median(each[:, axis]) if len(each) else 0 for each, axis in zip(own, axes, strict=True)]
            self._axes.append(axes)
            self._values.append(np.array(values, np.float32))
            part = self._halved(points, part, level)
        # One whose points are not among those that tell may be anywhere.
        own = [points[part == k] if (part == k).any() else points for k in range(LEAVES)]
        self.boxes = [np.percentile(each, _INSIDE, axis=0).astype(np.float32).ravel() for each in own]

    def part_of(self, points: NDArray[np.float32]) -> NDArray[np.int64]:
        """(n,) the part in which each point lies."""
        part = np.zeros(len(points), np.int64)
        for level in range(_PLANES):
            part = self._halved(points, part, level)
        return part

    def _halved(self, points: NDArray[np.float32], part: NDArray[np.int64], level: int) -> NDArray[np.int64]:
        beyond = points[np.arange(len(points)), self._axes[level][part]] > self._values[level][part]
        return np.asarray(2 * part + beyond)


@dataclass(frozen=True, eq=False)
class _Block:
    """A block's points below its own node, in their order: those of quarters before `quarters`, and of leaves."""

    places: NDArray[np.float32]
    colours: NDArray[np.uint8]
    leaf: NDArray[np.int64]
    quarters: int


@dataclass(eq=False)
class CloudBlocks:
    """A cloud's file as a tree of nodes; each block by `index_block` first, then `node` from any thread.

    Parameters
    ----------
    path : Path
        See `read_layout`; no link.
    frame : CloudFrame

    Raises
    ------
    InputError
        It is no such cloud.
    """

    path: Path
    frame: CloudFrame
    layout: PlyLayout = field(init=False)
    boxes: list[Box | None] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        try:
            self._file: BufferedReader = open_regular(self.path, follow=False)
        except OSError as error:
            raise InputError(f"The cloud {self.path} cannot be read ({reason_of(error)}); fuse again.") from error
        try:
            self.layout = read_layout(self.path, self._file)
        except BaseException:
            self.close()
            raise
        self._order = np.random.default_rng(0).permutation(_BLOCK)
        self._planes: list[Planes | None] = []
        self._upper: list[Points] = []
        self._recent: OrderedDict[int, _Block] = OrderedDict()
        self._lock = threading.Lock()
        self._reading = threading.Lock()

    @property
    def num_blocks(self) -> int:
        """Blocks of the file."""
        return -(-self.layout.count // _BLOCK)

    @property
    def height(self) -> int:
        """Of the root; leaves have 0."""
        height = _BLOCK_HEIGHT
        while FAN ** (height - _BLOCK_HEIGHT) < self.num_blocks:
            height += 1
        return height

    @property
    def shares(self) -> list[int]:
        """Points of each whole block in nodes of each height, all of a height together."""
        above = [max(_NODE // FAN**steps, 1) for steps in range(self.height - _BLOCK_HEIGHT + 1)]
        return [_BLOCK - _QUARTERS - sum(above), _QUARTERS, *above]

    def index_block(self, number: int) -> None:
        """Look at a block, the next one: find where it is, and keep what the upper nodes take of it."""
        places, _ = self._read(number, 0, _TELLING)
        planes = Planes(places) if len(places) else None
        self._planes.append(planes)
        self.boxes += [None] * LEAVES if planes is None else planes.boxes
        self._upper.append(self._read(number, 0, sum(self.shares[_KEPT_HEIGHT:])))

    def node(self, height: int, number: int) -> Points:
        """Points of a node.

        Parameters
        ----------
        height : int
        number : int
            Among those of its height.

        Raises
        ------
        InputError
            There is no such node, or the file has been cut off.
        """
        if not (0 <= height <= self.height and 0 <= number * FAN**height < self.num_blocks * LEAVES):
            raise InputError("The cloud has no such part.")
        if height < _BLOCK_HEIGHT:
            return self._below_block(height, number)
        width = FAN ** (height - _BLOCK_HEIGHT)
        blocks = range(number * width, min((number + 1) * width, self.num_blocks))
        parts = [self._part(block, height) for block in blocks]
        return np.concatenate([places for places, _ in parts]), np.concatenate([colours for _, colours in parts])

    def _part(self, block: int, height: int) -> Points:
        """What a node of the height of blocks, or above, takes of a block."""
        shares = self.shares
        begin = sum(shares[height + 1 :])
        if height < _KEPT_HEIGHT:
            return self._read(block, begin, begin + shares[height])
        places, colours = self._upper[block]
        total = sum(shares[_KEPT_HEIGHT:])
        part = slice(*(len(places) * end // total for end in (begin, begin + shares[height])))
        return places[part], colours[part]

    def _below_block(self, height: int, number: int) -> Points:
        """Points of a quarter's own node, or of a leaf."""
        of_block = FAN ** (_BLOCK_HEIGHT - height)
        block = self._lower(number // of_block)
        part = slice(0, block.quarters) if height == 1 else slice(block.quarters, None)
        is_own = block.leaf[part] // FAN**height == number % of_block
        return block.places[part][is_own], block.colours[part][is_own]

    def _lower(self, number: int) -> _Block:
        """What is below a block's own node; kept for a while, as the next leaf asked for is often of the same."""
        with self._lock:
            found = self._recent.get(number)
            if found is not None:
                self._recent.move_to_end(number)
                return found
        begin = sum(self.shares[_BLOCK_HEIGHT:])
        of_quarters = self._read(number, begin, begin + _QUARTERS)
        of_leaves = self._read(number, begin + _QUARTERS, _BLOCK)
        places = np.concatenate([of_quarters[0], of_leaves[0]])
        planes = self._planes[number]
        leaf = np.zeros(len(places), np.int64) if planes is None else planes.part_of(places)
        colours = np.concatenate([of_quarters[1], of_leaves[1]])
        made = _Block(places, colours, leaf, len(of_quarters[0]))
        with self._lock:
            self._recent[number] = made
            while len(self._recent) > _KEPT_BLOCKS:
                self._recent.popitem(last=False)
        return made

    def _read(self, block: int, begin: int, end: int) -> Points:
        """Points of a block from one place in its order to another; those that are nowhere are left out."""
        item = self.layout.kind.itemsize
        count = min(_BLOCK, self.layout.count - block * _BLOCK)
        with self._reading:
            self._file.seek(self.layout.begin + block * _BLOCK * item)
            data = self._file.read(count * item)
        if len(data) < count * item:
            raise InputError(f"{self.path} was cut off; start colmap_sph view again.")
        which = self._order[begin:end]
        xyz, rgb = points_of(np.frombuffer(data, self.layout.kind)[which[which < count]])
        return self.frame.place(xyz), rgb

    def close(self) -> None:
        """Let go of the file."""
        with suppress(OSError):
            self._file.close()
