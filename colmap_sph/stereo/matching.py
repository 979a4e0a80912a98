"""Rectified pair → disparity map: hierarchical semi-global matching.

Census (9 × 7) of the sharpened images, Hamming cost, aggregation along 8 paths (Hirschmüller 2008), left-right
check, sub-pixel fit without pixel locking, and removal of small segments, on an image pyramid with per-pixel
search ranges (Rothermel et al. 2012, "tSGM").
Every pixel searches the same number of disparities from a base of its own, so memory stays regular.

This module is the only caller of the matching kernels. Their convention is an *offset*, target column minus
reference column; with the left image as reference it is minus the disparity.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import OptionError
from colmap_sph.stereo.kernels import backend

_OFFSET_INVALID = np.iinfo(np.int32).min
_SUBPIXEL = 256  # offsets come in 1/256 pixel
_STEP = 32  # search ranges are multiples of this many disparities
_MAX_DEPTH = 1024
# Within 3 x 3 pixels of a coarser level, offsets on one surface differ by no more (in pixels of the finer one).
_MAX_SURFACE_STEP = 4
_CENSUS_BORDER = (3, 3, 4, 4)  # top, bottom, left, right
# Census compares 1/64 grey values, see CENSUS_MARGIN in `kernels.h`: on weak texture, whole ones are too coarse.
_CENSUS_STEPS = 64
# Unsharp masking, which gives back some of what lenses and resampling took away: so much of the difference from
# the binomial mean of 3 x 3 pixels is added.
_SHARPENING = 0.6
_BINOMIAL = np.outer((1, 2, 1), (1, 2, 1)) / 16
_UNSHARP = _CENSUS_STEPS * ((1 + _SHARPENING) * np.outer((0, 1, 0), (0, 1, 0)) - _SHARPENING * _BINOMIAL)
_BYTES_PER_SLOT = 2  # of a level's volumes of costs and of forward paths
# Offsets that differ from the median around them by no more (pixels) are noise; what differs by more may be
# another surface, and is left to the filter of small segments.
_MAX_NOISE = 2
# Pixel locking makes whole pixels come more often than others by no more than this share; see `_evening_shifts`.
_MAX_LOCKING = 0.15
_SHIFT_STEPS = 4096
_BEYOND = np.float32(1e9)  # what no offset reaches


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
    """Intensity difference (grey values) at which the penalty has fallen halfway to `p2_min`."""
    disparities: int = 32
    """Disparities searched per pixel at full resolution; a multiple of 32."""
    coarse_disparities: int = 64
    """Disparities searched per pixel at the levels between the coarsest and the finest; a multiple of 32."""
    max_coarsest_disparities: int = 128
    """The pyramid grows until the whole range has no more disparities than this at the coarsest level."""
    range_radius: int = 4
    """Radius, in pixels of the coarser level, of the neighbourhood whose disparities a pixel searches."""
    max_slant: int = 3
    """Search ranges of neighbours that are at most this many pixels apart follow the slope of one surface."""
    max_left_right_difference: int = 2
    """Largest difference, in pixels, between the matches found from the left and from the right image."""
    max_left_right_excess: int = 4
    """A match beyond `max_left_right_difference` is kept all the same when its aggregated cost (half the sum over
    8 paths, census bits) exceeds that of the right pixel's best match by no more than this; 255 keeps all."""
    max_coarse_left_right_excess: int = 48
    """The same above full resolution, where matches only say where to search."""
    min_segment: int = 200
    """Connected regions of fewer pixels than this are removed at full resolution."""
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
            if not _STEP <= value <= _MAX_DEPTH or value % _STEP:
                message = f"{name} must be a multiple of {_STEP} up to {_MAX_DEPTH}, not {value}."
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


class Scratch:
    """Working memory of one matching thread, kept from level to level and from pair to pair.

    Parameters
    ----------
    max_bytes : int
        Levels that need more are worked in bands of rows, with the same result. One row is the least.
    """

    def __init__(self, max_bytes: int = 1 << 30) -> None:
        self.max_bytes = max_bytes
        self._memory = np.empty(0, dtype=np.uint8)

    def volume(self, shape: tuple[int, ...], depth: int) -> NDArray[np.uint8]:
        """(2, pixels, depth) uint8 array for an image or for as many of its rows as `max_bytes` allow."""
        height, width = shape
        rows = min(max(self.max_bytes // (_BYTES_PER_SLOT * width * depth), 1), height)
        size = _BYTES_PER_SLOT * rows * width * depth
        if size > self._memory.size:
            self._memory = np.empty(0, dtype=np.uint8)  # the old one goes first
            self._memory = np.empty(size, dtype=np.uint8)
        return self._memory[:size].reshape(_BYTES_PER_SLOT, rows * width, depth)


@dataclass(frozen=True, eq=False)
class RectifiedImage:
    """One image of a rectified pair: (H, W) float32 grey values (0..255), and 255 where they are image content."""

    image: NDArray[np.float32]
    valid: NDArray[np.uint8]


def match_pair(
    left: RectifiedImage,
    right: RectifiedImage,
    min_disparity: float,
    max_disparity: float,
    options: MatchingOptions,
    scratch: Scratch | None = None,
) -> NDArray[np.float32]:
    """Match the left image of a rectified pair in the right one.

    Parameters
    ----------
    left, right : RectifiedImage
        Same height; widths may differ.
    min_disparity, max_disparity : float
        Range to search, pixels; disparity = left column − right column.
    options : MatchingOptions
    scratch : Scratch, optional
        Working memory to use again.

    Returns
    -------
    (H, W) float32 ndarray
        Disparity of every left pixel, pixels; NaN where there is none or where the two directions disagree.

    References
    ----------
    H. Hirschmüller, Stereo processing by semiglobal matching and mutual information, PAMI 2008,
    doi:10.1109/TPAMI.2007.1166. M. Rothermel et al., SURE: photogrammetric surface reconstruction from imagery,
    LC3D Workshop 2012.
    """
    scratch = scratch or Scratch()
    least, most = int(np.floor(-max_disparity)) - 1, int(np.ceil(-min_disparity)) + 1
    levels = _num_levels(most - least, min(left.image.shape + right.image.shape), options)
    lefts, rights = _pyramid(left, levels), _pyramid(right, levels)
    del left, right  # each level goes when it has been matched
    offset: NDArray[np.int32] | None = None
    for level in range(levels, -1, -1):
        low, high = least >> level, -(-most >> level)
        shape, depth = lefts[-1].image.shape, min(_round_up(high - low + 3), _MAX_DEPTH)
        if offset is None:
            base = np.full(shape, low - 1, dtype=np.int32)
        else:
            depth = min(depth, options.disparities if level == 0 else options.coarse_disparities)
            base = _propagate(offset, shape, depth, low, high, options)
        offset = _match_level(lefts.pop(), rights.pop(), base, depth, options, scratch, finest=level == 0)
        if level > 0 or options.median_filter:
            _smooth(offset)
        _remove_small_segments(offset, max(options.min_segment >> level, 4))
    assert offset is not None
    disparity = offset.astype(np.float32)
    disparity *= np.float32(-1 / _SUBPIXEL)
    disparity -= _evening_shifts(offset)[offset & (_SUBPIXEL - 1)]
    disparity[offset == _OFFSET_INVALID] = np.nan
    return disparity


def _round_up(count: int) -> int:
    return -(-count // _STEP) * _STEP


def _num_levels(disparities: int, size: int, options: MatchingOptions) -> int:
    """Levels above full resolution: until the range is short, but never images under 32 pixels."""
    levels = 0
    while (disparities >> levels) + 3 > options.max_coarsest_disparities and (size >> levels) >= 64:
        levels += 1
    return max(levels, 2 if size >= 256 else 0)


def _pyramid(image: RectifiedImage, levels: int) -> list[RectifiedImage]:
    """Full resolution first. Odd rows and columns are doubled, so that pixel x of a level covers 2x, 2x + 1."""
    pyramid = [image]
    for _ in range(levels):
        pixels, valid = pyramid[-1].image, pyramid[-1].valid
        height, width = pixels.shape
        border = (0, height % 2, 0, width % 2)
        if height % 2 or width % 2:
            pixels = _with_border(pixels, border, cv2.BORDER_REPLICATE)
            valid = _with_border(valid, border, cv2.BORDER_CONSTANT)
        half = ((width + 1) // 2, (height + 1) // 2)
        coarse_valid = cv2.resize(valid, half, interpolation=cv2.INTER_AREA)
        pyramid.append(
            RectifiedImage(
                np.asarray(cv2.resize(pixels, half, interpolation=cv2.INTER_AREA), dtype=np.float32),
                np.where(coarse_valid >= 128, np.uint8(255), np.uint8(0)),
            )
        )
    return pyramid


def _with_border(image: NDArray[Any], border: tuple[int, int, int, int], kind: int) -> NDArray[Any]:
    """The image with rows and columns added at its top, bottom, left and right."""
    return np.asarray(cv2.copyMakeBorder(image, *border, kind, value=0))


def _census(image: RectifiedImage) -> NDArray[np.uint64]:
    sharp = cv2.filter2D(image.image, cv2.CV_32F, _UNSHARP, borderType=cv2.BORDER_REPLICATE).astype(np.int16)
    padded = _with_border(sharp, _CENSUS_BORDER, cv2.BORDER_REPLICATE)
    census = np.empty(image.image.shape, dtype=np.uint64)
    _native.census(backend(), padded, np.ascontiguousarray(image.valid), census)
    return census


def _match_level(
    left: RectifiedImage,
    right: RectifiedImage,
    base: NDArray[np.int32],
    depth: int,
    options: MatchingOptions,
    scratch: Scratch,
    *,
    finest: bool,
) -> NDArray[np.int32]:
    """Offsets of one level, 1/256 pixel; those of the finest are refined from the raw costs."""
    kernels = backend()
    left_census, image = _census(left), np.asarray(cv2.convertScaleAbs(left.image), dtype=np.uint8)
    del left
    right_census = _census(right)
    del right
    offset = np.empty(base.shape, dtype=np.int32)
    _native.match(
        kernels,
        left_census,
        right_census,
        base,
        image,
        options.p1,
        _p2_table(options),
        options.max_slant,
        options.max_left_right_difference,
        options.max_left_right_excess if finest else options.max_coarse_left_right_excess,
        scratch.volume(base.shape, depth),
        offset,
    )
    if not finest:
        return offset
    refined = np.empty_like(offset)
    _native.refine_offsets(kernels, offset, left_census, right_census, refined)
    return refined


def _p2_table(options: MatchingOptions) -> NDArray[np.uint8]:
    """P2 by absolute intensity difference: hyperbolic decay from `p2` to `p2_min`."""
    contrast = np.arange(256)
    p2 = options.p2_min + (options.p2 - options.p2_min) / (1 + contrast / options.p2_contrast)
    return np.round(p2).astype(np.uint8)


def _smooth(offset: NDArray[np.int32]) -> None:
    """Replace offsets, in place, by the median of 5 x 5 pixels where that is near.

    Neighbours without an offset count by turns as least and as most, so that they do not shift it.
    """
    values, invalid = offset.astype(np.float32), offset == _OFFSET_INVALID
    turns = np.where(np.arange(offset.shape[1]) % 2, _BEYOND, -_BEYOND)
    np.copyto(values[::2], turns, where=invalid[::2])
    np.copyto(values[1::2], -turns, where=invalid[1::2])
    median = np.asarray(cv2.medianBlur(values, 5), dtype=np.float32)
    values -= median
    near = np.abs(values, out=values) <= _MAX_NOISE * _SUBPIXEL
    np.copyto(offset, median, where=near & ~invalid, casting="unsafe")


def _remove_small_segments(offset: NDArray[np.int32], min_segment: int) -> None:
    """Invalidate, in place, connected regions smaller than `min_segment` pixels."""
    if min_segment < 2:
        return
    valid = offset != _OFFSET_INVALID
    # cv2.filterSpeckles works on 16 bits: quarter pixels hold ranges of 8,000 pixels around the middle.
    quarters = offset // (_SUBPIXEL // 4)
    quarters -= int(np.median(quarters[::4][valid[::4]])) if valid[::4].any() else 0
    small = np.clip(quarters, -32000, 32000, out=quarters).astype(np.int16)
    small[~valid] = -32768
    cv2.filterSpeckles(small, -32768, min_segment - 1, 4)
    offset[small == -32768] = _OFFSET_INVALID


def _evening_shifts(offset: NDArray[np.int32]) -> NDArray[np.float32]:
    """What to add to an offset, pixels, by its fraction, so that all fractions come about equally often.

    Fine texture draws matches to whole pixels ("pixel locking"), by some hundredths of a pixel. Fractions that are
    uneven in another way are the scene's own, of surfaces that both cameras face, and stay.
    """
    counts = np.bincount(offset[offset != _OFFSET_INVALID] & (_SUBPIXEL - 1), minlength=_SUBPIXEL)
    turn = 2 * np.pi * np.arange(_SUBPIXEL) / _SUBPIXEL
    # The density is about 1 + a cos + b sin. Locking has no b: so much of a may be the scene's, too.
    a, b = (2 * (counts @ wave) / max(counts.sum(), 1) for wave in (np.cos(turn), np.sin(turn)))
    locking = np.clip(a - abs(b), 0, _MAX_LOCKING) * np.clip(2 - np.hypot(a, b) / _MAX_LOCKING, 0, 1)
    # The density's integral says where a fraction ought to be.
    shift = locking * np.sin(turn) / (2 * np.pi)
    # In steps, so that the last bit of a sine does not make results differ between processors.
    return np.asarray(np.round(shift * _SHIFT_STEPS) / _SHIFT_STEPS, dtype=np.float32)


def _propagate(
    offset: NDArray[np.int32],
    shape: tuple[int, ...],
    depth: int,
    low: int,
    high: int,
    options: MatchingOptions,
) -> NDArray[np.int32]:
    """First offset to search for each pixel of the next finer level, from the offsets of a level.

    A pixel searches around the middle of its neighbourhood's offsets where they fit into `depth`, else around
    its own; pixels without an offset take the nearest pixel's.
    """
    valid = offset != _OFFSET_INVALID
    if not valid.any():
        return np.full(shape, (low + high - depth) // 2, dtype=np.int32)
    filled = _fill_nearest(offset.astype(np.float32) * np.float32(1 / _SUBPIXEL), valid)
    own = np.asarray(cv2.medianBlur(filled, 5), dtype=np.float32)
    least, most = _neighbourhood(own, options.range_radius)
    fits = 2 * (most - least) <= depth - 8
    # A little towards the neighbourhood's middle even where it does not fit.
    reach = np.float32((depth - 12) / 4)
    middle = (least + most) / 2
    centre = 2 * np.where(fits, middle, np.clip(middle, own - reach, own + reach))
    fine = np.round(_upsample(centre, shape) - depth / 2).astype(np.int32)
    return np.clip(fine, low - 1, max(high + 2 - depth, low - 1))


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
