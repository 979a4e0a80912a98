"""Points of a cloud → the nodes of an octree, each level about evenly spaced, twice as fine as the one above.

A point belongs to the uppermost level at which it is the first in its cell; a node has `CELLS` cells along each
side. So what a node holds depends on the points within it alone: a cloud larger than memory is divided into
cubes, and each is worked on by itself, see `levels_of`.
"""

import numpy as np
from numpy.typing import NDArray

CELLS_LOG2 = 7
CELLS = 1 << CELLS_LOG2
# A node with so few points left has no nodes below it.
_FEW = 1 << 14
# Levels whose cells 63 bits can number: of three coordinates with level + 7 bits each.
DEEPEST = 21 - CELLS_LOG2


def levels_of(places: NDArray[np.float64], top: int = 0) -> NDArray[np.int8]:
    """Level of each point.

    Parameters
    ----------
    places : (n, 3) float64 ndarray
        From 0 to 1 in the root node, 1 excluded; all points of the cloud within some nodes of level `top`.
    top : int
        Nodes above that level have other points, too; at most `CELLS_LOG2`.

    Returns
    -------
    (n,) int8 ndarray
        0 to `DEEPEST`.
    """
    fine = cells_of(places, DEEPEST + CELLS_LOG2)
    levels = np.full(len(places), DEEPEST, np.int8)
    left = np.arange(len(places))
    for level in range(DEEPEST):
        taken = np.zeros(len(left), bool)
        cells = _numbered(fine[left] >> (DEEPEST - level))
        taken[np.unique(cells, return_index=True)[1]] = True
        if level >= top:
            nodes = _numbered(fine[left] >> (DEEPEST + CELLS_LOG2 - level))
            _, own, counts = np.unique(nodes, return_inverse=True, return_counts=True)
            taken |= counts[own] <= _FEW
        levels[left[taken]] = level
        left = left[~taken]
        if not len(left):
            break
    return levels


def cells_of(places: NDArray[np.float64], bits: int) -> NDArray[np.int64]:
    """(n, 3) cells, of which each axis has 2^bits, in which places from 0 to 1 lie."""
    most = (1 << bits) - 1
    return np.clip((places * (1 << bits)).astype(np.int64), 0, most)


def _numbered(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each of (n, 3) cells of up to 21 bits."""
    return np.asarray((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2])
