"""A sample of a cloud → few points that stand for it, in 16-bit coordinates, for a browser to turn."""

import base64
import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_POINTS = 60_000
"""Points on a page."""
STEPS = 65535
"""Steps along the longest side of the box around them."""
# Share of the points that lie within the box; a few outliers would make its steps coarse.
_INSIDE = 99.6
# So much of what is allowed will do; finer and coarser grids as near to each other as this are not told apart.
_ENOUGH = 0.85
_CLOSE = 1.02
_GUESSES = 4


@dataclass(frozen=True, eq=False)
class SmallCloud:
    """Few points of a cloud.

    Attributes
    ----------
    places : (n, 3) uint16 ndarray
        Steps along the axes.
    colours : (n, 3) uint8 ndarray
        Red, green, blue.
    corner : (3,) float64 ndarray
        Where step 0 is, along the axes.
    step : float
        Length of a step, model units; no point lies farther from its place than half of it along any axis.
    """

    places: NDArray[np.uint16]
    colours: NDArray[np.uint8]
    corner: NDArray[np.float64]
    step: float

    @property
    def middle(self) -> NDArray[np.float64]:
        """Median of the places: where most of the cloud is."""
        return np.asarray(np.median(self.places, axis=0))

    @property
    def reach(self) -> float:
        """Distance in steps from the middle within which nine tenths of the points are."""
        return float(np.percentile(np.linalg.norm(self.places - self.middle, axis=1), 90))

    def as_text(self) -> str:
        """All places (little-endian), then all colours, in base64."""
        return base64.b64encode(self.places.astype("<u2").tobytes() + self.colours.tobytes()).decode("ascii")


def thin_out(
    points: NDArray[np.float64], colours: NDArray[np.uint8], most: int = MOST_POINTS
) -> SmallCloud | None:
    """Choose points evenly over the surface: one of each cell of a grid.

    Parameters
    ----------
    points : (N, 3) float64 ndarray
        Along the axes of the map.
    colours : (N, 3) uint8 ndarray
    most : int
        To choose at most.

    Returns
    -------
    SmallCloud or None
        None without any point.
    """
    if not len(points):
        return None
    # Along rows as long as the cloud: three times as fast as along columns.
    low, high = np.percentile(np.ascontiguousarray(points.T), (50 - _INSIDE / 2, 50 + _INSIDE / 2), axis=1)
    margin = 1e-9 + 0.01 * (high - low).max()
    inside = np.ones(len(points), bool)
    for along, least, most_along in zip(points.T, low - margin, high + margin, strict=True):
        inside &= (along >= least) & (along <= most_along)
    points = points[inside]
    colours = colours[inside]
    corner = points.min(axis=0)
    extent = float((points.max(axis=0) - corner).max())
    chosen = _one_per_cell(points - corner, extent, most)
    step = max(extent, 1e-12) / STEPS
    places = np.rint((points[chosen] - corner) / step).astype(np.uint16)
    return SmallCloud(places, colours[chosen], corner, step)


def _one_per_cell(points: NDArray[np.float64], extent: float, most: int) -> NDArray[np.int64]:
    """Rows of at most so many points, each alone in its cell of a grid as fine as that allows."""
    if len(points) <= most:
        return np.arange(len(points))
    # Such a grid has more cells than there may be points where a surface fills a face of the box, and always fewer
    # points than the coarsest one has cells.
    coarse = most ** (1 / 3) / 2
    fine = float(STEPS)
    best = 0.0
    number = 0
    cells = math.sqrt(most)
    for attempt in itertools.count(1):
        keys = np.sort(_cells(points, extent, cells))
        filled = 1 + int(np.count_nonzero(keys[1:] != keys[:-1]))
        if filled <= most:
            number = filled
            best = coarse = cells
        else:
            fine = cells
        if number >= _ENOUGH * most or fine <= _CLOSE * coarse:
            break
        # Cells of a surface grow with the square of the fineness; of what is none the grid is found by halving.
        cells *= math.sqrt((1 + _ENOUGH) / 2 * most / filled)
        if attempt > _GUESSES or not coarse < cells < fine:
            cells = math.sqrt(coarse * fine)
    if not best:
        return np.empty(0, np.int64)
    # Which point is the first of its cell takes much longer than how many cells there are.
    return np.sort(np.unique(_cells(points, extent, best), return_index=True)[1])


def _cells(points: NDArray[np.float64], extent: float, cells: float) -> NDArray[np.int64]:
    """Number of each point's cell, of so many along the extent."""
    number = np.zeros(len(points), np.int64)
    for axis in range(3):
        number += np.floor(points[:, axis] * (cells / max(extent, 1e-12))).astype(np.int64) << (20 * axis)
    return number
