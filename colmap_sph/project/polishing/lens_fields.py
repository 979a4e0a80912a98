"""The original model and tracks → what the lens of each of its cameras does beyond the camera model.

A field is believed where both halves of a camera's images, each for itself, tell the same.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.project.lens.field import Float, LensField
from colmap_sph.project.lens.straight import pixel_rays, straight_camera
from colmap_sph.project.polishing.adjustment import Observations, adjusted_model
from colmap_sph.project.polishing.lens_adjustment import Bundle, Sights, empty_field, fitted_field
from colmap_sph.project.sparse_model import image_names, submodel

# A camera tells its field by so many images and observations; more do not tell more.
_FEWEST_IMAGES = 6
_FEWEST_SIGHTS = 2000
_MOST_IMAGES = 400
_MOST_PER_IMAGE = 1000
_MOST_SIGHTS = 100_000
# Halves of the images must agree: a field is known to this share of itself. Larger ones, in shares of the image's
# longer side, are no matter of what a camera model leaves.
_KNOWN = 0.5
_LARGEST = 0.03
# Sights outside of the undistorted image tell little: shares of its size.
_BEYOND = 0.02
# Pixels, as in the adjustment of poses.
_LEAST_USUAL = 0.1
_MOST_USUAL = 1.0


@dataclass(frozen=True, eq=False)
class FoundField:
    """A lens field, and how large it is, pixels of the original image.

    Attributes
    ----------
    field : LensField
    rms, largest : float
        Displacements where points were observed.
    uncertainty : float
        How well they are known, root mean square: as halves of the images differ.
    """

    field: LensField
    rms: float
    largest: float
    uncertainty: float

    @property
    def is_known(self) -> bool:
        """Whether it is more than what is not known of it."""
        return self.uncertainty < _KNOWN * self.rms


def found_fields(
    model: pycolmap.Reconstruction, ties: Observations, options: pycolmap.UndistortCameraOptions
) -> dict[int, FoundField]:
    """Look for the lens fields of a model's cameras.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        The original model.
    ties : Observations
        Tracks beside the model's own, in the original images.
    options : pycolmap.UndistortCameraOptions
        What of an image becomes the undistorted one.

    Returns
    -------
    dict
        By camera id; of those with enough images and observations.
    """
    found = {}
    of_camera: dict[int, list[str]] = {}
    camera_of = {image.name: image.camera_id for image in model.images.values()}
    for name in image_names(model):
        of_camera.setdefault(camera_of[name], []).append(name)
    for camera_id, names in sorted(of_camera.items()):
        if len(names) >= _FEWEST_IMAGES:
            part = _CameraPart.of(model, names, ties, straight_camera(model.camera(camera_id), options))
            field = part.found()
            if field is not None:
                found[camera_id] = field
    return found


def adjusted_with_fields(
    model: pycolmap.Reconstruction, fields: Mapping[int, LensField], ties: Observations
) -> pycolmap.Reconstruction | None:
    """Adjust the poses and points of an original model, with what its lenses do taken out of all observations.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    fields : mapping of int to LensField
        By camera id.
    ties : Observations
        Tracks beside the model's own, in the original images.

    Returns
    -------
    pycolmap.Reconstruction or None
        With the observations as they were; None where the adjustment does not converge.
    """
    straight = submodel(model, set(image_names(model)))
    observed = {image_id: _pixels(image) for image_id, image in straight.images.items()}
    for image_id, image in straight.images.items():
        if image.camera_id in fields:
            camera = straight.camera(image.camera_id)
            _place(image, straightened_pixels(camera, fields[image.camera_id], observed[image_id]))
    adjusted = adjusted_model(straight, straightened_ties(model, fields, ties), trust_centers=True)
    if adjusted is not None:
        for image_id, image in adjusted.images.items():
            _place(image, observed[image_id])
    return adjusted


def straightened_ties(
    model: pycolmap.Reconstruction, fields: Mapping[int, LensField], ties: Observations
) -> Observations:
    """Observations in original images where they would be without the lens fields."""
    pixels = ties.pixels.copy()
    images = {image.name: image for image in model.images.values()}
    for index, name in enumerate(ties.names):
        camera_id = images[name].camera_id
        if camera_id in fields:
            here = ties.image == index
            pixels[here] = straightened_pixels(model.camera(camera_id), fields[camera_id], pixels[here])
    return replace(ties, pixels=pixels)


def straightened_pixels(camera: pycolmap.Camera, field: LensField, pixels: Float) -> Float:
    """(n, 2) coordinates in an original image where they would be without a lens field."""
    rays = field.straightened(_rays(camera, pixels))
    return np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))).reshape(-1, 2)


def sparse_error(model: pycolmap.Reconstruction, fields: Mapping[int, LensField] | None = None) -> float:
    """Median distance, pixels, of a model's points from where its images observe them; 0 without any."""
    errors = []
    for image in model.images.values():
        camera = model.camera(image.camera_id)
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            continue
        pixels = np.array([point.xy for point in seen])
        if fields and image.camera_id in fields:
            pixels = straightened_pixels(camera, fields[image.camera_id], pixels)
        points = np.array([model.point3D(point.point3D_id).xyz for point in seen])
        pose = image.cam_from_world().matrix()
        there = np.asarray(camera.img_from_cam(points @ pose[:, :3].T + pose[:, 3])).reshape(-1, 2)
        errors.append(np.linalg.norm(pixels - there, axis=1))
    return float(np.nanmedian(np.concatenate(errors))) if errors else 0.0


@dataclass(frozen=True, eq=False)
class _CameraPart:
    """What the images of one camera observe, as they would be adjusted."""

    camera: pycolmap.Camera
    domain: tuple[Float, Float]
    sights: Sights
    R: Float
    t: Float
    points: Float
    usual_error: float

    @classmethod
    def of(
        cls,
        model: pycolmap.Reconstruction,
        names: Sequence[str],
        ties: Observations,
        straight: pycolmap.Camera,
    ) -> "_CameraPart":
        middle = max(len(names) - _MOST_IMAGES, 0) // 2
        names = names[middle : middle + _MOST_IMAGES]
        images = {image.name: image for image in model.images.values()}
        camera = model.camera(images[names[0]].camera_id)
        own, points = _own_sights(model, [images[name] for name in names])
        others = _tie_sights(ties, names, camera)
        sights = Sights(
            np.concatenate([own.track, others.track + len(points)]),
            np.concatenate([own.image, others.image]),
            np.concatenate([own.rays, others.rays]),
        )
        low, high = pixel_rays(straight, np.array([[0, 0], [straight.width, straight.height]]))
        margin = _BEYOND * (high - low)
        domain = (low - margin, high + margin)
        poses = np.stack([images[name].cam_from_world().matrix() for name in names])
        part = cls(
            camera,
            domain,
            sights,
            poses[:, :, :3],
            poses[:, :, 3],
            np.concatenate([points, ties.points]),
            float(np.clip(ties.error, _LEAST_USUAL, _MOST_USUAL)),
        )
        return part._thinned()

    @property
    def _focal(self) -> float:
        return float(self.camera.mean_focal_length())

    def _thinned(self) -> "_CameraPart":
        """With points that are seen at least twice, inside of the undistorted image, and no more than needed."""
        rays = self.sights.rays  # those at infinity are not inside
        inside = np.asarray(((rays >= self.domain[0]) & (rays <= self.domain[1])).all(axis=1))
        number = np.bincount(self.sights.track[inside], minlength=len(self.points))
        usable = np.flatnonzero((number >= 2) & np.isfinite(self.points).all(axis=1))
        most = min(_MOST_PER_IMAGE * len(self.R), _MOST_SIGHTS)
        stride = max(-(-int(number[usable].sum()) // most), 1)
        return self._only(usable[::stride], inside)

    def _only(self, kept: NDArray[np.int64], seen: NDArray[np.bool_]) -> "_CameraPart":
        """Some points, by ascending index, and those of their sights that are to count."""
        numbers = np.full(len(self.points), -1)
        numbers[kept] = np.arange(len(kept))
        chosen = seen & (numbers[self.sights.track] >= 0)
        order = np.argsort(numbers[self.sights.track[chosen]], kind="stable")
        sights = Sights(
            numbers[self.sights.track[chosen]][order],
            self.sights.image[chosen][order],
            self.sights.rays[chosen][order],
        )
        return replace(self, sights=sights, points=self.points[kept])

    def _half(self, start: int) -> "_CameraPart":
        """Every other image alone."""
        inside = np.equal(self.sights.image % 2, start)
        number = np.bincount(self.sights.track[inside], minlength=len(self.points))
        half = self._only(np.flatnonzero(number >= 2), inside)
        sights = replace(half.sights, image=half.sights.image // 2)
        return replace(half, sights=sights, R=self.R[start::2], t=self.t[start::2])

    def _field(self) -> LensField:
        start = Bundle(self.R, self.t, self.points, empty_field(*self.domain))
        return fitted_field(self.sights, start, self._focal, self.usual_error).field

    def found(self) -> FoundField | None:
        """The field, if there are enough observations, and they tell any."""
        halves = [self._half(start) for start in (0, 1)]
        if min(len(half.sights.track) for half in halves) < _FEWEST_SIGHTS / 2:
            return None
        field = self._field()
        others = [half._field() for half in halves]
        if not all(one.is_sound for one in (field, *others)):
            return None
        rays = self.sights.rays
        moved = np.linalg.norm(field.at(rays), axis=1) * self._focal
        apart = np.linalg.norm(others[0].at(rays) - others[1].at(rays), axis=1) * self._focal
        if moved.max() > _LARGEST * max(self.camera.width, self.camera.height):
            return None
        # The mean of both is known twice as well as their difference.
        rms, unsure = (float(np.sqrt(np.mean(part**2))) for part in (moved, apart / 2))
        return FoundField(field, rms, float(moved.max()), unsure)


def _own_sights(model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image]) -> tuple[Sights, Float]:
    """What images of one camera observe of the model's own points, and these."""
    tracks, numbers, pixels = [], [], []
    rows = {point_id: row for row, point_id in enumerate(sorted(model.points3D))}
    for number, image in enumerate(images):
        seen = [point for point in image.points2D if point.has_point3D()]
        tracks += [rows[point.point3D_id] for point in seen]
        numbers += [number] * len(seen)
        pixels += [point.xy for point in seen]
    points = np.array([model.point3D(point_id).xyz for point_id in rows]).reshape(-1, 3)
    rays = _rays(model.camera(images[0].camera_id), np.array(pixels).reshape(-1, 2))
    return Sights(np.array(tracks, np.int64), np.array(numbers, np.int64), rays), points


def _tie_sights(ties: Observations, names: Sequence[str], camera: pycolmap.Camera) -> Sights:
    """Ties in some images of one camera."""
    numbers = {name: number for number, name in enumerate(names)}
    number = np.array([numbers.get(name, -1) for name in ties.names], np.int64)[ties.image]
    here = number >= 0
    return Sights(ties.track[here], number[here], _rays(camera, ties.pixels[here]))


def _rays(camera: pycolmap.Camera, pixels: Float) -> Float:
    return np.asarray(camera.cam_from_img(pixels), np.float64).reshape(-1, 2)


def _pixels(image: pycolmap.Image) -> Float:
    return np.array([point.xy for point in image.points2D]).reshape(-1, 2)


def _place(image: pycolmap.Image, pixels: Float) -> None:
    for point, xy in zip(image.points2D, pixels, strict=True):
        point.xy = xy
