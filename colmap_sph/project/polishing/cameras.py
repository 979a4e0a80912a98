"""The original model and tracks → that model with a new distortion for each of its cameras, or a lens field.

Focal lengths and principal points stay: where a scene hardly tells them, free ones run away, and images still fit
each other.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.project.lens.field import LensField
from colmap_sph.project.lens.files import write_lens_fields
from colmap_sph.project.lens.straight import pixel_rays, straight_camera
from colmap_sph.project.polishing.adjustment import Observations, adjusted_model
from colmap_sph.project.polishing.lens_fields import FoundField, adjusted_with_fields, found_fields, sparse_error
from colmap_sph.project.sparse_model import cameras_of_images, image_names, submodel, write_model

# Models that map as OPENCV does with these of its parameters: focal lengths, principal point, k1, k2.
_AS_OPENCV = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
}
_OPENCV_PARAMETERS = 8
# Pixels: smaller changes of a camera are roundings.
_TOLD = 0.005
# The model's own tracks may fit worse by this share: a rounding.
_RISE = 0.02

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Lenses:
    """A model of original images, and what its lenses do beyond its cameras.

    Attributes
    ----------
    model : pycolmap.Reconstruction
    fields : mapping of int to FoundField
        By camera id.
    """

    model: pycolmap.Reconstruction
    fields: Mapping[int, FoundField] = field(default_factory=dict)

    @property
    def plain_fields(self) -> dict[int, LensField]:
        """The fields alone."""
        return {camera_id: found.field for camera_id, found in self.fields.items()}

    def write(self, folder: Path) -> None:
        """Write the model, and its fields where it has any; `OutputError` where that fails."""
        write_model(self.model, folder)
        if self.fields:
            write_lens_fields(self.plain_fields, folder)

    def words(self, given: "Lenses") -> str:
        """How its cameras differ from those of the given model."""
        words = []
        for number, pixels in bends(given.model, self.model).items():
            if pixels >= _TOLD:
                words.append(f"camera {number} by {pixels:.2f} px")
        for number, found in self.fields.items():
            words.append(
                f"camera {number} has a lens field of {found.rms:.2f} px, up to {found.largest:.2f} px, known to "
                f"{found.uncertainty:.2f} px"
            )
        return ", ".join(words)


def with_distortion(given: Lenses, ties: Observations, options: pycolmap.UndistortCameraOptions) -> Lenses | None:
    """Adjust the distortion of each camera of a model, with its poses.

    Parameters
    ----------
    given : Lenses
        Without fields.
    ties : Observations
        Image coordinates in the undistorted images.
    options : pycolmap.UndistortCameraOptions
        How these were undistorted.

    Returns
    -------
    Lenses or None
        Of the original images; None where the adjustment does not converge.
    """
    original = _original_ties(given, ties, options)
    model = submodel(given.model, set(image_names(given.model)))
    for camera in model.cameras.values():
        _as_opencv(camera)
    adjusted = adjusted_model(model, original, refine_distortion=True)
    return None if adjusted is None else Lenses(adjusted)


def with_fields(given: Lenses, ties: Observations, options: pycolmap.UndistortCameraOptions) -> Lenses | None:
    """Give cameras of a model their lens fields; parameters and result as of `with_distortion`.

    None, too, where no field is known well, and where the model's own points would fit worse. It is the given
    camera to which a field is added, not one with another distortion: what ties hardly tell, such as a focal
    length that goes with it, stays as given.
    """
    original = _original_ties(given, ties, options)
    found = found_fields(given.model, original, options)
    known = Lenses(given.model, {number: one for number, one in found.items() if one.is_known})
    if not known.fields:
        return None
    adjusted = adjusted_with_fields(given.model, known.plain_fields, original)
    if adjusted is None or sparse_error(adjusted, known.plain_fields) > (1 + _RISE) * sparse_error(given.model):
        return None
    return replace(known, model=adjusted)


def _original_ties(given: Lenses, ties: Observations, options: pycolmap.UndistortCameraOptions) -> Observations:
    """Ties in undistorted images where they are in the original ones; without those that are nowhere there."""
    cameras = cameras_of_images(given.model)
    pixels = ties.pixels.copy()
    for index, name in enumerate(ties.names):
        of_image = ties.image == index
        pixels[of_image] = distorted(cameras[name], pixels[of_image], options)
    seen = np.isfinite(pixels).all(axis=1)
    return replace(ties, track=ties.track[seen], image=ties.image[seen], pixels=pixels[seen])


def distorted(camera: pycolmap.Camera, pixels: Float, options: pycolmap.UndistortCameraOptions) -> Float:
    """(n, 2) coordinates in an original image of those in its undistorted one; NaN where it has none."""
    rays = pixel_rays(straight_camera(camera, options), pixels)
    return np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))).reshape(-1, 2)


def straightened(
    given: Lenses,
    refined: Lenses,
    observations: Observations,
    calibrations: Sequence[Float],
    options: pycolmap.UndistortCameraOptions,
) -> tuple[list[Float], Float]:
    """What refined cameras make of coordinates in undistorted images.

    Parameters
    ----------
    given, refined : Lenses
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
    images = {image.name: image for image in refined.model.images.values()}
    cameras = cameras_of_images(given.model)
    fields = refined.plain_fields
    pixels = observations.pixels.copy()
    poses = []
    for index, name in enumerate(observations.names):
        here = observations.image == index
        original = distorted(cameras[name], pixels[here], options)
        camera_id = images[name].camera_id
        rays = np.asarray(refined.model.camera(camera_id).cam_from_img(original)).reshape(-1, 2)
        if camera_id in fields:
            rays = fields[camera_id].straightened(rays)
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
