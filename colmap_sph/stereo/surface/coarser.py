"""A surface and its colours in fine cells → in coarser ones, of several fine ones each.

A coarse cell that took what lies at its very middle would show the grain of a meadow as noise. So it takes the
middle one of the heights in it, which is of one surface also at an edge, and the mean of the colours.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_sph.stereo.surface.heights import Surface

Value = TypeVar("Value", bound=np.generic)


def coarser_surface(surface: Surface, factor: int) -> tuple[Surface, NDArray[np.intp]]:
    """Take the middle height of each `factor` × `factor` cells, where at least half of them have one.

    Parameters
    ----------
    surface : Surface
        Its height and width are multiples of the factor.
    factor : int

    Returns
    -------
    surface : Surface
    chosen : (h, w) intp ndarray
        Which of its fine cells each coarse cell took, by rows.
    """
    if factor == 1:
        return surface, np.zeros(surface.height.shape, np.intp)
    height = _blocks(surface.height, factor)
    known = np.isfinite(height).sum(axis=2)
    order = np.argsort(np.where(np.isfinite(height), height, np.inf), axis=2, kind="stable")
    middle = np.maximum(known - 1, 0)[..., None] // 2
    chosen = np.take_along_axis(order, middle, axis=2)
    is_there = 2 * known >= factor**2

    def taken(values: NDArray[Value]) -> NDArray[Value]:
        return np.take_along_axis(_blocks(values, factor), chosen, axis=2)[..., 0]

    nothing = np.float32(np.nan)
    return Surface(
        np.where(is_there, taken(surface.height), nothing),
        np.where(is_there, taken(surface.deviation), nothing),
        np.where(is_there, taken(surface.count), np.uint16(0)),
    ), chosen[..., 0]


def coarser_colours(
    colours: NDArray[np.uint8], source: NDArray[np.uint16], factor: int, chosen: NDArray[np.intp]
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Take the mean colour of each `factor` × `factor` cells, where at least half of them have one.

    Parameters
    ----------
    colours : (h, w, 3) uint8 ndarray
    source : (h, w) uint16 ndarray
        Number of the image that each is from; 0: none.
    factor : int
    chosen : (h / factor, w / factor) intp ndarray
        See `coarser_surface`; the number is that of this cell, or the greatest where it has none.

    Returns
    -------
    colours : (h / factor, w / factor, 3) uint8 ndarray
    source : (h / factor, w / factor) uint16 ndarray
    """
    if factor == 1:
        return colours, source
    numbers = _blocks(source, factor)
    has_colour = numbers > 0
    count = has_colour.sum(axis=2)
    is_there = 2 * count >= factor**2
    mean = np.zeros((*count.shape, 3), np.uint8)
    for channel in range(3):
        total = np.where(has_colour, _blocks(colours[..., channel], factor), 0).sum(axis=2)
        mean[..., channel] = np.rint(total / np.maximum(count, 1)) * is_there
    own = np.take_along_axis(numbers, chosen[..., None], axis=2)[..., 0]
    return mean, np.where(is_there, np.where(own > 0, own, numbers.max(axis=2)), np.uint16(0))


def _blocks(values: NDArray[Value], factor: int) -> NDArray[Value]:
    """(h, w) → (h / factor, w / factor, factor²)."""
    height, width = values.shape
    parted = values.reshape(height // factor, factor, width // factor, factor)
    return parted.transpose(0, 2, 1, 3).reshape(height // factor, width // factor, factor**2)
