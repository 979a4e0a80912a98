"""Images of a pair and what is known of their matches → the left one as bright as the right one, and their noise.

Exposure, vignetting and surfaces that shine make one image brighter than the other, from place to place by another
amount. When that is taken away, grey values of matches can be compared, as well as what is left tells.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.search.offsets import INVALID, SUBPIXEL

# One pixel of the coarser level is compared in each cell of so many; differences are averaged over so many cells,
# and the usual one counts as much as so many of them, for places where few are matched.
_CELL = 4
_CELLS = 17
_PRIOR = 4
# Differences that are off by more than so many times the median are of wrong matches.
_OUTLIER = 4
# Grey values are compared in steps of so much of the median difference, of one grey value at least.
_STEP = 0.7
_LEAST_STEP = 1.0
# Differences are whole numbers of these parts of a grey value, so that sums are exact in any order. For medians of
# neighbourhoods they are in bytes, as grey values up to _LARGEST.
_PARTS = 64.0
_LARGEST = 127.0

Float = NDArray[np.float64]


def equally_bright(
    left: RectifiedImage, right: RectifiedImage, offset: NDArray[np.int32]
) -> tuple[RectifiedImage, float]:
    """The left image of a level with the brightness that the right one has where it matches.

    Parameters
    ----------
    left : RectifiedImage
        (H, W).
    right : RectifiedImage
        (H, W_right).
    offset : (h, w) int32 ndarray
        Matches of the coarser level, 1/256 of its pixels; `INVALID` where there are none.

    Returns
    -------
    left : RectifiedImage
    step : float
        Steps, in grey values, in which to compare the two; 0: not at all, as nothing tells how bright they are.
    """
    difference, matched = _differences(left, right, offset)
    if not matched.any():
        return left, 0.0
    usual = float(np.median(difference[matched]))
    middle = _local_median(np.where(matched, difference, usual))
    off = np.abs(difference - middle)
    shift = _local_mean(difference, matched & (off <= _OUTLIER * np.median(off[matched])), usual)
    noise = float(np.median(np.abs(difference - shift)[matched])) / _PARTS
    return _darker(left, shift / _PARTS), max(_STEP * noise, _LEAST_STEP)


def _differences(
    left: RectifiedImage, right: RectifiedImage, offset: NDArray[np.int32]
) -> tuple[Float, NDArray[np.bool_]]:
    """By how much one left pixel of each cell is brighter than its match, in parts; and whether it has one."""
    rows, columns = (
        np.minimum(np.arange(_CELL // 2, size + _CELL // 2, _CELL), size - 1) for size in offset.shape
    )
    coarse = offset[np.ix_(rows, columns)]
    rows, columns = 2 * rows[:, np.newaxis], 2 * columns
    match = columns + (2 * coarse.astype(np.int64) + SUBPIXEL // 2) // SUBPIXEL
    inside = np.clip(match, 0, right.image.shape[1] - 1)
    matched = (coarse != INVALID) & (match == inside)
    matched &= (left.valid[rows, columns] > 0) & (right.valid[rows, inside] > 0)
    difference = left.image[rows, columns].astype(float) - right.image[rows, inside]
    return np.where(matched, np.round(_PARTS * difference), 0), matched


def _local_median(difference: Float) -> Float:
    grey = np.clip(np.round(difference / _PARTS), -_LARGEST, _LARGEST) + _LARGEST
    return np.asarray(_PARTS * (cv2.medianBlur(grey.astype(np.uint8), _CELLS) - _LARGEST), dtype=np.float64)


def _local_mean(difference: Float, counts: NDArray[np.bool_], usual: float) -> Float:
    number, total = (
        cv2.boxFilter(values, cv2.CV_64F, (_CELLS, _CELLS), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for values in (counts.astype(float), np.where(counts, difference, 0))
    )
    return np.asarray((total + _PRIOR * usual) / (number + _PRIOR), dtype=np.float64)


def _darker(image: RectifiedImage, shift: Float) -> RectifiedImage:
    """An image less a shift of its cells, linear between their centres."""
    height, width = image.image.shape
    rows, columns = shift.shape
    everywhere = cv2.resize(shift.astype(np.float32), (2 * _CELL * columns, 2 * _CELL * rows))
    return replace(image, image=np.subtract(image.image, everywhere[:height, :width]))
