"""Rectified pair → disparity map: hierarchical semi-global matching.

Census (9 × 7) and grey values of the sharpened images, Hamming cost, aggregation along 8 paths (Hirschmüller
2008), comparison of the matches from left and from right, sub-pixel fit without pixel locking, and removal of
small segments, on an image pyramid, each level about what the one above it predicts (Rothermel et al. 2012,
"tSGM"; see `prediction`).

This module and `prediction` are the only callers of the matching kernels. Their convention is an *offset*, target
column minus reference column; with the left image as reference it is minus the disparity.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import OptionError
from colmap_sph.stereo.census import Compared, RectifiedImage, pyramid
from colmap_sph.stereo.search.bands import BandMatcher, Level, Limits, Scratches, match_whole, scratch_bytes
from colmap_sph.stereo.search.brightness import equally_bright
from colmap_sph.stereo.search.offsets import INVALID, SUBPIXEL, remove_small_segments, smooth, to_disparity
from colmap_sph.stereo.search.prediction import (
    Prediction,
    from_coarser,
    from_seeds,
    near_matches,
    searched_depth,
)
from colmap_sph.stereo.search.ranges import MAX_DEPTH, SPARE, STEP, num_levels
from colmap_sph.stereo.search.seeds import Seeds
from colmap_sph.stereo.search.target import Matches

# Segments of fewer pixels than this are removed at every level, however coarse.
_LEAST_SEGMENT = 4
# Sky is searched for where what is infinitely far away is no farther from the range than this share of its width:
# nearer scenes, such as rooms, seldom see any, and find less on weak texture if more is searched.
_NEAR_RANGE = 0.1
# What poses that are not exact may add to the disparity of what is infinitely far away, pixels.
_POSE_ERROR = 4


@dataclass(frozen=True)
class MatchingOptions:
    """How rectified images are matched."""

    p1: int = 15
    """Penalty for a disparity change of one pixel between neighbours, in census bits."""
    p2: int = 80
    """Penalty for larger changes in smooth image regions, in census bits."""
    p2_min: int = 30
    """Penalty for larger changes across strong intensity edges."""
    p2_contrast: int = 2
    """Difference of neighbours in the left image, grey values, at which P2 has fallen halfway to `p2_min`."""
    disparities: int = 32
    """Disparities searched per pixel, about the predicted one, at full resolution; a multiple of 32."""
    coarse_disparities: int = 64
    """Disparities searched per pixel, about the predicted one, at the levels between the coarsest, which searches
    the whole range, and the finest; a multiple of 32."""
    max_coarsest_disparities: int = 128
    """The pyramid grows until the whole range has no more disparities than this at the coarsest level."""
    range_radius: int = 2
    """Radius, in pixels of the coarser level, of the neighbourhood whose disparities a pixel searches, too, where
    they fit."""
    max_slant: int = 3
    """Below the coarsest level, neighbours whose search ranges begin at most this many pixels apart follow the
    slope of one surface, which costs nothing."""
    max_left_right_difference: int = 2
    """Largest distance, in columns of the left image, from a pixel to the best match of the right pixel at which
    it was found."""
    max_left_right_excess: int = 4
    """A match beyond `max_left_right_difference` is kept all the same when its aggregated cost (half the sum over
    8 paths, census bits) exceeds that of the right pixel's best match by no more than this; 255 keeps all."""
    max_coarse_left_right_excess: int = 48
    """The same above full resolution, where matches only say where to search."""
    min_segment: int = 200
    """Connected regions of fewer pixels than this are removed at full resolution."""
    keep_blank: bool = False
    """Match also what varies by no more than the image's noise, such as clear sky and blown-out walls, and what
    stands still while the camera turns, such as a backdrop; else it is ignored, as if under a mask, and in places
    such as clouds depths are dropped that stand alone."""
    median_filter: bool = False
    """Take the median of 5 x 5 disparities at full resolution, as is done above it. Depth from many pairs is
    better without: how rough a disparity map is tells the vote how far to trust it."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        for name, most in (("p1", 63), ("p2", 127)):
            if not 0 <= getattr(self, name) <= most:
                raise OptionError(f"{name} must lie in 0..{most}, not {getattr(self, name)}.", name)
        if not self.p1 <= self.p2_min <= self.p2:
            raise OptionError(
                f"p2_min must lie between p1 ({self.p1}) and p2 ({self.p2}), not {self.p2_min}.",
                "p2_min",
                "p1",
                "p2",
            )
        if self.p2_contrast < 1:
            raise OptionError(f"p2_contrast must be at least 1, not {self.p2_contrast}.", "p2_contrast")
        for name in ("disparities", "coarse_disparities", "max_coarsest_disparities"):
            value = getattr(self, name)
            if not STEP <= value <= MAX_DEPTH or value % STEP:
                message = f"{name} must be a multiple of {STEP} up to {MAX_DEPTH}, not {value}."
                raise OptionError(message, name)
        limits = {
            "range_radius": 50,
            "max_left_right_difference": 100,
            "max_left_right_excess": 255,
            "max_coarse_left_right_excess": 255,
        }
        for name, most in limits.items():
            if not 0 <= getattr(self, name) <= most:
                raise OptionError(f"{name} must lie in 0..{most}, not {getattr(self, name)}.", name)
        for name in ("max_slant", "min_segment"):
            if getattr(self, name) < 0:
                raise OptionError(f"{name} must not be negative, not {getattr(self, name)}.", name)


SINGLE_PAIR = MatchingOptions(max_left_right_excess=56, min_segment=150, median_filter=True)
"""For a pair alone, whose gaps no other pair fills and whose noise no vote finds."""


def pair_scratch_bytes(pixels: int, options: MatchingOptions) -> int:
    """Scratch memory that matching fills where it may: its finest levels need most.

    A left image has so many pixels; each level above it a quarter of those of the one below.
    """
    return scratch_bytes(pixels, max(options.disparities, options.coarse_disparities // 4))


def match_pair(
    left: RectifiedImage,
    right: RectifiedImage,
    min_disparity: float,
    max_disparity: float,
    options: MatchingOptions,
    scratches: Scratches | None = None,
    *,
    infinity: float | None = None,
    seeds: Seeds | None = None,
    fine: bool = False,
) -> NDArray[np.float32]:
    """Match the left image of a rectified pair in the right one.

    Parameters
    ----------
    left, right : RectifiedImage
        Same height; widths may differ.
    min_disparity, max_disparity : float
        Range to search, pixels; disparity = left column − right column.
    options : MatchingOptions
    scratches : Scratches, optional
        Working memory to use again.
    infinity : float, optional
        Disparity of what is infinitely far away. Where the range nearly reaches it, matches are searched up to
        there, and those beyond `min_disparity` dropped: clouds would else be matched to whatever looks most like
        them in the range.
    seeds : (n, 3) float32 ndarray, optional
        Left column, left row and disparity, pixels, of what is known to match, see `seeds_of_points`.
    fine : bool
        The images hold as much as their pixels can: at full resolution, near neighbours count more in census
        windows. Where the texture is coarser, or weak, less is found so. See `is_fine`.

    Returns
    -------
    (H, W) float32 ndarray
        Disparity of every left pixel, pixels; NaN where there is none or where the two directions disagree.

    Examples
    --------
    Noise that lies 5 columns further left in the right image:

    >>> texture = np.random.default_rng(0).uniform(0, 255, (64, 105)).astype(np.float32)
    >>> valid = np.full((64, 100), 255, np.uint8)
    >>> left = RectifiedImage(np.ascontiguousarray(texture[:, :100]), valid)
    >>> right = RectifiedImage(np.ascontiguousarray(texture[:, 5:]), valid)
    >>> disparity = match_pair(left, right, min_disparity=0, max_disparity=10, options=MatchingOptions())
    >>> round(float(np.nanmedian(disparity)), 2)
    5.0

    References
    ----------
    H. Hirschmüller, Stereo processing by semiglobal matching and mutual information, PAMI 2008,
    doi:10.1109/TPAMI.2007.1166. M. Rothermel et al., SURE: photogrammetric surface reconstruction from imagery,
    LC3D Workshop 2012.
    """
    scratches = scratches or Scratches()
    least = int(np.floor(-max_disparity)) - 1
    most = int(np.ceil(-min_disparity)) + 1
    size = min(left.image.shape + right.image.shape)
    levels = num_levels(most - least, size, options.max_coarsest_disparities)
    farthest = most
    sky = _sky_offset(min_disparity, max_disparity, infinity)
    if sky is not None:
        most = int(np.ceil(sky)) + _POSE_ERROR
    lefts = pyramid(left, levels)
    rights = pyramid(right, levels)
    del left, right  # each level goes when it has been matched
    offset: NDArray[np.int32] | None = None
    for level in range(levels, -1, -1):
        low, high = least >> level, -(-most >> level)
        shape = lefts[-1].image.shape
        most_searched = options.disparities if level == 0 else options.coarse_disparities
        depth = searched_depth(low, high, MAX_DEPTH if offset is None else most_searched)
        if offset is None:
            prediction = from_seeds(seeds, shape, level, low, high)
        else:
            scratches.prepare(math.prod(shape), depth)
            prediction = from_coarser(offset, prediction, shape, depth, options.range_radius, (low, high))
            lefts[-1] = near_matches(lefts[-1], offset)
        others: Prediction | None = None
        if offset is None and level > 0 and seeds is not None and len(seeds):
            others = from_seeds(None, shape, level, low, high)
        offset = _match_level(
            lefts.pop(), rights.pop(), prediction, others, offset, options, scratches, finest=level == 0, fine=fine
        )
        # Windows about predictions reach further.
        last = max(high + SPARE, low - SPARE + depth - 1)
        _native.keep_between(offset, (low - SPARE) * SUBPIXEL, last * SUBPIXEL)
        if sky is not None:
            _drop_beyond(offset, farthest, sky, level)
        if level > 0 or options.median_filter:
            smooth(offset)
        remove_small_segments(offset, max(options.min_segment >> level, _LEAST_SEGMENT))
    assert offset is not None
    return to_disparity(offset)


def _sky_offset(min_disparity: float, max_disparity: float, infinity: float | None) -> float | None:
    """Offset of what is infinitely far away, pixels, where that is to be searched for."""
    if infinity is None:
        return None
    beyond = min_disparity - infinity
    return -infinity if 0 < beyond <= _NEAR_RANGE * (max_disparity - min_disparity) else None


def _drop_beyond(offset: NDArray[np.int32], farthest: int, sky: float, level: int) -> None:
    """Invalidate, in place, a level's offsets beyond the farthest of the range.

    Above full resolution those of the sky stay, so that the next level searches there; `farthest` and `sky` are in
    pixels of full resolution.
    """
    pixel = SUBPIXEL / 2**level
    beyond = offset > farthest * pixel
    if level > 0:
        beyond &= np.abs(offset - sky * pixel) > SUBPIXEL + _POSE_ERROR * pixel
    offset[beyond] = INVALID


def _match_level(
    left: RectifiedImage,
    right: RectifiedImage,
    prediction: Prediction,
    others: Prediction | None,
    coarser: NDArray[np.int32] | None,
    options: MatchingOptions,
    scratches: Scratches,
    *,
    finest: bool,
    fine: bool,
) -> NDArray[np.int32]:
    """Offsets of one level; those of the finest with a sub-pixel fit to the raw costs.

    Those of `others`, where another prediction is tried, too, and better.
    """
    scratches.prepare(left.image.size, prediction.depth)
    grey = np.asarray(cv2.convertScaleAbs(left.image), dtype=np.uint8)
    compared = Compared(fine and finest)
    if coarser is not None:
        left, grey_step = equally_bright(left, right, coarser)
        compared = Compared(fine and finest, grey_step)
    limits = Limits(
        options.p1,
        _p2_table(options),
        0 if prediction.exact else options.max_slant,
        options.max_left_right_difference,
        options.max_left_right_excess if finest else options.max_coarse_left_right_excess,
    )
    level = Level(left, right, grey, prediction, compared)
    del left, right
    if others is not None:
        unseeded = _matches(replace(level, prediction=others), limits, scratches)
        return _matches(level, limits, scratches).or_better(unseeded)
    if _is_large(level, scratches):
        return BandMatcher(level, limits, scratches).offset(fit=finest)
    return _matches(level, limits, scratches, fit=finest).offset


def _is_large(level: Level, scratches: Scratches) -> bool:
    return scratches.is_large(level.grey.size, level.prediction.depth)


def _matches(level: Level, limits: Limits, scratches: Scratches, *, fit: bool = False) -> Matches:
    """Matches of a level, with all that is compared."""
    large = BandMatcher(level, limits, scratches).target_offset() if _is_large(level, scratches) else None
    with scratches.lent() as scratch:
        rows = level.rows(0, len(level.grey), scratch.targets)
        offset = match_whole(rows, limits, scratch) if large is None else large
        matches = Matches(rows.target, rows.left_census, rows.fitted(offset) if fit else offset)
        _ = matches.offset  # while the target is there
    return matches


def _p2_table(options: MatchingOptions) -> NDArray[np.uint8]:
    """P2 by absolute intensity difference: hyperbolic decay from `p2` to `p2_min`."""
    contrast = np.arange(256)
    p2 = options.p2_min + (options.p2 - options.p2_min) / (1 + contrast / options.p2_contrast)
    return np.round(p2).astype(np.uint8)
