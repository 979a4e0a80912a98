"""A surface with holes → one whose holes are filled, as far as is asked for.

What cameras do not see beside a building is ground: a hole is filled from the lower of its rims.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_sph.stereo.surface.heights import Surface

_UNFILLED = np.float32(-1e30)
# A rim from which a hole's other rims are reached by a steeper way than this is that of what stands before it.
_STEEPEST = 1.0
_AROUND = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column]


def filled(surface: Surface, reach: int, cell: float, tolerance: float) -> Surface:
    """Fill holes from their lower rims, inversely to the distance.

    Parameters
    ----------
    surface : Surface
    reach : int
        Cells are filled up to so many from a rim that counts; 0: none.
    cell : float
        Side of a cell, in units of the heights.
    tolerance : float
        By which heights of one surface differ.

    Returns
    -------
    Surface
        With a count of 0 where it was filled.
    """
    is_known = np.isfinite(surface.height)
    if not reach or is_known.all() or not is_known.any():
        return surface
    from rasterio.fill import fillnodata  # of the extra
    from scipy.ndimage import distance_transform_edt  # which takes long to load

    is_source = lower_rims(surface.height, reach, _STEEPEST * cell, tolerance)
    # Only rims are shown to GDAL: it would look for a height behind those that do not count.
    height = fillnodata(np.where(is_source, surface.height, _UNFILLED), mask=is_source, max_search_distance=reach)
    is_near = distance_transform_edt(~is_source) <= reach if is_source.any() else is_source
    is_filled = ~is_known & is_near & (height > _UNFILLED)
    height = np.where(is_known, surface.height, np.where(is_filled, height, np.float32(np.nan)))
    return Surface(height, surface.deviation, surface.count)


def lower_rims(height: NDArray[np.float32], reach: int, step: float, tolerance: float) -> NDArray[np.bool_]:
    """Cells beside holes, but those which stand high above another rim of their hole.

    Parameters
    ----------
    height : (h, w) float32 ndarray
        NaN in holes.
    reach : int
        Rims so many cells apart, through the hole, are compared.
    step : float
        By which the ground may rise from a cell to the next.
    tolerance : float
        By which a rim may stand higher than that.

    Returns
    -------
    (h, w) bool ndarray
    """
    from scipy.ndimage import binary_dilation

    is_hole = np.isnan(height)
    is_rim = ~is_hole & binary_dilation(is_hole, np.ones((3, 3), bool))
    # How high the ground of each hole's cell may be, as it rises from the rims around.
    most = np.where(is_rim, height, np.float32(np.inf))
    for _ in range(reach):
        risen = np.where(is_hole, np.minimum(most, _from_around(most, step)), most)
        if (risen == most).all():
            break
        most = risen
    ground = _from_around(np.where(is_hole, most, np.float32(np.inf)), step)
    return np.asarray(is_rim & (height <= ground + tolerance))


def _from_around(most: NDArray[np.float32], step: float) -> NDArray[np.float32]:
    """The least of what the eight cells around each one have, and how much may be added on the way."""
    height, width = most.shape
    padded = np.pad(most, 1, constant_values=np.inf)
    found = np.full(most.shape, np.inf, np.float32)
    for row, column in _AROUND:
        beside = padded[1 + row : 1 + row + height, 1 + column : 1 + column + width]
        np.minimum(found, beside + np.float32(step * np.hypot(row, column)), out=found)
    return found
