"""Prediction and right image → what the left one is compared with, and the way back to columns of the right image.

The right image is warped as the left one is expected to see it. At edges, the prediction tears windows apart, and
what lies behind one edge and before the other is in no place of the warped image. Pixels there search the right
image as it is, whose columns follow those of the warped one in the same row.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.stereo.census import NEIGHBOURS, Compared, RectifiedImage, census, put_census
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.search.offsets import INVALID, SUBPIXEL
from colmap_sph.stereo.search.prediction import Prediction
from colmap_sph.stereo.search.ranges import STEP

# Side of the windows whose mean costs are compared, and by how many bits another match must be better than ours
# where they are more than a pixel apart.
_WINDOW = 7
_BETTER = 1


class TargetRoom:
    """Memory for the largest targets, those that are joined, kept from level to level and from pair to pair.

    One is in use at a time. Fresh memory of that size would come from the system each time, which clears it.

    Parameters
    ----------
    max_bytes : int
        Targets that need more are not kept.
    """

    def __init__(self, max_bytes: int = 0) -> None:
        self.max_bytes = max_bytes
        self._words = np.empty(0, dtype=np.uint64)
        self._columns = np.empty(0, dtype=np.int32)

    def arrays(self, height: int, width: int) -> tuple[NDArray[np.uint64], NDArray[np.int32]]:
        """Census and columns of a target, not set."""
        size = height * width
        if size * (self._words.itemsize + self._columns.itemsize) > self.max_bytes:
            return np.empty((height, width), np.uint64), np.empty((height, width), np.int32)
        if size > self._words.size:
            self._words = np.empty(size, dtype=np.uint64)
            self._columns = np.empty(size, dtype=np.int32)
        return self._words[:size].reshape(height, width), self._columns[:size].reshape(height, width)


@dataclass(frozen=True, eq=False)
class Target:
    """What the left image of a level is compared with.

    Attributes
    ----------
    census : (H, T) uint64 ndarray
        Of the right image, warped, as it is, or both side by side.
    columns : (H, T) int32 ndarray
        Nearest column of the right image that each pixel shows; -1 outside.
    base : (H, W) int32 ndarray
        First column to search of every left pixel, less its own.
    right_width : int
        Columns of the right image.
    as_it_is : int
        Column at which the right image begins as it is.
    prediction : Prediction
    """

    census: NDArray[np.uint64]
    columns: NDArray[np.int32]
    base: NDArray[np.int32]
    right_width: int
    as_it_is: int
    prediction: Prediction

    def rows(self, rows: slice) -> "Target":
        """What some of the rows are compared with."""
        return replace(
            self,
            census=self.census[rows],
            columns=self.columns[rows],
            base=self.base[rows],
            prediction=self.prediction.rows(rows),
        )

    def offsets_to_right(self, offset: NDArray[np.int32]) -> NDArray[np.int32]:
        """(H, W) int32 offsets, 1/256 pixel, to columns of the right image, from those to columns of this."""
        if not self.prediction.warps:
            return offset
        unwarped = np.empty_like(offset)
        _native.unwarp_offsets(offset, self.prediction.offset, self.prediction.margin, unwarped)
        if self.prediction.torn is not None:
            _native.unwarp_torn(offset, self.prediction.torn_bytes, self.as_it_is, unwarped)
        return unwarped


@dataclass(frozen=True, eq=False)
class Matches:
    """What the left image's pixels match.

    Attributes
    ----------
    target : Target
    left_census : (H, W) uint64 ndarray
    target_offset : (H, W) int32 ndarray
        Offsets to columns of the target, 1/256 pixel; `INVALID` where nothing was found.
    """

    target: Target
    left_census: NDArray[np.uint64]
    target_offset: NDArray[np.int32]

    @cached_property
    def offset(self) -> NDArray[np.int32]:
        """(H, W) int32 offsets to columns of the right image, 1/256 pixel."""
        return self.target.offsets_to_right(self.target_offset)

    def or_better(self, others: "Matches") -> NDArray[np.int32]:
        """Return `offset`, or that of `others` where both tell, and windows differ less there.

        Where sparse points predict a slanted surface, windows on it look alike; those on an object in front that
        has no such point look the more different, and like themselves without a prediction.
        """
        better = np.abs(self.offset - others.offset) > SUBPIXEL
        better &= (self.offset != INVALID) & (others.offset != INVALID)
        better &= others._window_costs() < self._window_costs() - _BETTER
        return np.where(better, others.offset, self.offset)

    def _window_costs(self) -> NDArray[np.float32]:
        """Mean cost of the matches in the window around each pixel, bits."""
        found = self.target_offset != INVALID
        nearest = (np.where(found, self.target_offset, 0) + SUBPIXEL // 2) // SUBPIXEL
        costs = np.empty((*found.shape, STEP), dtype=np.uint8)
        _native.matching_cost(backend(), self.left_census, self.target.census, nearest.astype(np.int32), costs)
        cost = np.where(found, costs[..., 0], 0).astype(np.float32)
        sums, numbers = (
            cv2.boxFilter(values, cv2.CV_32F, (_WINDOW, _WINDOW), normalize=False)
            for values in (cost, found.astype(np.float32))
        )
        return np.asarray(sums / np.maximum(numbers, 1), dtype=np.float32)


def make_target(
    right: RectifiedImage, prediction: Prediction, room: TargetRoom | None = None, compared: Compared = NEIGHBOURS
) -> Target:
    """Warp a level's right image as predicted.

    Parameters
    ----------
    right : RectifiedImage
        (H, W_right).
    prediction : Prediction
        Of the left image's (H, W) pixels.
    room : TargetRoom, optional
        What the target may be in until the next one is made.
    compared : Compared
        As of `census`.

    Returns
    -------
    Target
    """
    height, right_width = right.image.shape
    if not prediction.warps:
        own_columns = np.broadcast_to(np.arange(right_width, dtype=np.int32), (height, right_width))
        columns = np.ascontiguousarray(own_columns)
        return Target(census(right, compared), columns, prediction.base, right_width, 0, prediction)
    warped_width = prediction.offset.shape[1] + 2 * prediction.margin
    if prediction.torn is None:
        words, columns = TargetRoom().arrays(height, warped_width)
        put_census(_warped(right, prediction, columns), words, compared=compared)
        base = prediction.base + np.int32(prediction.margin)
        return Target(words, columns, base, right_width, warped_width, prediction)
    # Windows of torn pixels that begin left of the right image must not reach what lies before it here.
    gap = prediction.depth
    as_it_is = warped_width + gap
    words, columns = (room or TargetRoom()).arrays(height, as_it_is + right_width)
    put_census(_warped(right, prediction, columns), words, compared=compared)
    _native.join_targets(warped_width, right_width, words, columns)
    put_census(right, words, as_it_is, compared)
    base = np.empty_like(prediction.base)
    _native.target_bases(prediction.base, prediction.torn_bytes, prediction.margin, as_it_is, gap, base)
    return Target(words, columns, base, right_width, as_it_is, prediction)


def _warped(right: RectifiedImage, prediction: Prediction, columns: NDArray[np.int32]) -> RectifiedImage:
    """The right image as the left one is expected to see it, with a margin; sets its columns in the right one."""
    height, width = prediction.offset.shape
    image = np.empty((height, width + 2 * prediction.margin), dtype=np.float32)
    valid = np.empty(image.shape, dtype=np.uint8)
    _native.warp(
        np.ascontiguousarray(right.image),
        np.ascontiguousarray(right.valid),
        prediction.offset,
        prediction.margin,
        image,
        valid,
        columns,
    )
    return RectifiedImage(image, valid)
