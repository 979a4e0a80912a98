"""Undistorted image → its rectified image: resampled once, straight from its pixels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.scene import View
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.rectified_pair import RectifiedPair, Side, angles_of_columns, pixel_from_rectified_ray


def resample(
    image: NDArray[np.uint8] | NDArray[np.float32],
    view: View,
    pair: RectifiedPair,
    side: Side,
    mask: NDArray[np.uint8] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Resample an image to the rectified surface, once and straight from its pixels.

    Parameters
    ----------
    image : (view.height, view.width) uint8 or float32 ndarray
        Grey undistorted image.
    view : View
        Its camera and pose.
    pair : RectifiedPair
    side : {"left", "right"}
        Which of the pair's images `view` is.
    mask : (view.height, view.width) uint8 ndarray, optional
        255 where the image counts, 0 where it is to be ignored.

    Returns
    -------
    rectified : (H, W) float32 ndarray
        Not rounded: on weak texture, fractions of a grey value are what there is to match.
    valid : (H, W) uint8 ndarray
        255 where the rectified pixel lies inside the image and no ignored pixel has a part in it, else 0.
    """
    shape = (pair.height, pair.width(side))
    rectified = np.empty(shape, dtype=np.float32)
    valid = np.empty(shape, dtype=np.uint8)
    tables = ray_tables(view, pair, side)
    counts = np.empty((0, view.width), np.uint8) if mask is None else np.ascontiguousarray(mask)
    source = np.ascontiguousarray(image, dtype=np.float32)
    _native.resample(backend(), tables.rows, tables.columns, tables.weights, source, counts, rectified, valid)
    return rectified, valid


def half_size(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The mean of 2 x 2 pixels each: odd rows and columns are doubled, so that pixel x covers 2x and 2x + 1."""
    half = np.empty([(side + 1) // 2 for side in image.shape], dtype=np.float32)
    _native.half_image(np.ascontiguousarray(image), half)
    return half


@dataclass(frozen=True, eq=False)
class RayTables:
    """Homogeneous source pixel of a rectified one: ``rows[:, row] * weights[column] + columns[:, column]``.

    No trigonometry per pixel.
    """

    rows: NDArray[np.float32]
    columns: NDArray[np.float32]
    weights: NDArray[np.float32]

    def source_pixels(
        self, view: View, rows: slice, columns: slice = slice(None)
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
        """Source columns and rows (pixel centres at whole numbers) of some rectified pixels; 255 where inside."""
        ray_rows = np.ascontiguousarray(self.rows[:, rows])
        ray_columns = np.ascontiguousarray(self.columns[:, columns])
        weights = np.ascontiguousarray(self.weights[columns])
        shape = (ray_rows.shape[1], len(weights))
        places = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        inside = np.empty(shape, dtype=np.uint8)
        _native.source_pixels(
            backend(), ray_rows, ray_columns, weights, view.width, view.height, places[0], places[1], inside
        )
        return *places, inside

    def depths(self, rows: slice, columns: slice) -> NDArray[np.float32]:
        """Depths, in the view, of some rectified pixels' rays, which have length 1 on the sphere."""
        return np.asarray(np.multiply.outer(self.rows[2][rows], self.weights[columns]) + self.columns[2][columns])


def ray_tables(view: View, pair: RectifiedPair, side: Side) -> RayTables:
    """Tables of the source pixels of a rectified image."""
    A = pixel_from_rectified_ray(view, pair)
    along = (np.arange(pair.width(side), dtype=np.float64) + pair.column_origin(side)) / pair.columns_per_radian
    across = (np.arange(pair.height) + pair.row_origin) / pair.rows_per_radian
    if pair.surface == "spherical":
        angles = angles_of_columns(along, pair.flatness)
        column_table = np.sin(angles)
        column_weight = np.cos(angles)
        row_table = np.outer(A[:, 1], np.sin(across)) + np.outer(A[:, 2], np.cos(across))
    else:
        column_table = along
        column_weight = np.ones_like(along)
        row_table = np.outer(A[:, 1], across) + A[:, 2:3]
    tables = row_table, np.outer(A[:, 0], column_table), column_weight
    return RayTables(*(table.astype(np.float32) for table in tables))
