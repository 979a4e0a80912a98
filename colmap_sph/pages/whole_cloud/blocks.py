"""A cloud's file → a tree of fair samples of it, read piece by piece: the root has few points of all of it.

Points that lie one after the other in the file of a fusion lie near each other, too, as images are written row by
row. So blocks of them are the leaves of a tree, whose nodes stand for `FAN` nodes below. Each block is put into
one random order: the root takes the first points of all blocks, the nodes below it the next of theirs, and the
leaves the rest. What is drawn of nodes, down to whichever, is a fair sample; nothing is written, and little is
kept in memory.
"""

import os
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
# Points of a block, at least; of a node that is no leaf; from which height on these are kept in memory; which tell
# where a block is.
_BLOCK = 1 << 16
_NODE = 1 << 15
_KEPT_HEIGHT = 3
_TELLING = 1024
# Higher trees would have nodes with less than two points of each block: these are larger then.
_MOST_HEIGHT = 7
# Shares of the points of a block that its box goes around.
_INSIDE = (1.0, 99.0)

Points = tuple[NDArray[np.float32], NDArray[np.uint8]]
"""(n, 3) places, and (n, 3) red, green and blue."""


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
    boxes: list[NDArray[np.float32] | None] = field(init=False, default_factory=list)

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
        self._size = _BLOCK
        while -(-self.layout.count // self._size) > FAN**_MOST_HEIGHT:
            self._size *= 2
        self._order = np.random.default_rng(0).permutation(self._size)
        self._kept: list[Points] = []

    @property
    def num_blocks(self) -> int:
        """Blocks of the file."""
        return -(-self.layout.count // self._size)

    @property
    def height(self) -> int:
        """Of the root; leaves have 0."""
        height = 0
        while FAN**height < self.num_blocks:
            height += 1
        return height

    @property
    def shares(self) -> list[int]:
        """Points of each whole block in a node of each height."""
        above = [_NODE // FAN**height for height in range(1, self.height + 1)]
        return [self._size - sum(above), *above]

    def index_block(self, number: int) -> None:
        """Look at a block, the next one: find where it is, and keep what the upper nodes take of it."""
        order = self._places_in(number, 0, max(sum(self.shares[_KEPT_HEIGHT:]), _TELLING))
        places, colours = self._read(number, order)
        told = places[:_TELLING]
        self.boxes.append(np.percentile(told, _INSIDE, axis=0).astype(np.float32).ravel() if len(told) else None)
        kept = len(self._places_in(number, 0, sum(self.shares[_KEPT_HEIGHT:])))
        self._kept.append((places[:kept].copy(), colours[:kept].copy()))

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
        first = number * FAN**height
        if not (0 <= height <= self.height and 0 <= first < self.num_blocks):
            raise InputError("The cloud has no such part.")
        parts = [self._part(block, height) for block in range(first, min(first + FAN**height, self.num_blocks))]
        return np.concatenate([places for places, _ in parts]), np.concatenate([colours for _, colours in parts])

    def _part(self, block: int, height: int) -> Points:
        """What a node of a height takes of a block."""
        shares = self.shares
        begin = sum(shares[height + 1 :])
        if height >= _KEPT_HEIGHT:
            places, colours = self._kept[block]
            total = sum(shares[_KEPT_HEIGHT:])
            ends = [len(places) * end // total for end in (begin, begin + shares[height])]
            return places[slice(*ends)], colours[slice(*ends)]
        return self._read(block, self._places_in(block, begin, begin + shares[height]))

    def _places_in(self, block: int, begin: int, end: int) -> NDArray[np.int64]:
        """Of the order of a block's points a part."""
        count = min(self._size, self.layout.count - block * self._size)
        part = self._order[begin:end]
        return np.asarray(part[part < count])

    def _read(self, block: int, which: NDArray[np.int64]) -> Points:
        """Some points of a block, in an order; those that are nowhere are left out."""
        item = self.layout.kind.itemsize
        count = min(self._size, self.layout.count - block * self._size)
        data = os.pread(self._file.fileno(), count * item, self.layout.begin + block * self._size * item)
        if len(data) < count * item:
            raise InputError(f"{self.path} was cut off; start colmap_sph view again.")
        xyz, rgb = points_of(np.frombuffer(data, self.layout.kind)[which])
        return self.frame.place(xyz), rgb

    def close(self) -> None:
        """Let go of the file."""
        with suppress(OSError):
            self._file.close()
