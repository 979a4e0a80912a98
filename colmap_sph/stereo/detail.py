"""Grey image → its detail: the sampling that holds what it shows, in samples per pixel along one direction.

A sharp image fills its spectrum up to the Nyquist frequency. One that is blurred, was enlarged, or whose fine
texture drowns in noise, holds no more than a smaller image would.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

# The spectrum is that of square tiles, so many at most, which overlap by half where the image has few.
_TILE = 128
_STEP = 64
_MOST_TILES = 60
_FEWEST_TILES = 4
# Bands of frequency, cycles per tile, in each of four directions; below them lies what is shading.
_BAND_EDGES = np.arange(3, 66, 3)
_DIRECTIONS = 4
# Bands of low frequency whose energy tells how much texture a tile has, and of high frequency that tell its noise.
_TEXTURE_BANDS = 8
_NOISE_BANDS = 4
# Noise grows with light, so it is looked for in tiles of about the same brightness: this share of them is taken
# for blank. What is below this factor of what they have may be noise, too.
_BRIGHTNESSES = 3
_BLANK_SHARE = 0.05
_MARGIN = 1.5
# Power of the rounding to whole grey values.
_ROUNDING = 1 / 12
# What is returned where nothing but noise is seen, and the steps of what is returned.
_LEAST = 0.25
_STEPS = 64


def image_detail(image: NDArray[Any]) -> float:
    """How finely an image must be sampled to hold what it shows.

    The power spectrum of a scene falls with about the square of the frequency, so that, without blur or noise,
    the energy of its gradients is spread evenly over all frequencies up to Nyquist (Field 1987). The detail is the
    mean frequency of that energy, as a share of what it would be then: 1 for a sharp image, c for one without
    anything above the share c of the Nyquist frequency. Frequencies with as much noise as texture count half.

    Parameters
    ----------
    image : (H, W) uint8 or float32 ndarray
        Grey values, 0..255.

    Returns
    -------
    float
        Samples per pixel: the geometric mean over four directions, as movement blurs one of them; 0.25 to a little
        over 1, in steps of 1/64. 1 for images too small to tell, 0.25 for those of noise alone.

    References
    ----------
    D. J. Field, Relations between the statistics of natural images and the response properties of cortical cells,
    JOSA A, 1987, doi:10.1364/JOSAA.4.002379.

    Examples
    --------
    A surface without any texture:

    >>> image_detail(np.full((480, 640), 128, np.uint8))
    0.25
    """
    tiles = _tiles(image)
    if len(tiles) < _FEWEST_TILES:
        return 1.0
    frequency = (_BAND_EDGES[:-1] + _BAND_EDGES[1:]) / (2 * _TILE)
    power = _band_powers(tiles)
    noise = _noise_of(power, frequency, np.array([tile.mean() for tile in tiles]))
    details = [_detail_along(power[:, direction], noise, frequency) for direction in range(_DIRECTIONS)]
    detail = float(np.exp(np.mean(np.log(details))))
    return max(round(detail * _STEPS) / _STEPS, _LEAST)


def _detail_along(power: Float, noise: Float, frequency: Float) -> float:
    """Detail along one direction, from the (n, bands) power and (n,) noise of the tiles."""
    texture = np.maximum(power - noise[:, None], 0)
    weights = np.sqrt((texture * frequency**2)[:, :_TEXTURE_BANDS].mean(axis=1))
    if not weights.any():
        return _LEAST
    weights /= weights.sum()
    # The mean of logarithms, as a few strong edges are not what most pixels show.
    mean = np.exp(weights @ np.log(power + _ROUNDING))
    signal = np.maximum(mean - np.exp(weights @ np.log(noise + _ROUNDING)), 0)
    gradients = signal**2 / mean * frequency**2
    if not gradients.any():
        return _LEAST
    return max(4 * float(gradients @ frequency / gradients.sum()), _LEAST)


def _tiles(image: NDArray[Any]) -> list[NDArray[Any]]:
    """Tiles (128, 128) spread over the image."""
    height, width = image.shape
    corners = [(y, x) for y in range(0, height - _TILE + 1, _STEP) for x in range(0, width - _TILE + 1, _STEP)]
    chosen = np.linspace(0, len(corners) - 1, min(len(corners), _MOST_TILES)).round().astype(int)
    return [image[y : y + _TILE, x : x + _TILE] for y, x in (corners[index] for index in chosen)]


def _band_powers(tiles: list[NDArray[Any]]) -> Float:
    """(n, directions, bands) mean power of each tile, grey values squared."""
    window = np.hanning(_TILE + 2)[1:-1]
    window /= np.sqrt(np.mean(window**2)) * _TILE**0.5
    rows = np.fft.fftfreq(_TILE)[:, None]
    columns = np.fft.rfftfreq(_TILE)
    direction = np.round(np.degrees(np.arctan2(rows, columns)) / (180 / _DIRECTIONS)) % _DIRECTIONS
    band = np.digitize(np.hypot(rows, columns) * _TILE, _BAND_EDGES) - 1
    bands = len(_BAND_EDGES) - 1
    used = (band >= 0) & (band < bands)
    member = (direction * bands + band)[used].astype(int)
    count = np.bincount(member)
    around = np.outer(window, window)
    powers = []
    for tile in tiles:
        spectrum = np.fft.rfft2((tile - tile.mean()) * around)[used]
        powers.append(np.bincount(member, spectrum.real**2 + spectrum.imag**2) / count)
    return np.reshape(powers, (len(tiles), _DIRECTIONS, bands))


def _noise_of(power: Float, frequency: Float, brightness: Float) -> Float:
    """(n,) power of the noise in each tile: of what is white in the blankest tiles of about its brightness.

    Texture falls with the square of the frequency, at least, where noise does not fall.
    """
    high = power[:, :, -_NOISE_BANDS:].mean(axis=(1, 2))
    ends = [slice(-2 * _NOISE_BANDS, -_NOISE_BANDS), slice(-_NOISE_BANDS, None)]
    growth = float((frequency**2)[ends[1]].mean() - (frequency**2)[ends[0]].mean())
    points = []
    for alike in np.array_split(np.argsort(brightness, kind="stable"), _BRIGHTNESSES):
        blankest = alike[np.argsort(high[alike], kind="stable")][: max(1, round(_BLANK_SHARE * len(alike)))]
        spectrum = power[blankest].mean(axis=(0, 1))
        lower, upper = (float((spectrum * frequency**2)[end].mean()) for end in ends)
        white = min(max((upper - lower) / growth, 0), float(spectrum[ends[1]].mean()))
        points.append((float(brightness[blankest].mean()), white))
    light, noise = np.transpose(sorted(points))
    return np.asarray(_MARGIN * np.interp(brightness, light, noise))
