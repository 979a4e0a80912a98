"""Offsets of a pyramid's level → where each pixel of the next finer level searches.

The coarsest level searches the whole range. Every other pixel searches the same number of offsets, from a base of
its own, about those that its neighbourhood has at the level above (Rothermel et al. 2012, "tSGM", where each pixel
has a number of its own, too: with one for all, memory stays regular). Offsets are those of `offsets`.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.stereo.offsets import INVALID, MEDIAN_SIDE, SUBPIXEL

STEP = 32
"""The number of offsets that a pixel searches is a multiple of this."""
MAX_DEPTH = 1024
"""And no larger."""

# Images of a level have no side shorter than this, and large ones have two levels above them at least: noise and
# gaps shrink, while the whole range may be short.
_LEAST_SIDE = 32
_LARGE_SIDE = 256
_LEVELS_OF_LARGE = 2
# Offsets searched beyond either end of a range, so that a match at its end has neighbours for its sub-pixel fit.
_SPARE = 1
# Offsets, of the finer level, that a neighbourhood's range must leave free at either end of the pixel's, and those
# that a pixel's own offset must.
_CLEARANCE = 4
_OWN_CLEARANCE = 6
# Within 3 x 3 pixels of a coarser level, offsets on one surface differ by no more (in pixels of the finer one).
_MAX_SURFACE_STEP = 4


def num_levels(count: int, size: int, most: int) -> int:
    """Levels above full resolution: until the range is short, but never images under 32 pixels.

    Parameters
    ----------
    count : int
        Offsets to search at full resolution.
    size : int
        Shortest side of the two images, pixels.
    most : int
        Offsets to search at the coarsest level, at most.

    Returns
    -------
    int
        0: full resolution alone.
    """
    levels = 0
    while _with_spare(count >> levels) > most and (size >> levels) >= 2 * _LEAST_SIDE:
        levels += 1
    return max(levels, _LEVELS_OF_LARGE if size >= _LARGE_SIDE else 0)


def whole_range(shape: tuple[int, ...], low: int, high: int) -> tuple[NDArray[np.int32], int]:
    """What to search where nothing is known yet.

    Parameters
    ----------
    shape : (int, int)
        Of the level.
    low, high : int
        Least and most offset, pixels of the level.

    Returns
    -------
    base : (H, W) int32 ndarray
        First offset to search, pixels.
    depth : int
        Number of offsets to search.
    """
    return np.full(shape, low - _SPARE, dtype=np.int32), range_depth(low, high)


def range_depth(low: int, high: int) -> int:
    """Number of offsets that search the whole range, as many as can be had."""
    return min(-(-_with_spare(high - low) // STEP) * STEP, MAX_DEPTH)


def propagate(
    offset: NDArray[np.int32], shape: tuple[int, ...], depth: int, low: int, high: int, radius: int
) -> NDArray[np.int32]:
    """First offset to search for each pixel of the next finer level, from the offsets of a level.

    A pixel searches around the middle of its neighbourhood's offsets where they fit into `depth`, else around
    its own; pixels without an offset take the nearest pixel's.

    Parameters
    ----------
    offset : (h, w) int32 ndarray
        Of the coarser level, 1/256 of its pixels.
    shape : (int, int)
        (H, W) of the finer level: 2 h and 2 w, or one less.
    depth : int
        Number of offsets that a pixel searches.
    low, high : int
        Least and most offset, pixels of the finer level.
    radius : int
        Of the neighbourhood, pixels of the coarser level.

    Returns
    -------
    (H, W) int32 ndarray
        Pixels of the finer level.
    """
    valid = offset != INVALID
    if not valid.any():
        return np.full(shape, (low + high - depth) // 2, dtype=np.int32)
    filled = _fill_nearest(offset.astype(np.float32) * np.float32(1 / SUBPIXEL), valid)
    own = np.asarray(cv2.medianBlur(filled, MEDIAN_SIDE), dtype=np.float32)
    least, most = _neighbourhood(own, radius)
    fits = 2 * (most - least) <= depth - 2 * _CLEARANCE
    # A little towards the neighbourhood's middle even where it does not fit.
    reach = np.float32((depth - 2 * _OWN_CLEARANCE) / 4)
    middle = (least + most) / 2
    centre = 2 * np.where(fits, middle, np.clip(middle, own - reach, own + reach))
    fine = np.round(_upsample(centre, shape) - depth / 2).astype(np.int32)
    first = low - _SPARE
    return np.clip(fine, first, max(high + 1 + _SPARE - depth, first))


def _with_spare(span: int) -> int:
    """Offsets from the first to the last of a range, both counted, and those beyond either end."""
    return span + 1 + 2 * _SPARE


def _neighbourhood(values: NDArray[np.float32], radius: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least and largest value within `radius` of every pixel."""
    window = np.ones((2 * radius + 1,) * 2, dtype=np.uint8)
    return np.asarray(cv2.erode(values, window)), np.asarray(cv2.dilate(values, window))


def _upsample(values: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Twice the size, cut to `shape`: interpolated on surfaces, so that aggregation can follow their slope, and
    repeated at steps."""
    doubled = (2 * values.shape[1], 2 * values.shape[0])
    least, most = _neighbourhood(values, 1)
    flat = (most - least <= _MAX_SURFACE_STEP).astype(np.uint8)
    interpolated = cv2.resize(values, doubled, interpolation=cv2.INTER_LINEAR)
    repeated = cv2.resize(values, doubled, interpolation=cv2.INTER_NEAREST)
    on_surface = cv2.resize(flat, doubled, interpolation=cv2.INTER_NEAREST) > 0
    chosen = np.where(on_surface, interpolated, repeated)
    return np.asarray(chosen[: shape[0], : shape[1]], dtype=np.float32)


def _fill_nearest(values: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Give pixels that are not valid the value of the nearest one that is."""
    _, labels = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(labels.max()) + 1, dtype=np.float32)
    of_label[labels[valid]] = values[valid]
    return np.asarray(of_label[labels], dtype=np.float32)
