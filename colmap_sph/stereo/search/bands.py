"""A level of a pair → the offsets of its matches, in bands of rows where the whole takes too much memory.

What is compared is worked out for each band alone. Paths cross all rows: sweeps over them begin at both ends of
the image and note what they bring to each band. Where they meet a band is matched, and from there on all others
towards both ends, at once where a thread is idle. The result is that of one piece, to the bit.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.stereo.census import Compared, RectifiedImage, census
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.search.idle import at_once
from colmap_sph.stereo.search.prediction import Prediction
from colmap_sph.stereo.search.target import Target, TargetRoom, make_target

# Rows beside a pixel's that its census depends on, and those that the fit of its offset looks at.
_CENSUS_ROWS = 4
_FIT_ROWS = 2
# Bytes per pixel of what is compared, and per slot of costs and of forward paths.
_COMPARED_BYTES = 48
_BYTES_PER_SLOT = 2
# Of the memory for a level, one part in so many is for its target.
_TARGETS_SHARE = 4

State = NDArray[np.uint8]


class Scratch:
    """Working memory of one matching thread, kept from level to level and from pair to pair.

    Parameters
    ----------
    max_bytes : int
        Of targets, one part in `_TARGETS_SHARE`.
    """

    def __init__(self, max_bytes: int = 1 << 30) -> None:
        self.targets = TargetRoom(max_bytes // _TARGETS_SHARE)
        self._memory = np.empty(0, dtype=np.uint8)

    def volume(self, pixels: int, depth: int) -> NDArray[np.uint8]:
        """(2, pixels, depth) uint8 array."""
        size = _BYTES_PER_SLOT * pixels * depth
        if size > self._memory.size:
            self._memory = np.empty(0, dtype=np.uint8)  # the old one goes first
            self._memory = np.empty(size, dtype=np.uint8)
        return self._memory[:size].reshape(_BYTES_PER_SLOT, pixels, depth)


class Scratches:
    """Working memory of as many threads as match at a time; see `Scratch`.

    Parameters
    ----------
    max_bytes : int
        Of each; levels that need more are worked in bands of rows, with the same result.
    give_back : callable, optional
        Called before a level in bands takes memory, to have the system get back what smaller levels have freed.
    """

    def __init__(self, max_bytes: int = 1 << 30, give_back: Callable[[], None] | None = None) -> None:
        self.max_bytes = max_bytes
        self._give_back = give_back
        self._free: list[Scratch] = []

    def is_large(self, pixels: int, depth: int) -> bool:
        """Whether so many pixels are matched in bands."""
        return scratch_bytes(pixels, depth) > self.max_bytes

    def prepare(self, pixels: int, depth: int) -> None:
        """Make room for what so many pixels take beside this, where they are matched in bands."""
        if self._give_back is not None and self.is_large(pixels, depth):
            self._give_back()

    @contextmanager
    def lent(self) -> Iterator[Scratch]:
        """Working memory for the calling thread."""
        try:
            scratch = self._free.pop()
        except IndexError:
            scratch = Scratch(self.max_bytes)
        yield scratch
        self._free.append(scratch)


def scratch_bytes(pixels: int, depth: int) -> int:
    """Bytes in which so many pixels are matched: costs, forward paths, and what is compared."""
    return (_BYTES_PER_SLOT * depth + _COMPARED_BYTES) * pixels


@dataclass(frozen=True)
class Limits:
    """Penalties of paths, and the left-right check, as the kernels take them."""

    p1: int
    p2: NDArray[np.uint8]
    max_slant: int
    max_difference: int
    max_excess: int


@dataclass(frozen=True, eq=False)
class Level:
    """A level's images, and what its pixels search.

    Attributes
    ----------
    left, right : RectifiedImage
        The left one as bright as the right one.
    grey : (H, W) uint8 ndarray
        The left image as it is.
    prediction : Prediction
    compared : Compared
    """

    left: RectifiedImage
    right: RectifiedImage
    grey: NDArray[np.uint8]
    prediction: Prediction
    compared: Compared

    def rows(self, first: int, end: int, room: TargetRoom | None = None) -> "LevelRows":
        """What of some rows is compared; the target is in `room`, until that is used again."""
        low, high = max(first - _CENSUS_ROWS, 0), min(end + _CENSUS_ROWS, len(self.grey))
        around, own = slice(low, high), slice(first - low, end - low)
        target = make_target(self.right.rows(around), self.prediction.rows(around), room, self.compared)
        left_census = census(self.left.rows(around), self.compared)
        return LevelRows(left_census[own], target.rows(own), self.grey[first:end])


@dataclass(frozen=True, eq=False)
class LevelRows:
    """Census of the left image, what it is compared with, and its grey values."""

    left_census: NDArray[np.uint64]
    target: Target
    grey: NDArray[np.uint8]

    def rows(self, rows: slice) -> "LevelRows":
        """Some of its rows."""
        return LevelRows(self.left_census[rows], self.target.rows(rows), self.grey[rows])

    @property
    def surface(self) -> NDArray[np.int32]:
        """First column to search, as aggregation sees it."""
        prediction = self.target.prediction
        return prediction.base if prediction.exact else prediction.first

    def fitted(self, offset: NDArray[np.int32]) -> NDArray[np.int32]:
        """Offsets with a sub-pixel fit to the raw costs."""
        fitted = np.empty_like(offset)
        _native.fit_offsets(backend(), offset, self.left_census, self.target.census, fitted)
        return fitted


@dataclass(frozen=True)
class Band:
    """Rows of a level, from `first` to before `end` of those that are given, and how many lie above and below."""

    first: int
    end: int
    above: int = 0
    below: int = 0


@dataclass(frozen=True, eq=False)
class Sweeps:
    """What the sweeps, from above and from below, bring to a band; once it is matched, what they take from it."""

    forward: State
    backward: State


def fresh_state(shape: tuple[int, ...], depth: int) -> State:
    """That of a sweep over an image of this shape before it begins."""
    return np.empty(_native.sweep_bytes(backend(), shape[1], depth), np.uint8)


def match_rows(
    rows: LevelRows, band: Band, sweeps: Sweeps, limits: Limits, scratch: Scratch, offset: NDArray[np.int32]
) -> None:
    """Set the offsets, to columns of the target, of a band's rows."""
    _native.match(
        backend(),
        rows.left_census,
        rows.target.census,
        rows.target.columns,
        rows.target.right_width,
        rows.target.base,
        rows.surface,
        rows.grey,
        limits.p1,
        limits.p2,
        limits.max_slant,
        limits.max_difference,
        limits.max_excess,
        band.first,
        band.above,
        band.below,
        sweeps.forward,
        sweeps.backward,
        scratch.volume(offset.size, rows.target.prediction.depth),
        offset,
    )


def match_whole(rows: LevelRows, limits: Limits, scratch: Scratch) -> NDArray[np.int32]:
    """Offsets, to columns of the target, of a level in one piece."""
    offset = np.empty(rows.grey.shape, dtype=np.int32)
    states = (fresh_state(offset.shape, rows.target.prediction.depth) for _ in range(2))
    match_rows(rows, Band(0, len(offset)), Sweeps(*states), limits, scratch, offset)
    return offset


Keep = Callable[[NDArray[np.int32], LevelRows, int, int], None]
"""Takes what a band has found, to columns of the target; what was compared; and the band's first row and end."""


class BandMatcher:
    """Matches a level in bands of rows."""

    def __init__(self, level: Level, limits: Limits, scratches: Scratches) -> None:
        height, width = level.grey.shape
        depth = level.prediction.depth
        # With fewer rows, what the sweeps note would take more memory than the bands.
        step = max(scratches.max_bytes // scratch_bytes(width, depth), math.isqrt(height))
        self._level = level
        self._limits = limits
        self._scratches = scratches
        self._height = height
        self._bands = [(first, min(first + step, height)) for first in range(0, height, step)]
        self._middle = len(self._bands) // 2
        # What the sweeps, forward and backward, bring to each band.
        self._forward: dict[int, State] = {}
        self._backward: dict[int, State] = {}
        self._offset = np.empty((height, width), np.int32)
        # Fits look at rows on both sides: of those near the ends of bands, what was found, by row.
        self._beside: dict[int, NDArray[np.int32]] = {}

    def target_offset(self) -> NDArray[np.int32]:
        """(H, W) int32 offsets to columns of the target, 1/256 pixel."""
        self._match_bands(self._keep)
        return self._offset

    def offset(self, *, fit: bool) -> NDArray[np.int32]:
        """(H, W) int32 offsets to columns of the right image, 1/256 pixel, fitted to the raw costs or not."""
        if not fit:
            self._match_bands(self._keep_to_right)
            return self._offset
        self._match_bands(self._keep_fitted)
        for first, _ in self._bands[1:]:
            low, high = max(first - 2 * _FIT_ROWS, 0), min(first + 2 * _FIT_ROWS, self._height)
            found = np.stack([self._beside[row] for row in range(low, high)])
            self._fit(found, self._level.rows(low, high), low, high)
        return self._offset

    def _match_bands(self, keep: Keep) -> None:
        """Match all bands, and have kept what is found in each."""
        last = len(self._bands) - 1
        before, behind = range(self._middle), range(last, self._middle, -1)
        at_once(
            partial(self._sweep, before, self._forward, backward=False),
            partial(self._sweep, behind, self._backward, backward=True),
        )
        forward, backward = self._forward.pop(self._middle), self._backward.pop(self._middle)
        self._match(self._middle, Sweeps(forward, backward), keep)
        at_once(partial(self._match_up, backward, keep), partial(self._match_down, forward, keep))

    def _sweep(self, bands: range, states: dict[int, State], *, backward: bool) -> None:
        """Sweep over bands, up to the middle, and note the states before each."""
        state = fresh_state(self._offset.shape, self._level.prediction.depth)
        limits = self._limits
        for number in bands:
            states[number] = state.copy()
            rows, band = self._band(number)
            _native.sweep(
                backend(),
                rows.left_census,
                rows.target.census,
                rows.target.base,
                rows.surface,
                rows.grey,
                self._level.prediction.depth,
                limits.p1,
                limits.p2,
                limits.max_slant,
                band.first,
                band.end,
                band.above,
                band.below,
                backward,
                state,
            )
        states[self._middle] = state

    def _match_up(self, backward: State, keep: Keep) -> None:
        for number in range(self._middle - 1, -1, -1):
            self._match(number, Sweeps(self._forward.pop(number), backward), keep)

    def _match_down(self, forward: State, keep: Keep) -> None:
        for number in range(self._middle + 1, len(self._bands)):
            self._match(number, Sweeps(forward, self._backward.pop(number)), keep)

    def _match(self, number: int, sweeps: Sweeps, keep: Keep) -> None:
        rows, band = self._band(number)
        first, end = self._bands[number]
        found = np.empty((end - first, rows.grey.shape[1]), np.int32)
        with self._scratches.lent() as scratch:
            match_rows(rows, band, sweeps, self._limits, scratch, found)
        keep(found, rows.rows(slice(band.first, band.end)), first, end)

    def _band(self, number: int) -> tuple[LevelRows, Band]:
        """What is compared in a band and in the rows beside it, to which paths go, and its place among these."""
        first, end = self._bands[number]
        low, high = max(first - 1, 0), min(end + 1, self._height)
        return self._level.rows(low, high), Band(first - low, end - low, first, self._height - end)

    def _keep(self, found: NDArray[np.int32], rows: LevelRows, first: int, end: int) -> None:
        """Set the offsets of the rows from `first` to before `end`."""
        self._offset[first:end] = found

    def _keep_to_right(self, found: NDArray[np.int32], rows: LevelRows, first: int, end: int) -> None:
        """Set them to columns of the right image."""
        self._offset[first:end] = rows.target.offsets_to_right(found)

    def _keep_fitted(self, found: NDArray[np.int32], rows: LevelRows, first: int, end: int) -> None:
        """Fit them, too, and note what fits beside this band look at."""
        near = 2 * _FIT_ROWS
        for row in {*range(first, min(first + near, end)), *range(max(end - near, first), end)}:
            self._beside[row] = found[row - first].copy()
        self._fit(found, rows, first, end)

    def _fit(self, found: NDArray[np.int32], rows: LevelRows, first: int, end: int) -> None:
        """Set fitted offsets to columns of the right image but for those next to the ends of these rows."""
        kept = slice(first + _FIT_ROWS * (first > 0), end - _FIT_ROWS * (end < self._height))
        if kept.start < kept.stop:
            own = slice(kept.start - first, kept.stop - first)
            self._offset[kept] = rows.target.rows(own).offsets_to_right(rows.fitted(found)[own])
