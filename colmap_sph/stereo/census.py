"""Rectified image → its pyramid, and the census of each level: which of a pixel's neighbours are darker.

Census (Zabih and Woodfill 1994, 9 × 7 here) tells what a window shows whatever its brightness and contrast.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.resampling import half_size

CENSUS_INVALID = np.uint64(1 << 63)
"""Census of a pixel without image content."""
_STEPS = 64  # of a grey value, in which the kernels count
_BORDER = (3, 4)  # rows at the top and at the bottom, columns at either side
# Unsharp masking, which gives back some of what lenses and resampling took away: so much of the difference from
# the binomial mean of 3 x 3 pixels is added.
_SHARPENING = 0.6


@dataclass(frozen=True, eq=False)
class RectifiedImage:
    """One image of a rectified pair: (H, W) float32 grey values (0..255), and 255 where they are image content."""

    image: NDArray[np.float32]
    valid: NDArray[np.uint8]

    def rows(self, rows: slice) -> "RectifiedImage":
        """Some of its rows."""
        return RectifiedImage(self.image[rows], self.valid[rows])


def pyramid(image: RectifiedImage, levels: int) -> list[RectifiedImage]:
    """Full resolution first. Odd rows and columns are doubled, so that pixel x of a level covers 2x, 2x + 1."""
    images = [image]
    for _ in range(levels):
        pixels = half_size(images[-1].image)
        valid = np.empty(pixels.shape, dtype=np.uint8)
        _native.half_mask(np.ascontiguousarray(images[-1].valid), valid)
        images.append(RectifiedImage(pixels, valid))
    return images


@dataclass(frozen=True)
class Compared:
    """What of two windows is compared.

    Attributes
    ----------
    fine : bool
        Neighbours within 5 x 5 pixels have two bits, and others none.
    grey_step : float
        Not only neighbours: the pixels' own grey values, too, a bit for each step between them, up to 14, in place
        of the neighbours in the outermost columns. 0: neighbours alone.
    """

    fine: bool = False
    grey_step: float = 0.0


NEIGHBOURS = Compared()
"""A bit for each neighbour, whatever the brightness."""


def census(image: RectifiedImage, compared: Compared = NEIGHBOURS) -> NDArray[np.uint64]:
    """(H, W) uint64: a bit for each neighbour, set where it is darker, and `CENSUS_INVALID` without content."""
    words = np.empty(image.image.shape, dtype=np.uint64)
    put_census(image, words, compared=compared)
    return words


def put_census(
    image: RectifiedImage, words: NDArray[np.uint64], first: int = 0, compared: Compared = NEIGHBOURS
) -> None:
    """Set `words`, from their column `first` on, to the census of an image; see `census`."""
    height, width = image.image.shape
    padded = np.empty((height + 2 * _BORDER[0], width + 2 * _BORDER[1]), dtype=np.int16)
    _native.sharpen(backend(), np.ascontiguousarray(image.image), _SHARPENING, padded)
    step = round(compared.grey_step * _STEPS)
    _native.census(backend(), padded, np.ascontiguousarray(image.valid), compared.fine, step, first, words)
