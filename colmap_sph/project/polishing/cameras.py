"""The original model and tracks → that model with a new distortion for each of its cameras, on request.

Focal lengths and principal points stay: where a scene hardly tells them, free ones run away, and images still fit
each other.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.project.cameras import plain_camera, undistorted_camera
from colmap_sph.project.polishing.adjustment import Observations, adjusted_model
from colmap_sph.project.sparse_model import cameras_of_images, image_names, submodel

# Models that map as OPENCV does with these of its parameters: focal lengths, principal point, k1, k2.
_AS_OPENCV = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
}
_OPENCV_PARAMETERS = 8

Float = NDArray[np.float64]


def refined_cameras(
    given: pycolmap.Reconstruction, observations: Observations, options: pycolmap.UndistortCameraOptions
) -> pycolmap.Reconstruction | None:
    """Adjust the distortion of each camera of a model, with its poses.

    Parameters
    ----------
    given : pycolmap.Reconstruction
        The original model, of distorted images.
    observations : Observations
        Image coordinates in the undistorted images.
    options : pycolmap.UndistortCameraOptions
        How these were undistorted.

    Returns
    -------
    pycolmap.Reconstruction or None
        Of the original images; None where the adjustment does not converge.
    """
    model = submodel(given, set(image_names(given)))
    cameras = cameras_of_images(model)
    pixels = observations.pixels.copy()
    for index, name in enumerate(observations.names):
        of_image = observations.image == index
        pixels[of_image] = distorted(cameras[name], pixels[of_image], options)
    seen = np.isfinite(pixels).all(axis=1)
    for camera in model.cameras.values():
        _as_opencv(camera)
    original = replace(
        observations, track=observations.track[seen], image=observations.image[seen], pixels=pixels[seen]
    )
    return adjusted_model(model, original, refine_distortion=True)


def distorted(camera: pycolmap.Camera, pixels: Float, options: pycolmap.UndistortCameraOptions) -> Float:
    """(n, 2) coordinates in an original image of those in its undistorted one; NaN where it has none."""
    plain = plain_camera(camera)
    straight = undistorted_camera(plain, options) or plain
    rays = np.asarray(straight.cam_from_img(pixels)).reshape(-1, 2)
    return np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))).reshape(-1, 2)


def straightened(
    given: pycolmap.Reconstruction,
    refined: pycolmap.Reconstruction,
    observations: Observations,
    calibrations: Sequence[Float],
    options: pycolmap.UndistortCameraOptions,
) -> tuple[list[Float], Float]:
    """What refined cameras make of coordinates in undistorted images.

    Parameters
    ----------
    given, refined : pycolmap.Reconstruction
        The original model, and the same with other cameras and poses.
    observations : Observations
        Image coordinates in the undistorted images.
    calibrations : sequence of (3, 3) float64 ndarray
        Of each of these.
    options : pycolmap.UndistortCameraOptions
        How they were undistorted.

    Returns
    -------
    poses : list of (3, 4) float64 ndarray
        ``[R | t]`` of each image in `refined`.
    pixels : (m, 2) float64 ndarray
        Where pinholes of these calibrations in the refined places see the same.
    """
    images = {image.name: image for image in refined.images.values()}
    cameras = cameras_of_images(given)
    pixels = observations.pixels.copy()
    poses = []
    for index, name in enumerate(observations.names):
        here = observations.image == index
        original = distorted(cameras[name], pixels[here], options)
        rays = np.asarray(refined.camera(images[name].camera_id).cam_from_img(original)).reshape(-1, 2)
        K = calibrations[index]
        pixels[here] = rays * K[[0, 1], [0, 1]] + K[:2, 2]
        poses.append(np.array(images[name].cam_from_world().matrix()))
    return poses, pixels


def bends(before: pycolmap.Reconstruction, after: pycolmap.Reconstruction) -> Mapping[int, float]:
    """By how many pixels (root mean square over its image) each camera maps otherwise, less a shift."""
    found = {}
    for camera_id, camera in sorted(after.cameras.items()):
        u, v = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)
        rays = np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2)
        old = np.asarray(before.camera(camera_id).img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
        shift = old - pixels
        found[camera_id] = float(np.sqrt(((shift - shift.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return found


def _as_opencv(camera: pycolmap.Camera) -> None:
    """Turn a camera, in place, into an OPENCV one that maps alike, where it can be one."""
    places: Sequence[int] | None = _AS_OPENCV.get(camera.model_name)
    if places is None:
        return
    parameters = [float(camera.params[place]) for place in places]
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.params = parameters + [0.0] * (_OPENCV_PARAMETERS - len(parameters))
