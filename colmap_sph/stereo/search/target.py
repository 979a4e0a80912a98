"""Prediction and right image → what the left one is compared with, and the way back to columns of the right image.

The right image is warped as the left one is expected to see it. At edges, the prediction tears windows apart, and
what lies behind one edge and before the other is in no place of the warped image. Pixels there search the right
image as it is, whose columns follow those of the warped one in the same row.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.stereo.census import CENSUS_INVALID, RectifiedImage, census
from colmap_sph.stereo.search.offsets import INVALID, SUBPIXEL
from colmap_sph.stereo.search.prediction import Prediction


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

    def offsets_to_right(self, offset: NDArray[np.int32]) -> NDArray[np.int32]:
        """(H, W) int32 offsets, 1/256 pixel, to columns of the right image, from those to columns of this."""
        if not self.prediction.warps:
            return offset
        unwarped = np.empty_like(offset)
        _native.unwarp_offsets(offset, self.prediction.offset, self.prediction.margin, unwarped)
        torn = self.prediction.torn
        if torn is not None:
            found = offset[torn]
            unwarped[torn] = np.where(found == INVALID, INVALID, found - np.int32(self.as_it_is * SUBPIXEL))
        return unwarped


def make_target(right: RectifiedImage, prediction: Prediction) -> Target:
    """Warp a level's right image as predicted.

    Parameters
    ----------
    right : RectifiedImage
        (H, W_right).
    prediction : Prediction
        Of the left image's (H, W) pixels.

    Returns
    -------
    Target
    """
    height, right_width = right.image.shape
    own_columns = np.broadcast_to(np.arange(right_width, dtype=np.int32), (height, right_width))
    if not prediction.warps:
        columns = np.ascontiguousarray(own_columns)
        return Target(census(right), columns, prediction.base, right_width, 0, prediction)
    warped, columns = _warped(right, prediction)
    words = census(warped)
    del warped
    base = prediction.base + np.int32(prediction.margin)
    torn = prediction.torn
    if torn is None:
        return Target(words, columns, base, right_width, words.shape[1], prediction)
    # Windows of torn pixels that begin left of the right image must not reach what lies before it here.
    gap = prediction.depth
    as_it_is = words.shape[1] + gap
    unseen = np.full((height, gap), CENSUS_INVALID)
    words = np.concatenate([words, unseen, census(right)], axis=1)
    columns = np.concatenate([columns, np.full((height, gap), -1, dtype=np.int32), own_columns], axis=1)
    nearest = -gap - np.arange(torn.shape[1], dtype=np.int32)
    np.copyto(base, np.maximum(prediction.base, nearest) + np.int32(as_it_is), where=torn)
    return Target(words, columns, base, right_width, as_it_is, prediction)


def _warped(right: RectifiedImage, prediction: Prediction) -> tuple[RectifiedImage, NDArray[np.int32]]:
    """The right image as the left one is expected to see it, with a margin; and its columns in the right one."""
    height, width = prediction.offset.shape
    image = np.empty((height, width + 2 * prediction.margin), dtype=np.float32)
    valid = np.empty(image.shape, dtype=np.uint8)
    columns = np.empty(image.shape, dtype=np.int32)
    _native.warp(
        np.ascontiguousarray(right.image),
        np.ascontiguousarray(right.valid),
        prediction.offset,
        prediction.margin,
        image,
        valid,
        columns,
    )
    return RectifiedImage(image, valid), columns
