"""Heights of cells as several views see them → the surface that these agree on."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Cells that are looked at together.
_BAND_CELLS = 1 << 15


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that is seen from above.

    Attributes
    ----------
    height : (h, w) float32 ndarray
        NaN where there is none.
    deviation : (h, w) float32 ndarray
        Standard deviation of the views' heights, estimated from those that agree; NaN for fewer than two.
    count : (h, w) uint16 ndarray
        Views that agree.
    """

    height: NDArray[np.float32]
    deviation: NDArray[np.float32]
    count: NDArray[np.uint16]


def highest_surface(heights: NDArray[np.float32], tolerance: float, min_views: int) -> Surface:
    """Find the highest surface of each cell that enough views agree on.

    Going down from the highest view of a cell, the first height counts at and below which, by up to `tolerance`,
    lie the heights of `min_views` views, or of all that see the cell where these are fewer. The surface is their
    mean.

    Parameters
    ----------
    heights : (views, h, w) float32 ndarray
        Greatest height that each view sees, -inf for none; sorted in place.
    tolerance : float
        In units of the heights.
    min_views : int

    Returns
    -------
    Surface

    Examples
    --------
    Three views see a roof at 5, which a fourth missed; a fifth sees something above that nobody else does.

    >>> seen = np.array([5.0, 5.1, 9.0, 0.0, 4.9], np.float32).reshape(5, 1, 1)
    >>> surface = highest_surface(seen, tolerance=0.3, min_views=3)
    >>> round(float(surface.height[0, 0]), 3), int(surface.count[0, 0])
    (5.0, 3)
    """
    shape = heights.shape[1:]
    stack = heights.reshape(len(heights), math.prod(shape))  # of no view, too
    height = np.full(stack.shape[1], np.nan, np.float32)
    deviation = np.full(stack.shape[1], np.nan, np.float32)
    count = np.zeros(stack.shape[1], np.uint16)
    for first in range(0, stack.shape[1], _BAND_CELLS):
        band = slice(first, first + _BAND_CELLS)
        stack[:, band].sort(axis=0)
        _agree(stack[::-1, band], tolerance, min_views, (height[band], deviation[band], count[band]))
    return Surface(height.reshape(shape), deviation.reshape(shape), count.reshape(shape))


def _agree(
    stack: NDArray[np.float32],
    tolerance: float,
    min_views: int,
    result: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint16]],
) -> None:
    """Fill in height, deviation and count of (n,) cells from (views, n) heights, the greatest first."""
    height, deviation, count = result
    wanted = np.minimum(np.isfinite(stack).sum(axis=0), min_views)
    left = np.flatnonzero(wanted > 0)
    for first in range(len(stack)):
        below = stack[first:, left]
        agrees = np.isfinite(below) & (below >= below[0] - tolerance)
        number = agrees.sum(axis=0)
        found = number >= wanted[left]
        cells = left[found]
        agrees = agrees[:, found]
        agreeing = number[found]
        values = np.where(agrees, below[:, found], 0).astype(np.float64)
        mean = values.sum(axis=0) / agreeing
        squares = (np.where(agrees, values - mean, 0) ** 2).sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            deviation[cells] = np.sqrt(squares / (agreeing - 1))
        height[cells] = mean
        count[cells] = agreeing
        left = left[~found]
        if not len(left):
            break


def hillshade(height: NDArray[np.float32], cell: float) -> NDArray[np.uint8]:
    """Brightness of a surface in the light of a sun in the north-west, 45° high.

    Parameters
    ----------
    height : (h, w) float32 ndarray
        NaN where there is none.
    cell : float
        Side of a cell, in units of the heights.

    Returns
    -------
    (h, w) uint8 ndarray
        1..255; 0 where there is no height, at the cell or beside it.
    """
    if min(height.shape) < 2:
        return np.zeros(height.shape, np.uint8)
    down, right = np.gradient(height, cell)
    # The normal is (-right, down, 1): rows count towards the south.
    towards = np.array([-1.0, 1.0, np.sqrt(2.0)]) / 2.0
    light = (-right * towards[0] + down * towards[1] + towards[2]) / np.sqrt(1 + right**2 + down**2)
    shade = 1 + 254 * np.clip(light, 0, 1)
    return np.where(np.isfinite(shade), np.nan_to_num(shade), 0).astype(np.uint8)
