"""Pixels of a depth map as patches of surface → their heights in a raster."""

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.scene import View
from colmap_sph.stereo.surface.raster import Raster

# Half a pixel, and a little more: patches of neighbours that differ a little in depth leave no gaps where they are
# looked at from elsewhere.
_HALF = 0.6
# Over its own pixel a patch changes its depth by no more than this: what is nearly edge-on is noise.
_MAX_DEPTH_RATIO = 1.5


def draw_heights(
    view: View, depth: NDArray[np.float32], normals: NDArray[np.float32], raster: Raster
) -> NDArray[np.float32]:
    """Draw what a view sees into a raster: the highest of its surfaces above the centre of each cell.

    Each pixel is a patch of the plane of its depth and normal, as large as the pixel. So cells may be finer than
    pixels, and a height is that at the cell's centre, on slopes, too.

    Parameters
    ----------
    view : View
        May be cropped, as the maps are then.
    depth : (view.height, view.width) float32 ndarray
        z-depth along the ray K⁻¹ (column, row, 1), model units; 0 = none.
    normals : (3, view.height, view.width) float32 ndarray
        Unit vectors in the camera frame, towards the camera.
    raster : Raster
        May be a window of a larger one.

    Returns
    -------
    (raster.height, raster.width) float32 ndarray
        Heights; -inf where the view sees nothing.
    """
    heights = np.full(raster.shape, -np.inf, np.float32)
    matrix, shift = raster.cells_from_camera(view)
    _native.draw_heights(
        np.ascontiguousarray(depth),
        np.ascontiguousarray(normals),
        view.inverse_K,
        np.ascontiguousarray(matrix),
        shift,
        _HALF,
        _MAX_DEPTH_RATIO,
        heights,
    )
    return heights
