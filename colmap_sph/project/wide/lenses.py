"""Which cameras of a model are wide, and how far off the axis each of them is believed."""

import logging
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError, percent
from colmap_sph.project.wide.layout import WIDEST_PINHOLE, angles_shown
from colmap_sph.project.wide.projection import MODELS, PANORAMA, Lens, camera_rays, principal_point, turning_angle

logger = logging.getLogger(__name__)

# Radians beyond what is observed up to which a polynomial is believed.
_BEYOND = np.radians(2.0)
# Share of its observations that may lie beyond a lens: mistakes; more say that it is not this lens.
_MOST_BEYOND = 0.01
# A sphere may have so much of the size of its images: sizes are rounded.
_ROUNDED = 0.99
_HALF = 0.5
_TINY = 1e-12
# Degrees by which half of what panoramas observe may lie beside where they show it. It is seldom one; where images
# are another part of the sphere than their camera says, it is tens.
_MOST_ASTRAY = 10.0
# Images of a camera that are asked for what they observe, from all over the model.
_ASKED = 50
_WHOLE = (
    "an image must be the whole sphere, or the left or upper part of one whose width and height are the "
    "camera's parameters. Fill other parts up to the whole, in black, and mask that, before structure from motion."
)


def wide_lenses(model: pycolmap.Reconstruction, name: str) -> dict[int, Lens]:
    """Lenses of a model that a single pinhole view cannot hold, by camera id.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    name : str
        Of the model, for messages.

    Raises
    ------
    InputError
        A camera's parameters describe no lens, or one that does not show what it is said to have observed.
    """
    lenses = {}
    for camera_id in sorted(used_cameras(model)):
        camera = model.camera(camera_id)
        if camera.model_name == PANORAMA:
            lenses[camera_id] = _panorama(model, camera, name)
        elif camera.model_name in MODELS:
            lens = _fisheye(model, camera, name)
            if max(angles_shown(lens)) > WIDEST_PINHOLE:
                lenses[camera_id] = lens
    return lenses


def used_cameras(model: pycolmap.Reconstruction) -> set[int]:
    """Ids of the cameras of registered images."""
    return {model.image(image_id).camera_id for image_id in model.reg_image_ids()}


def _lens(camera: pycolmap.Camera) -> Lens:
    return Lens(camera.model_name, tuple(map(float, camera.params)), camera.width, camera.height)


def _panorama(model: pycolmap.Reconstruction, camera: pycolmap.Camera, name: str) -> Lens:
    width, height = camera.params
    if not (np.isfinite([width, height]).all() and min(width, height) >= 1):
        raise InputError(f"Camera {camera.camera_id} in {name} has impossible parameters; export the model again.")
    if width < _ROUNDED * camera.width or height < _ROUNDED * camera.height:
        raise InputError(
            f"Camera {camera.camera_id} ({PANORAMA}) in {name} describes a whole sphere of {width:g} x {height:g} "
            f"pixels, less than its images have ({camera.width} x {camera.height}); its parameters are the width "
            "and height of whole panoramas."
        )
    lens = _lens(camera)
    places, towards = _sights(model, camera.camera_id)
    if not len(places):
        return lens
    beyond = ((places < 0) | (places > (camera.width, camera.height))).any(axis=1).mean()
    if beyond > _MOST_BEYOND:
        raise InputError(
            f"Camera {camera.camera_id} ({PANORAMA}) in {name} has {percent(beyond, 0)} of its observations "
            f"outside of its images of {camera.width} x {camera.height} pixels; {_WHOLE}"
        )
    cosines = (camera_rays(lens, places) * towards).sum(axis=1)
    cosines = cosines[np.isfinite(cosines)]
    astray = float(np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))) if len(cosines) else 0.0
    if astray > _MOST_ASTRAY:
        raise InputError(
            f"What camera {camera.camera_id} ({PANORAMA}) in {name} observes lies {astray:.0f} degrees beside "
            f"where its images show it; {_WHOLE}"
        )
    return lens


def _fisheye(model: pycolmap.Reconstruction, camera: pycolmap.Camera, name: str) -> Lens:
    lens = _lens(camera)
    problem = _outside(lens)
    if problem is not None:
        raise InputError(
            f"Camera {camera.camera_id} ({camera.model_name}) in {name} has {problem}; calibrate it again."
        )
    is_possible = np.isfinite(lens.params).all() and camera.mean_focal_length() > 0
    turn = turning_angle(lens) if is_possible else 0.0
    if turn < _BEYOND:
        raise InputError(
            f"Camera {camera.camera_id} ({camera.model_name}) in {name} describes no lens: points do not move "
            "outward with their angle off its axis; calibrate it again."
        )
    observed = _observed(model, camera.camera_id)
    if not len(observed):
        return replace(lens, limit=min(turn, _rim(lens)))
    rays = camera_rays(lens, observed)
    beyond = np.isnan(rays[:, 2])
    if beyond.mean() > _MOST_BEYOND:
        raise InputError(
            f"Camera {camera.camera_id} ({camera.model_name}) in {name} cannot have seen "
            f"{percent(beyond.mean(), 0)} of what it observes: by its parameters it shows nothing beyond "
            f"{np.degrees(turn):.0f} degrees off its axis; calibrate it again, or choose another camera model."
        )
    reach = float(np.arccos(np.clip(rays[~beyond, 2].min(), -1, 1)))
    return replace(lens, limit=min(turn, reach + _BEYOND))


def _outside(lens: Lens) -> str | None:
    """Say which parameter has no meaning in the formula of its model, or return None.

    There the formula goes on, and describes some other lens. FOV with 0 is the pinhole that it tends to.
    """
    if lens.model == "EUCM":
        alpha, beta = lens.params[-2:]
        if not 0 <= alpha <= 1:
            return f"alpha = {alpha:g}, which must be from 0 to 1"
        if not 0 < beta < np.inf:
            return f"beta = {beta:g}, which must be above 0"
    if lens.model == "FOV" and not abs(lens.params[-1]) < np.pi:
        return f"omega = {lens.params[-1]:g}, which must be an angle below pi"
    return None


def _sights(model: pycolmap.Reconstruction, camera_id: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 2) image coordinates at which images of a camera observe points, and (n, 3) unit vectors to these."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    images = [image for image in images if image.camera_id == camera_id and image.num_points3D]
    places, towards = [np.empty((0, 2))], [np.empty((0, 3))]
    for image in images[:: -(-len(images) // _ASKED) or 1]:
        seen = [point for point in image.get_observation_points2D() if model.exists_point3D(point.point3D_id)]
        points = np.array([model.point3D(point.point3D_id).xyz for point in seen]).reshape(-1, 3)
        pose = image.cam_from_world().matrix()
        places.append(np.array([point.xy for point in seen]).reshape(-1, 2))
        towards.append(points @ pose[:, :3].T + pose[:, 3])
    vectors = np.concatenate(towards)
    return np.concatenate(places), vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), _TINY)


def _observed(model: pycolmap.Reconstruction, camera_id: int) -> NDArray[np.float64]:
    """(n, 2) image coordinates of all points that a camera observes."""
    places = list(_places(model, camera_id))
    return np.concatenate(places) if places else np.empty((0, 2))


def _places(model: pycolmap.Reconstruction, camera_id: int) -> Iterator[NDArray[np.float64]]:
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        if image.camera_id == camera_id and image.num_points3D:
            yield np.array([point.xy for point in image.get_observation_points2D()])


def _rim(lens: Lens) -> float:
    """Radians that the largest circle in the image shows: what lies beyond may be the inside of the lens."""
    x, y = principal_point(lens)
    ends = np.array([[_HALF, y], [lens.width - _HALF, y], [x, _HALF], [x, lens.height - _HALF]])
    depth = camera_rays(lens, ends)[:, 2]
    return float(np.arccos(np.clip(np.nan_to_num(depth, nan=-1.0), -1, 1)).max())
