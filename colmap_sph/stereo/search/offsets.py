"""Offsets of matched pixels: noise and small segments taken out of them, and made into disparities.

An *offset* is a target column minus a reference column, in 1/256 pixel as the kernels count; with the left image
as reference it is minus the disparity.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native

INVALID = np.iinfo(np.int32).min
"""The offset of a pixel that has none."""
SUBPIXEL = 256
"""Steps of offsets in a pixel; a power of two."""

# Side of the window of medians, pixels.
MEDIAN_SIDE = 5
# Offsets that differ from the median around them by no more (pixels) are noise; what differs by more may be
# another surface, and is left to the filter of small segments.
_MAX_NOISE = 2
# What no offset reaches.
_BEYOND = np.float32(1e9)
# Pixel locking makes whole pixels come more often than others by no more than this share; see `evening_shifts`.
_MAX_LOCKING = 0.15
_SHIFT_STEPS = 4096


def smooth(offset: NDArray[np.int32]) -> None:
    """Replace offsets, in place, by the median of 5 x 5 pixels where that is near.

    Neighbours without an offset count by turns as least and as most, so that they do not shift it.
    """
    values = offset.astype(np.float32)
    invalid = offset == INVALID
    turns = np.where(np.arange(offset.shape[1]) % 2, _BEYOND, -_BEYOND)
    np.copyto(values[::2], turns, where=invalid[::2])
    np.copyto(values[1::2], -turns, where=invalid[1::2])
    median = np.asarray(cv2.medianBlur(values, MEDIAN_SIDE), dtype=np.float32)
    values -= median
    near = np.abs(values, out=values) <= _MAX_NOISE * SUBPIXEL
    np.copyto(offset, median, where=near & ~invalid, casting="unsafe")


def remove_small_segments(offset: NDArray[np.int32], min_segment: int) -> None:
    """Invalidate, in place, connected regions smaller than `min_segment` pixels.

    Neighbours that differ by a pixel or less, in whole quarters of a pixel, are of one region.
    """
    if min_segment > 1:
        _native.remove_small_segments(offset, min_segment)


def to_disparity(offset: NDArray[np.int32]) -> NDArray[np.float32]:
    """(H, W) disparities, pixels, of (H, W) offsets, without pixel locking; NaN where there is no offset."""
    disparity = np.empty(offset.shape, dtype=np.float32)
    _native.to_disparity(offset, evening_shifts(offset), disparity)
    return disparity


def evening_shifts(offset: NDArray[np.int32]) -> NDArray[np.float32]:
    """What to add to an offset, pixels, by its fraction, so that all fractions come about equally often.

    Fine texture draws matches to whole pixels ("pixel locking"), by some hundredths of a pixel. Fractions that are
    uneven in another way are the scene's own, of surfaces that both cameras face, and stay.
    """
    counts = np.empty(SUBPIXEL, dtype=np.uint32)
    _native.count_fractions(offset, counts)
    turn = 2 * np.pi * np.arange(SUBPIXEL) / SUBPIXEL
    # The density is about 1 + a cos + b sin. Locking has no b: so much of a may be the scene's, too.
    a, b = (2 * (counts @ wave) / max(counts.sum(), 1) for wave in (np.cos(turn), np.sin(turn)))
    locking = np.clip(a - abs(b), 0, _MAX_LOCKING) * np.clip(2 - np.hypot(a, b) / _MAX_LOCKING, 0, 1)
    # The density's integral says where a fraction ought to be.
    shift = locking * np.sin(turn) / (2 * np.pi)
    # In steps, so that the last bit of a sine does not make results differ between processors.
    return np.asarray(np.round(shift * _SHIFT_STEPS) / _SHIFT_STEPS, dtype=np.float32)
