"""Views in an order of place: those that see the same are worked on one soon after the other.

What is read for one view, images and maps of its partners, then serves many that follow. It is the order in which
work is done, and has no part in what comes out.
"""

from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.pairing import Pair

# Cells of the curve along each axis: 2 to this power.
_BITS = 16
# Rows of views, were they on a grid, to a strip.
_PER_STRIP = (1, 2, 3, 4, 6)
# Points of a view that tell where it looks.
_MOST_POINTS = 64


class Places:
    """Where the views of a scene look, along a Hilbert curve over the plane in which most of it lies.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        places = np.array([_place_of(scene, view) for view in scene.views]).reshape(-1, 3)
        self._cells = dict(zip(scene.index_of, _cells(places), strict=True))

    def sorted(self, names: Iterable[str]) -> list[str]:
        """Names of views, in the order of their places."""
        names = sorted(names)
        return [names[k] for k in self._order([self._cells[name] for name in names])]

    def in_strips(self, names: Iterable[str]) -> Iterator[list[str]]:
        """Names of views in other orders: there and back along strips, which are of several widths and both ways.

        Where a cache holds hardly more than what one view looks at, strips of the right width load less than a
        curve that keeps to no direction.
        """
        names = sorted(names)
        cells = np.array([self._cells[name] for name in names], np.int64).reshape(-1, 2)
        cells = cells - cells.min(axis=0, initial=1 << _BITS)
        extents = cells.max(axis=0, initial=0) + 1
        for across in (0, 1):
            extent, beside = extents[[across, 1 - across]]
            rows = max((len(names) * extent / beside) ** 0.5, 1.0)  # of a grid of so many views
            for per_strip in _PER_STRIP:
                strips = max(round(rows / per_strip), 1)
                strip = cells[:, across] * strips // extent
                along = np.where(strip % 2, -1, 1) * cells[:, 1 - across]
                yield [names[k] for k in np.lexsort((along, strip))]

    def sorted_pairs(self, pairs: Iterable[Pair]) -> list[Pair]:
        """Pairs, in the order of the places between their views."""
        pairs = sorted(pairs)
        return [pairs[k] for k in self._order([(self._cells[a] + self._cells[b]) // 2 for a, b in pairs])]

    def _order(self, cells: list[NDArray[np.int64]]) -> NDArray[np.int64]:
        place = along_hilbert_curve(np.array(cells, np.int64).reshape(-1, 2), _BITS)
        return np.argsort(place, kind="stable")


def along_hilbert_curve(cells: NDArray[np.int64], bits: int) -> NDArray[np.int64]:
    """(n,) places along a Hilbert curve of (n, 2) cells of a square with 2 ** `bits` of them on each side.

    Examples
    --------
    >>> along_hilbert_curve(np.array([[0, 0], [0, 1], [1, 1], [1, 0]]), bits=1).tolist()
    [0, 1, 2, 3]
    """
    x, y = cells.T.copy()
    place = np.zeros(len(cells), np.int64)
    for bit in reversed(range(bits)):
        right, up = (x >> bit) & 1, (y >> bit) & 1
        place += (3 * right ^ up) << (2 * bit)
        # A quarter is run through turned, so that it begins and ends beside its neighbours.
        is_mirrored = (up == 0) & (right == 1)
        x, y = (np.where(is_mirrored, (1 << bits) - 1 - axis, axis) for axis in (x, y))
        x, y = np.where(up == 0, y, x), np.where(up == 0, x, y)
    return place


def _cells(places: NDArray[np.float64]) -> NDArray[np.int64]:
    """(n, 2) cells of (n, 3) places, in the plane of their two principal axes."""
    beside = places - np.median(places, axis=0)
    # A few far away must not make all others one cell.
    reach = np.percentile(np.linalg.norm(beside, axis=1), 99) if len(beside) else 0.0
    if not 0 < reach < np.inf:
        return np.zeros((len(places), 2), np.int64)
    beside = np.nan_to_num(beside / reach).clip(-2, 2)
    across = beside @ np.linalg.eigh(beside.T @ beside)[1][:, :0:-1]
    # Along the sides of the block: a curve that runs along its strips keeps more of them together.
    angle = np.radians(cv2.minAreaRect(across.astype(np.float32))[2])
    across @= np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(((across / 4 + 0.5).clip(0, 1) * ((1 << _BITS) - 1)).astype(np.int64))


def _place_of(scene: Scene, view: View) -> NDArray[np.float64]:
    """The middle of the points that a view observes, or where it is."""
    rows = view.point_indices
    if not len(rows):
        return view.center
    return np.asarray(np.median(scene.points[rows[:: -(-len(rows) // _MOST_POINTS)]], axis=0))
