"""Views of a surface, one after the other → the colours of the one that sees each cell best."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.stereo.surface.visibility import Sight, smoothed_worth

# Cells around one that are to take the same view.
SEAM_RADIUS = 12
_FOLD = 1024


class Mosaic:
    """An orthophoto in the making.

    Parameters
    ----------
    height : (h, w) float32 ndarray
        NaN where there is no surface.
    is_filled : (h, w) bool ndarray
        Cells whose height is not measured: these take any view that may see them.
    tolerance : float
        Within one surface heights of neighbouring cells differ by about so much at most.
    """

    def __init__(self, height: NDArray[np.float32], is_filled: NDArray[np.bool_], tolerance: float) -> None:
        self._height = height
        self._is_filled = is_filled
        self._tolerance = tolerance
        self._worth = np.zeros(height.shape, np.float32)
        self._columns = np.zeros(height.shape, np.float32)
        self._rows = np.zeros(height.shape, np.float32)
        self.source = np.zeros(height.shape, np.uint16)
        """(h, w) number of the view that each cell's colour is from; 0: none sees it."""

    def add(self, sight: Sight, corner: tuple[int, int], number: int) -> None:
        """Let a view have the cells that it sees best so far.

        Parameters
        ----------
        sight : Sight
        corner : (int, int)
            Column and row of the image where the sight's part begins.
        number : int
            Of the view, from 1.
        """
        usable = sight.is_seen | (sight.is_open & self._is_filled)
        if not usable.any():
            return
        worth = smoothed_worth(sight.worth, usable, self._height, SEAM_RADIUS, self._tolerance)
        # What is worth nothing by rounding is still better than nothing.
        better = usable & (np.maximum(worth, np.float32(1e-20)) > self._worth)
        if not better.any():
            return
        self._columns[better] = sight.columns[better] + np.float32(corner[0])
        self._rows[better] = sight.rows[better] + np.float32(corner[1])
        self.source[better] = number
        self._worth[better] = np.maximum(worth[better], np.float32(1e-20))

    def colours(self, picture_of: Callable[[int], NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """(h, w, 3) red, green and blue, from the whole images, by number, of those views that have cells."""
        colours = np.zeros((*self.source.shape, 3), np.uint8)
        for number in np.unique(self.source[self.source > 0]).tolist():
            cells = self.source == number
            colours[cells] = _sampled(picture_of(number), self._columns[cells], self._rows[cells])
        return colours


def _sampled(
    picture: NDArray[np.uint8], columns: NDArray[np.float32], rows: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """(n, 3) bilinear colours at n >= 1 places."""
    # `cv2.remap` takes maps of two dimensions, neither of more than 32,767.
    folded = -(-len(columns) // _FOLD)
    across = np.resize(columns, (folded, _FOLD))
    down = np.resize(rows, (folded, _FOLD))
    found = cv2.remap(picture, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found.reshape(-1, 3)[: len(columns)], np.uint8)
