"""A camera with a lens field → the pinhole camera of its undistorted images, and where these show what.

COLMAP's undistortion knows no field. Its pinhole camera is kept, but for the pixels at the border that the field
would fetch from outside of the original image: these are cut off.
"""

import copy

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.project.cameras import plain_camera, undistorted_camera
from colmap_sph.project.lens.field import Float, LensField

# Pixels that are cut off on a side at most, of a field that this program found.
_CUTS = 64
# Pixels: so near to the border of the original an undistorted pixel still lies between four of its pixels.
_HALF = 0.5 - 1e-9


def straight_camera(
    camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions, field: LensField | None = None
) -> pycolmap.Camera:
    """Camera of the undistorted image.

    Parameters
    ----------
    camera : pycolmap.Camera
        Of the original image.
    options : pycolmap.UndistortCameraOptions
    field : LensField, optional
        Of this camera.

    Returns
    -------
    pycolmap.Camera
        A new one.
    """
    plain = plain_camera(camera)
    straight = copy.deepcopy(undistorted_camera(plain, options) or plain)
    if field is None:
        return straight
    for _ in range(_CUTS):
        beyond = _sides_beyond(plain, straight, field)
        if not any(beyond):
            break
        left, top, right, bottom = beyond
        straight.principal_point_x -= left
        straight.principal_point_y -= top
        straight.width -= left + right
        straight.height -= top + bottom
    return straight


def place_in_original(
    camera: pycolmap.Camera, straight: pycolmap.Camera, field: LensField | None, rows: slice
) -> Float:
    """(pixels, 2) image coordinates in an original image of what some rows of the undistorted one show.

    Parameters
    ----------
    camera, straight : pycolmap.Camera
        Of the original image, see `plain_camera`, and of the undistorted one.
    field : LensField or None
        Of the former.
    rows : slice
        Of pixels.
    """
    return _seen(camera, straight, field, _centres(0, straight.width), _centres(rows.start, rows.stop))


def pixel_rays(straight: pycolmap.Camera, pixels: Float) -> Float:
    """(n, 2) rays of image coordinates of a pinhole camera."""
    K = straight.calibration_matrix()
    return np.asarray((pixels - K[:2, 2]) / K[[0, 1], [0, 1]])


def ray_pixels(straight: pycolmap.Camera, rays: Float) -> Float:
    """(n, 2) image coordinates of rays in a pinhole camera."""
    K = straight.calibration_matrix()
    return np.asarray(rays * K[[0, 1], [0, 1]] + K[:2, 2])


def _sides_beyond(
    camera: pycolmap.Camera, straight: pycolmap.Camera, field: LensField
) -> tuple[int, int, int, int]:
    """Whether pixels on the left, top, right and bottom show what is beyond the border of the original: 0, 1."""
    x = _centres(0, straight.width)
    y = _centres(0, straight.height)
    inside = [
        _is_inside(camera, _seen(camera, straight, field, columns, rows))
        for columns, rows in ((x[:1], y), (x, y[:1]), (x[-1:], y), (x, y[-1:]))
    ]
    left, top, right, bottom = (int(not there.all()) for there in inside)
    return left, top, right, bottom


def _seen(
    camera: pycolmap.Camera, straight: pycolmap.Camera, field: LensField | None, columns: Float, rows: Float
) -> Float:
    K = straight.calibration_matrix()
    x = (columns - K[0, 2]) / K[0, 0]
    y = (rows - K[1, 2]) / K[1, 1]
    seen = np.stack(np.meshgrid(x, y), axis=2) if field is None else field.bent_grid(x, y)
    rays = np.column_stack([seen.reshape(-1, 2), np.ones(seen.size // 2)])
    return np.asarray(camera.img_from_cam(rays), np.float64).reshape(-1, 2)


def _centres(first: int, end: int) -> Float:
    return np.arange(first, end, dtype=np.float64) + 0.5


def _is_inside(camera: pycolmap.Camera, places: Float) -> NDArray[np.bool_]:
    inside = (places >= _HALF) & (places < np.array([camera.width, camera.height]) - _HALF)
    return np.asarray(inside.all(axis=1))
