"""Where the pixels of a level are expected to match, and what they search about that.

The coarsest level starts from the pair's sparse points and searches the whole range; every other one from what the
level above found, about which each pixel searches the same number of offsets (Rothermel et al. 2012, "tSGM", where
each pixel has a number of its own, too: with one for all, memory stays regular). The right image is warped by what
is predicted before the two are compared: surfaces that one image sees stretched or slanted lie flat then, and the
windows that are compared show the same. Offsets are those of `offsets`; *residuals* are what they exceed the
predicted ones by.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.search.offsets import INVALID, MEDIAN_SIDE, SUBPIXEL
from colmap_sph.stereo.search.ranges import MAX_DEPTH, SPARE, STEP, range_depth
from colmap_sph.stereo.search.seeds import Seeds, interpolated_disparity

# Predictions are the mean of those within this radius that differ by no more than so many pixels: of one surface.
_MEAN_RADIUS = 4
_MAX_STEP = 3
# Residuals, of the finer level, that a neighbourhood's range must leave free at either end of the pixel's, and
# those that the predicted offset must.
_CLEARANCE = 4
_OWN_CLEARANCE = 6
# Within 3 x 3 pixels of a coarser level, offsets on one surface differ by no more (in pixels of the finer one).
_MAX_SURFACE_STEP = 4
# Where less than this share of an image shows surfaces that are steeper than so many pixels of offset per pixel
# (and no edges), windows look alike without warping, which moves the edges of surfaces a little.
_STEEP = 0.3
_EDGE = 2.0
_FLAT_SHARE = 0.1
# Steps of the prediction from pixel to pixel that are larger than so many pixels tear windows apart, as far from
# them as a window reaches.
_TEAR = 3
_TORN_RADIUS = 4
# What the level above found nothing near, within so many of its pixels, is not matched: out of the other image's
# view, or occluded, it hardly ever finds anything.
_REACH = 8
# Steps to which what is interpolated between sparse points is rounded, so that its last bits do not count.
_SEED_STEPS = 16


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a level's pixels search.

    Attributes
    ----------
    offset : (H, W) int32 ndarray
        Predicted offset, 1/256 pixel.
    base : (H, W) int32 ndarray
        First residual to search, pixels.
    depth : int
        Number of residuals to search.
    exact : bool
        Neighbours with the same residual are of one surface, whatever their `base`. Else those are of which
        `first` differs by no more than a slope does, slot by slot: predictions may end where surfaces do.
    warps : bool
        Whether the right image is warped by `offset`; else that is zero.
    torn : (H, W) bool ndarray, optional
        Where the prediction tears windows apart: there the right image is searched as it is, from offset `base`.
    """

    offset: NDArray[np.int32]
    base: NDArray[np.int32]
    depth: int
    exact: bool = False
    warps: bool = True
    torn: NDArray[np.bool_] | None = None

    def rows(self, rows: slice) -> "Prediction":
        """What some of the rows search."""
        torn = None if self.torn is None else self.torn[rows]
        return replace(self, offset=self.offset[rows], base=self.base[rows], torn=torn)

    @property
    def first(self) -> NDArray[np.int32]:
        """(H, W) int32 first offset to search, pixels."""
        if not self.warps:
            return self.base
        first = np.empty_like(self.base)
        _native.first_offsets(self.offset, self.base, self.torn_bytes, first)
        return first

    @property
    def torn_bytes(self) -> NDArray[np.uint8]:
        """(H, W) uint8: 1 where windows are torn, else 0."""
        return np.zeros(self.base.shape, np.uint8) if self.torn is None else self.torn.view(np.uint8)

    @property
    def margin(self) -> int:
        """Columns of a warped image beyond the sides of the reference that are searched from inside of it."""
        return self.depth if self.warps else 0


def from_seeds(seeds: Seeds | None, shape: tuple[int, ...], level: int, low: int, high: int) -> Prediction:
    """What the coarsest level searches: the whole range, about what sparse points tell.

    Parameters
    ----------
    seeds : (n, 3) float32 ndarray, optional
        As of `seeds_of_points`. Without any, the middle of the range is predicted.
    shape : (int, int)
        Of the level.
    level : int
        Its pixels are 2 to the power of `level` of full resolution.
    low, high : int
        Least and most offset, pixels of the level.

    Returns
    -------
    Prediction
    """
    if seeds is None or not len(seeds):
        predicted = np.full(shape, (low + high) // 2, dtype=np.float32)
    else:
        predicted = -interpolated_disparity(seeds, shape, 2.0**level)
        predicted = np.clip(np.round(predicted * _SEED_STEPS) / _SEED_STEPS, low, high)
    # On either side as many as the range has at most: where predictions slope, residuals reach less far.
    reach = int(np.ceil(max(high - float(predicted.min()), float(predicted.max()) - low))) + SPARE
    depth = min(-(-(2 * reach + 1) // STEP) * STEP, MAX_DEPTH)
    return Prediction(_in_steps(predicted), np.full(shape, -depth // 2, dtype=np.int32), depth, exact=True)


def from_coarser(
    offset: NDArray[np.int32],
    prior: Prediction,
    shape: tuple[int, ...],
    depth: int,
    radius: int,
    offsets: tuple[int, int],
) -> Prediction:
    """What a level searches, from the offsets of the level above.

    Parameters
    ----------
    offset : (h, w) int32 ndarray
        Of the coarser level, 1/256 of its pixels.
    prior : Prediction
        Of the coarser level.
    shape : (int, int)
        (H, W) of the finer level: 2 h and 2 w, or one less.
    depth : int
        Number of residuals that a pixel searches.
    radius : int
        Of the neighbourhood whose offsets a pixel searches, too, pixels of the coarser level.
    offsets : (int, int)
        Least and most offset, pixels of the finer level.

    Returns
    -------
    Prediction
        Warps, unless hardly any surface is stretched or slanted.
    """
    own = _filled(offset, prior)
    predicted = _upsampled(2 * _mean_on_surfaces(own), shape)
    low, high = offsets
    np.clip(predicted, low * SUBPIXEL, high * SUBPIXEL, out=predicted)
    if is_flat(predicted):
        return about_coarser(offset, shape, depth, radius, offsets)
    least, most = _neighbourhood(own, radius)
    base = np.empty_like(predicted)
    _native.search_windows(least, most, predicted, depth, _CLEARANCE, _OWN_CLEARANCE, base)
    torn = torn_by(predicted)
    if not torn.any():
        return Prediction(predicted, base, depth)
    np.copyto(base, _windows_about(own, least, most, shape, depth, offsets), where=torn)
    return Prediction(predicted, base, depth, torn=torn)


def about_coarser(
    offset: NDArray[np.int32], shape: tuple[int, ...], depth: int, radius: int, offsets: tuple[int, int]
) -> Prediction:
    """What a level searches without warping."""
    valid = offset != INVALID
    if valid.any():
        own = _median(_fill_nearest(_in_pixels(offset), valid))
        base = _windows_about(own, *_neighbourhood(own, radius), shape, depth, offsets)
    else:
        base = np.full(shape, (sum(offsets) - depth) // 2, dtype=np.int32)
    return Prediction(np.zeros_like(base), base, depth, warps=False)


def _windows_about(
    own: NDArray[np.float32],
    least: NDArray[np.float32],
    most: NDArray[np.float32],
    shape: tuple[int, ...],
    depth: int,
    offsets: tuple[int, int],
) -> NDArray[np.int32]:
    """First offsets to search without warping, pixels: about the middle of each neighbourhood's offsets."""
    fits = 2 * (most - least) <= depth - 2 * _CLEARANCE
    # A little towards the neighbourhood's middle even where it does not fit.
    reach = np.float32((depth - 2 * _OWN_CLEARANCE) / 4)
    middle = (least + most) / 2
    centre = 2 * np.where(fits, middle, np.clip(middle, own - reach, own + reach))
    base = _upsampled(_in_steps(centre), shape)
    low, high = offsets
    first = low - SPARE
    _native.bases_about(base, depth, first, max(high + 1 + SPARE - depth, first))
    return base


def is_flat(predicted: NDArray[np.int32]) -> bool:
    """Whether hardly any surface is stretched or slanted."""
    # Slopes are taken over two pixels.
    surface, steep = _native.count_slopes(predicted, int(2 * _EDGE * SUBPIXEL), int(2 * _STEEP * SUBPIXEL))
    return steep <= _FLAT_SHARE * surface


def torn_by(predicted: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(H, W) bool: what lies as near to a step of the prediction as a window reaches."""
    steps = np.empty(predicted.shape, dtype=np.uint8)
    _native.mark_steps(predicted, _TEAR * SUBPIXEL, steps)
    return np.asarray(cv2.dilate(steps, np.ones((2 * _TORN_RADIUS + 1,) * 2, dtype=np.uint8))).view(np.bool_)


def near_matches(image: RectifiedImage, offset: NDArray[np.int32]) -> RectifiedImage:
    """The left image of a level without what is far from all that the level above found.

    Parameters
    ----------
    image : RectifiedImage
        (H, W).
    offset : (h, w) int32 ndarray
        Of the coarser level, see `from_coarser`.

    Returns
    -------
    RectifiedImage
    """
    near = cv2.dilate((offset != INVALID).view(np.uint8), np.ones((2 * _REACH + 1,) * 2, dtype=np.uint8))
    height, width = image.valid.shape
    finer = cv2.resize(near, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)[:height, :width]
    return replace(image, valid=np.asarray(cv2.multiply(image.valid, finer), dtype=np.uint8))


def searched_depth(low: int, high: int, most: int) -> int:
    """Number of residuals to search in a range of offsets, of which one knows where to look: `most`, or less."""
    return min(range_depth(low, high), most)


def _in_steps(offset: NDArray[np.float32]) -> NDArray[np.int32]:
    return np.round(offset * SUBPIXEL).astype(np.int32)


def _in_pixels(offset: NDArray[np.int32]) -> NDArray[np.float32]:
    return offset.astype(np.float32) * np.float32(1 / SUBPIXEL)


def _filled(offset: NDArray[np.int32], prior: Prediction) -> NDArray[np.float32]:
    """Offsets in pixels, without gaps or single outliers."""
    valid = offset != INVALID
    predicted = _in_pixels(prior.offset)
    if not valid.any():
        return predicted
    return _median(predicted + _fill_nearest(_in_pixels(offset) - predicted, valid))


def _median(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.medianBlur(values, MEDIAN_SIDE), dtype=np.float32)


def _mean_on_surfaces(offset: NDArray[np.float32]) -> NDArray[np.int32]:
    steps = _in_steps(offset)
    mean = np.empty_like(steps)
    _native.mean_offsets(backend(), steps, _MEAN_RADIUS, _MAX_STEP * SUBPIXEL, mean)
    return mean


def _neighbourhood(values: NDArray[np.float32], radius: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least and largest value within `radius` of every pixel."""
    window = np.ones((2 * radius + 1,) * 2, dtype=np.uint8)
    return np.asarray(cv2.erode(values, window)), np.asarray(cv2.dilate(values, window))


def _upsampled(offset: NDArray[np.int32], shape: tuple[int, ...]) -> NDArray[np.int32]:
    """At the next finer level's pixels, of which the offsets are: interpolated on surfaces, repeated at steps."""
    fine = np.empty(shape, dtype=np.int32)
    _native.upsample_offsets(backend(), offset, _MAX_SURFACE_STEP * SUBPIXEL, fine)
    return fine


def _fill_nearest(values: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Give pixels that are not valid the value of the nearest one that is."""
    _, labels = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Labels count the valid pixels, row by row, from 1.
    return np.asarray(values[valid][labels - 1], dtype=np.float32)
