"""Cameras: all that this package knows of COLMAP's camera models.

The method sees pinholes only. Every other model reaches it undistorted, by COLMAP, and here is what must be known
of a model for that: whether it maps as a pinhole does, and where COLMAP needs help. A camera model that is new in
COLMAP's library works where the answers here, which come from the library, are right for it. Fisheyes and
panoramas, which no single pinhole can show, are the business of `project/wide`.
"""

import copy

import numpy as np
import pycolmap


def is_pinhole(camera: pycolmap.Camera) -> bool:
    """Whether a camera of any model maps as its calibration matrix does, to 0.001 px inside the image."""
    if camera.model in (pycolmap.CameraModelId.PINHOLE, pycolmap.CameraModelId.SIMPLE_PINHOLE):
        return True
    if not camera.is_perspective() or not np.all(np.isfinite(camera.params)) or camera.mean_focal_length() <= 0:
        return False
    u, v = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    rays = pixels @ np.linalg.inv(camera.calibration_matrix()).T
    mapped = np.asarray(camera.img_from_cam(rays), dtype=np.float64)
    return bool(np.abs(mapped - pixels[:, :2]).max() < 1e-3)


def make_pinhole(camera: pycolmap.Camera) -> None:
    """Turn a camera without distortion, of whatever model, into a PINHOLE one that maps alike."""
    if not is_pinhole(camera):
        raise ValueError(f"camera {camera.camera_id} ({camera.model_name}) is distorted")
    K = camera.calibration_matrix()
    camera.model = pycolmap.CameraModelId.PINHOLE
    camera.params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]


def plain_camera(camera: pycolmap.Camera) -> pycolmap.Camera:
    """Return a camera that maps alike and that COLMAP undistorts rightly; mostly the camera itself.

    COLMAP takes any camera without distortion coefficients for a pinhole: with one that is a pinhole of another
    model it cuts off a pixel of the image, and of a fisheye it copies the image. A coefficient just above its
    threshold (1e-8) changes nothing: at 1 rad and f = 4000 px it is 4e-4 px.
    """
    if not camera.is_undistorted() or camera.model == pycolmap.CameraModelId.PINHOLE:
        return camera
    plain = copy.deepcopy(camera)
    if is_pinhole(camera):
        make_pinhole(plain)
    else:
        K = camera.calibration_matrix()
        plain.model = pycolmap.CameraModelId.OPENCV_FISHEYE
        plain.params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], 1e-7, 0.0, 0.0, 0.0]
    return plain


def undistorted_camera(
    camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions
) -> pycolmap.Camera | None:
    """Return the camera of an undistorted image, from a `plain_camera`; None where it is that of the original."""
    undistorted = pycolmap.undistort_camera(options, camera)
    same_size = (undistorted.width, undistorted.height) == (camera.width, camera.height)
    return None if same_size and camera.is_undistorted() else undistorted


def change_camera(camera: pycolmap.Camera, other: pycolmap.Camera) -> None:
    """Give a camera, in place, the model, size and parameters of another."""
    camera.model = other.model
    camera.params = list(other.params)
    camera.width, camera.height = other.width, other.height
