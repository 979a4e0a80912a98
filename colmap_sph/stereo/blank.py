"""Which pixels of an image say nothing or little: clear or cloudy sky, blown-out or evenly painted walls.

What two images show of such a place is noise, or a shade that changes so slowly that it fits everywhere. What is
matched there is made up, mostly by what stands beside it, and neighbouring images make up the same.

Noise and texture differ by their scale: in an image of half the size noise is about half as strong, while the
texture of surfaces is as strong or stronger. So a place is blank where at no scale anything varies by more than
the image's own noise would. Where something varies at coarse scales only, as in clouds, pixels are *faint*:
they are matched, as many walls are no different, but a depth here and there in such a place counts for nothing.
"""

import math
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.stereo.resampling import half_size

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]

# Scales, each of half the size of the one before it: three, and a fourth in images whose shorter side has at least
# so many pixels. At the coarsest a window covers 28 or 56 pixels.
_LEVELS = 3
_FOUR_LEVELS_SIDE = 336
# Side of the window that is looked at, pixels of any scale.
_SIDE = 7
# Images with a shorter side than this hold no window of the coarsest scale that could be trusted.
_LEAST_SIDE = 128
# Noise is measured at half size, where JPEG has spared it, as what varies least: this percentile of windows, at
# least what the rounding of JPEG may leave, at most what cameras make in good light.
_NOISE_LEVEL = 1
_QUIETEST = 5
_LEAST_NOISE = 0.5
_USUAL_NOISE = 1.5
# In poor light they make more, up to this. Its variance falls to a quarter from full to half size, while that of
# texture stays or grows: so noise has no more variance at half size than was lost on the way there.
_MOST_NOISE = 5.0
# Local noise is the least of so many by so many pixels of the coarsest scale: some of them may hold an edge.
_LOCAL_SIDE = 5
# Windows with more than a few pixels of so little or so much light are left out of that: their noise is cut off.
_LEAST_GREY = 5
_MOST_GREY = 250
_CUT_SHARE = 0.05
# What noise may reach in a window, in that of the quietest ones. It falls by half from scale to scale, after the
# rounding of JPEG a little less.
_MARGIN = 1.4
_FALL = 0.56
# JPEG rounds the mean of 8 x 8 pixels to multiples of an eighth of its step: so far from the truth may it be, in
# steps. The slower waves in its blocks are rounded about as coarsely.
_ROUNDING = 1 / 16
# A blank region reaches beyond its coarse windows, which take in what is around it: by so many pixels of the next
# coarser scale, …
_REACH = 2
# … and at full resolution by so many that look alike: whose grey values differ from its own by less than so many
# times the noise, or than this share of the largest difference nearby. Windows there hold the edge of what stands
# before it.
_EDGE_REACH = 4
_ALIKE = 4.0
_EDGE_SHARE = 0.33
# Within so many pixels around a pixel is what stands before it.
_CONTRAST_REACH = 2
# Pixels are faint that show no more than noise at so many scales, where a window covers up to 14 pixels.
_FAINT_LEVELS = 2
# Of the faint pixels within so many pixels around a depth at least this share must have one: what stands before
# faint places spreads into them by some pixels.
_PLACE = 64
_LEAST_FOUND = 0.2
# Rows that are worked on at a time, to bound the memory.
_BAND_ROWS = 256


def blank_pixels(image: NDArray[np.uint8] | Float, jpeg_step: int = 1) -> Mask:
    """Find the pixels that say nothing.

    Parameters
    ----------
    image : (H, W) uint8 or float32 ndarray
        Grey values, 0..255.
    jpeg_step : int
        To what multiples JPEG has rounded it, see `rounding_step`; 1 for other images.

    Returns
    -------
    (H, W) uint8 ndarray
        1 where a pixel is blank, else 0. Images with a side of less than 128 pixels have no such pixels.

    Examples
    --------
    A textured wall below a sky that gets darker upwards, both with noise:

    >>> rng = np.random.default_rng(0)
    >>> picture = 120 + 300 * cv2.GaussianBlur(rng.standard_normal((200, 300)), (0, 0), 3)
    >>> picture[:100] = np.linspace(180, 220, 100)[:, None]
    >>> picture += rng.standard_normal(picture.shape)
    >>> blank = blank_pixels(picture.astype(np.float32))
    >>> float(blank[:96].mean()), float(blank[104:].mean())
    (1.0, 0.0)
    """
    levels = _LEVELS + (min(image.shape) >= _FOUR_LEVELS_SIDE)
    return _silent_pixels(image, jpeg_step, levels, is_local=True)


def faint_pixels(image: NDArray[np.uint8] | Float, jpeg_step: int = 1) -> Mask:
    """Find the pixels that show no more than noise at two scales: they hold no texture finer than 14 pixels.

    Blank pixels are among them. Others may be walls that are matched rightly, by what they show more coarsely.

    Parameters
    ----------
    image, jpeg_step
        As for `blank_pixels`.

    Returns
    -------
    (H, W) uint8 ndarray
        1 where a pixel is faint, else 0.
    """
    return _silent_pixels(image, jpeg_step, _FAINT_LEVELS, is_local=False)


def faint_rays(faint: Mask) -> Mask:
    """Which rays of a depth map meet a faint pixel.

    They pass through the upper left corners of pixels (see `pixel origin` in docs/algorithm.md), where four meet:
    along silhouettes, the ray of a pixel that shows what stands in front may well belong to what is behind it.

    Parameters
    ----------
    faint : (H, W) uint8 ndarray
        Faint pixels of an image, see `faint_pixels`.

    Returns
    -------
    (H, W) uint8 ndarray
        1 where any of the four pixels is faint, else 0.

    Examples
    --------
    >>> pixels = np.zeros((3, 4), np.uint8)
    >>> pixels[1, 1] = 1
    >>> faint_rays(pixels)
    array([[0, 0, 0, 0],
           [0, 1, 1, 0],
           [0, 1, 1, 0]], dtype=uint8)
    """
    return np.asarray(cv2.dilate(faint, np.ones((2, 2), np.uint8), anchor=(1, 1)), dtype=np.uint8)


def drop_scattered(depth: Float, faint: Mask) -> None:
    """Set depths to 0, in place, that stand for too little of a faint place.

    A faint wall is found nearly whole or not at all. In a cloudy sky, only what stands before it has a depth, and
    that reaches some pixels into the sky.

    Parameters
    ----------
    depth : (H, W) float32 ndarray
        0 = none.
    faint : (H, W) uint8 ndarray
        See `faint_rays`.
    """
    if not faint.any():
        return
    window = (2 * _PLACE + 1,) * 2
    is_found = (depth > 0) & (faint > 0)
    dropped = np.empty_like(is_found)
    for band, wide, inner in _bands(len(depth), _PLACE):
        place = cv2.blur(faint[wide].astype(np.float32), window)
        found = cv2.blur(is_found[wide].astype(np.float32), window)
        dropped[band] = (is_found[wide] & (found < _LEAST_FOUND * place))[inner]
    depth[dropped] = 0


def _silent_pixels(image: NDArray[np.uint8] | Float, jpeg_step: int, levels: int, *, is_local: bool) -> Mask:
    """1 where at none of so many scales anything varies by more than noise: than that nearby, or in the image."""
    if min(image.shape) < _LEAST_SIDE:
        return np.zeros(image.shape, np.uint8)
    scales = [image.astype(np.float32, copy=False)]
    while len(scales) < levels:
        scales.append(half_size(scales[-1]))
    variance = _variances(scales[_NOISE_LEVEL])
    noise = _noise(scales, variance)
    rounding = _ROUNDING * jpeg_step
    bounds = [_MARGIN * max(noise * _FALL ** (level - _NOISE_LEVEL), rounding) for level in range(levels)]
    coarsest: float | Float = bounds[-1]
    if is_local:
        coarsest = bounds[-1] / noise * _local_noise(noise, variance, scales[-1].shape)
    known: list[Float | None] = [variance if level == _NOISE_LEVEL else None for level in range(levels)]
    silent = _quiet(scales[-1], coarsest, known[-1])
    for scale, bound, its_variance in zip(scales[-2::-1], bounds[-2::-1], known[-2::-1], strict=True):
        if not silent.any():
            return np.zeros(image.shape, np.uint8)
        silent = _next_finer(silent, scale.shape) & _quiet(scale, bound, its_variance)
    return _with_edges(scales[0], silent, noise)


def _next_finer(blank: Mask, shape: tuple[int, ...]) -> Mask:
    """A scale's mask, with its reach, in pixels of the next finer scale."""
    grown = cv2.dilate(blank, np.ones((2 * _REACH + 1,) * 2, np.uint8))
    doubled = cv2.resize(grown, (2 * blank.shape[1], 2 * blank.shape[0]), interpolation=cv2.INTER_NEAREST)
    return np.asarray(doubled[: shape[0], : shape[1]], dtype=np.uint8)


def _quiet(image: Float, bound: float | Float, variance: Float | None) -> Mask:
    """1 where any window that holds the pixel varies by no more than `bound`: others may hold something else.

    `variance` is the image's, see `_variances`, where it is known.
    """
    quiet = np.empty(image.shape, np.uint8)
    limit = np.broadcast_to(np.square(bound), image.shape)
    for band, wide, inner in _bands(image.shape[0], _SIDE):
        found = _variance(image[wide])[inner] if variance is None else variance[band]
        quiet[band] = found <= limit[band]
    return np.asarray(cv2.dilate(quiet, np.ones((_SIDE, _SIDE), np.uint8)), dtype=np.uint8)


def _bands(height: int, margin: int) -> Iterator[tuple[slice, slice, slice]]:
    """Bands of rows: the band, the same with a margin, and where in that the band lies."""
    for first in range(0, height, _BAND_ROWS):
        end = min(first + _BAND_ROWS, height)
        start = max(first - margin, 0)
        yield slice(first, end), slice(start, min(end + margin, height)), slice(first - start, end - start)


def _steps(image: Float, axis: int) -> Float:
    """Differences of neighbours along an axis, over √2: as large as the noise of a pixel."""
    step = np.zeros(image.shape, np.float32)
    along, there = (part.swapaxes(0, axis) for part in (image, step))
    np.subtract(along[1:], along[:-1], out=there[:-1])
    step *= np.float32(np.sqrt(0.5))
    return step


def _variance(image: Float) -> Float:
    """Variance of steps in the window around each pixel, along the axis where it is larger.

    Even slopes have none: they match anywhere.
    """
    window = (_SIDE, _SIDE)
    largest = np.zeros(image.shape, np.float32)
    for axis in (0, 1):
        step = _steps(image, axis)
        mean = cv2.blur(step, window)
        np.square(step, out=step)
        mean = np.square(mean)
        np.maximum(largest, cv2.blur(step, window) - mean, out=largest)
    return largest


def _variances(image: Float, step: int = 1) -> Float:
    """`_variance` of every pixel, or of one in `step` x `step`, of which bands of rows hold a whole number."""
    bands = [_variance(image[wide])[inner][::step, ::step] for _, wide, inner in _bands(image.shape[0], _SIDE)]
    return np.concatenate(bands)


def _cut_off(image: Float) -> Float:
    """At half the size, the share of the window around each pixel with noise that is cut off at black or white."""
    cut = (image[::2, ::2] <= _LEAST_GREY) | (image[::2, ::2] >= _MOST_GREY)
    return np.asarray(cv2.blur(cut.astype(np.float32), (_SIDE, _SIDE)), dtype=np.float32)


def _noise(scales: list[Float], variance: Float) -> float:
    """Standard deviation of pixels, grey values, in the quietest windows of the scale where noise is measured.

    `variance` is that scale's.
    """
    some = (slice(_SIDE // 2, None, _SIDE),) * 2
    lit = _cut_off(scales[0])[some] <= _CUT_SHARE
    quietest = float(np.percentile(variance[some][lit], _QUIETEST)) if lit.any() else 0.0
    noise = max(math.sqrt(quietest), _LEAST_NOISE)
    if noise > _USUAL_NOISE:
        there = lit & (variance[some] <= quietest)
        lost = float(np.median(_variances(scales[0], 2)[some][there])) - quietest
        noise = min(noise, max(math.sqrt(max(lost, 0.0)), _USUAL_NOISE), _MOST_NOISE)
    return noise


def _local_noise(noise: float, variance: Float, shape: tuple[int, ...]) -> Float:
    """Noise around each pixel of the coarsest scale, of that shape, where it is less than the image's.

    An image without any blank place has no window with noise alone. 0 where it is much more, so that there is
    texture, too fine for the coarsest scale.
    """
    mean = cv2.resize(variance, shape[::-1], interpolation=cv2.INTER_AREA)
    local = np.clip(np.sqrt(cv2.erode(mean, np.ones((_LOCAL_SIDE, _LOCAL_SIDE), np.uint8))), _LEAST_NOISE, noise)
    local[cv2.blur(mean, (_SIDE, _SIDE)) > (_MARGIN * noise) ** 2] = 0
    return local


def _with_edges(image: Float, blank: Mask, noise: float) -> Mask:
    """Blank pixels, and those near them that have their grey value rather than that of what stands before them."""
    window = (2 * _EDGE_REACH + 1,) * 2
    around = np.ones((2 * _CONTRAST_REACH + 1,) * 2, np.uint8)
    widened = blank.copy()
    for band, wide, inner in _bands(image.shape[0], _EDGE_REACH + _CONTRAST_REACH):
        share = cv2.blur(blank[wide].astype(np.float32), window)
        near = share > 0.5 / (window[0] * window[1])
        mean = cv2.blur(image[wide] * blank[wide], window) / np.where(near, share, 1)
        away = np.where(near, np.abs(image[wide] - mean), 0).astype(np.float32)
        alike = away < np.maximum(_ALIKE * noise, _EDGE_SHARE * cv2.dilate(away, around))
        widened[band] |= (near & alike)[inner]
    return widened
