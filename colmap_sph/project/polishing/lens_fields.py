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
from colmap_sph.project.polishing.lens_adjustment import Bundle, Sights, empty_field, fitted_fields
from colmap_sph.project.sparse_model import image_names, submodel

# A camera tells its field by so many images and observations; more do not tell more.
_FEWEST_IMAGES = 6
_FEWEST_SIGHTS = 2000
_MOST_IMAGES = 400
_MOST_PER_IMAGE = 1000
_MOST_SIGHTS = 100_000
# Of so many cameras, those with the most images; their equations are solved at once.
_MOST_FIELDS = 8
# Halves of the images must agree: a field is known to this share of itself. Larger ones, in shares of the image's
# longer side, are no matter of what a camera model leaves.
_KNOWN = 0.25
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
        """Whether it is much more than what is not known of it."""
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
    images = _images_of_cameras(model)
    fielded = sorted(images, key=lambda camera_id: (-len(images[camera_id]), camera_id))[:_MOST_FIELDS]
    fielded = [camera_id for camera_id in fielded if len(images[camera_id]) >= _FEWEST_IMAGES]
    if not fielded:
        return {}
    block = _Block.of(model, images, fielded, ties, options)
    halves = [block.half(start) for start in (0, 1)]
    if min(half.fewest_sights for half in halves) < _FEWEST_SIGHTS / 2:
        return {}
    fields, *others = [one.fitted() for one in (block, *halves)]
    found = {}
    for number, camera_id in enumerate(fielded):
        rays = block.rays_of(number)
        one = _measured([part[number] for part in (fields, *others)], rays, model.camera(camera_id))
        if one is not None:
            found[camera_id] = one
    return found


def _images_of_cameras(model: pycolmap.Reconstruction) -> dict[int, list[str]]:
    """Names of images by camera id, those in the middle where there are very many."""
    images: dict[int, list[str]] = {}
    camera_of = {image.name: image.camera_id for image in model.images.values()}
    names = image_names(model)
    for name in names:
        images.setdefault(camera_of[name], []).append(name)
    for camera_id, of_camera in images.items():
        most = max(len(of_camera) * _MOST_IMAGES // max(len(names), _MOST_IMAGES), 1)
        first = (len(of_camera) - most) // 2
        images[camera_id] = of_camera[first : first + most]
    return images


def _measured(fields: Sequence[LensField], rays: Float, camera: pycolmap.Camera) -> FoundField | None:
    """How large the first field is, and how well the others, of two halves, know it; None of what is no lens."""
    if not all(field.is_sound for field in fields):
        return None
    focal = float(camera.mean_focal_length())
    field, one, other = (focal * field.at(rays) for field in fields)
    moved = np.linalg.norm(field, axis=1)
    if moved.max() > _LARGEST * max(camera.width, camera.height):
        return None
    # The mean of both is known twice as well as their difference.
    unsure = np.linalg.norm(one - other, axis=1) / 2
    rms = [float(np.sqrt(np.mean(part**2))) for part in (moved, unsure)]
    return FoundField(fields[0], rms[0], float(moved.max()), rms[1])


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
class _Block:
    """What images observe, as it would be adjusted.

    Attributes
    ----------
    sights : Sights
    start : Bundle
    usual_error : float
        Pixels.
    parity : (n,) int64 ndarray
        0 or 1: the half that each image belongs to.
    """

    sights: Sights
    start: Bundle
    usual_error: float
    parity: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        model: pycolmap.Reconstruction,
        images: Mapping[int, Sequence[str]],
        fielded: Sequence[int],
        ties: Observations,
        options: pycolmap.UndistortCameraOptions,
    ) -> "_Block":
        named = {image.name: image for image in model.images.values()}
        chosen = [named[name] for names in images.values() for name in names]
        parity = np.concatenate([np.arange(len(names)) % 2 for names in images.values()])
        own, points = _own_sights(model, chosen)
        others = _tie_sights(model, chosen, ties)
        sights = Sights(
            np.concatenate([own.track, others.track + len(points)]),
            np.concatenate([own.image, others.image]),
            np.concatenate([own.rays, others.rays]),
        )
        poses = np.stack([image.cam_from_world().matrix() for image in chosen])
        domains = {image.camera_id: _domain(model.camera(image.camera_id), options) for image in chosen}
        numbers = {camera_id: number for number, camera_id in enumerate(fielded)}
        start = Bundle(
            poses[:, :, :3],
            poses[:, :, 3],
            np.concatenate([points, ties.points]),
            tuple(empty_field(*domains[camera_id]) for camera_id in fielded),
            np.array([numbers.get(image.camera_id, -1) for image in chosen]),
            np.array([model.camera(image.camera_id).mean_focal_length() for image in chosen]),
        )
        low, high = (np.stack([domains[image.camera_id][k] for image in chosen])[sights.image] for k in (0, 1))
        # Those at infinity are not.
        inside = np.asarray(((sights.rays >= low) & (sights.rays <= high)).all(axis=1))
        usual = float(np.clip(ties.error, _LEAST_USUAL, _MOST_USUAL))
        return cls(sights, start, usual, parity)._thinned(inside)

    @property
    def fewest_sights(self) -> int:
        """Observations in the images of the field that has the fewest."""
        return min(len(self.rays_of(number)) for number in range(len(self.start.fields)))

    def rays_of(self, number: int) -> Float:
        """(n, 2) rays observed in the images of a field."""
        return np.asarray(self.sights.rays[self.start.field_of[self.sights.image] == number])

    def fitted(self) -> tuple[LensField, ...]:
        """The fields that explain it best."""
        return fitted_fields(self.sights, self.start, self.usual_error).fields

    def half(self, parity: int) -> "_Block":
        """Every other image of each camera alone."""
        chosen = self.parity == parity
        inside = chosen[self.sights.image]
        number = np.bincount(self.sights.track[inside], minlength=len(self.start.points))
        half = self._only(np.flatnonzero(number >= 2), inside)
        numbers = np.cumsum(chosen) - 1
        start = half.start
        poses = {name: getattr(start, name)[chosen] for name in ("R", "t", "field_of", "focal")}
        sights = replace(half.sights, image=numbers[half.sights.image])
        return replace(half, sights=sights, start=replace(start, **poses), parity=self.parity[chosen])

    def _thinned(self, seen: NDArray[np.bool_]) -> "_Block":
        """With points that are seen at least twice, and no more of them than needed."""
        points = self.start.points
        number = np.bincount(self.sights.track[seen], minlength=len(points))
        usable = np.flatnonzero((number >= 2) & np.isfinite(points).all(axis=1))
        most = min(_MOST_PER_IMAGE * len(self.start.R), _MOST_SIGHTS)
        stride = max(-(-int(number[usable].sum()) // most), 1)
        return self._only(usable[::stride], seen)

    def _only(self, kept: NDArray[np.int64], seen: NDArray[np.bool_]) -> "_Block":
        """Some points, by ascending index, and those of their sights that are to count."""
        numbers = np.full(len(self.start.points), -1)
        numbers[kept] = np.arange(len(kept))
        track = numbers[self.sights.track]
        chosen = np.flatnonzero(seen & (track >= 0))
        chosen = chosen[np.argsort(track[chosen], kind="stable")]
        sights = Sights(track[chosen], self.sights.image[chosen], self.sights.rays[chosen])
        return replace(self, sights=sights, start=replace(self.start, points=self.start.points[kept]))


def _domain(camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions) -> tuple[Float, Float]:
    """Corners of the rays of an undistorted image, and a little beyond."""
    straight = straight_camera(camera, options)
    low, high = pixel_rays(straight, np.array([[0, 0], [straight.width, straight.height]]))
    margin = _BEYOND * (high - low)
    return low - margin, high + margin


def _own_sights(model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image]) -> tuple[Sights, Float]:
    """What images observe of the model's own points, and these."""
    rows = {point_id: row for row, point_id in enumerate(sorted(model.points3D))}
    tracks = []
    rays = []
    for image in images:
        seen = [point for point in image.points2D if point.has_point3D()]
        tracks.append(np.array([rows[point.point3D_id] for point in seen], np.int64))
        pixels = np.array([point.xy for point in seen]).reshape(-1, 2)
        rays.append(_rays(model.camera(image.camera_id), pixels))
    numbers = np.repeat(np.arange(len(images)), [len(track) for track in tracks])
    points = np.array([model.point3D(point_id).xyz for point_id in rows]).reshape(-1, 3)
    return Sights(np.concatenate(tracks), numbers, np.concatenate(rays)), points


def _tie_sights(model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image], ties: Observations) -> Sights:
    """Ties in some images."""
    indices = {name: index for index, name in enumerate(ties.names)}
    here = [np.flatnonzero(ties.image == indices.get(image.name, -1)) for image in images]
    cameras = [model.camera(image.camera_id) for image in images]
    rays = [_rays(camera, ties.pixels[some]) for camera, some in zip(cameras, here, strict=True)]
    numbers = np.repeat(np.arange(len(images)), [len(some) for some in here])
    return Sights(ties.track[np.concatenate(here)], numbers, np.concatenate(rays))


def _rays(camera: pycolmap.Camera, pixels: Float) -> Float:
    return np.asarray(camera.cam_from_img(pixels), np.float64).reshape(-1, 2)


def _pixels(image: pycolmap.Image) -> Float:
    return np.array([point.xy for point in image.points2D]).reshape(-1, 2)


def _place(image: pycolmap.Image, pixels: Float) -> None:
    for point, xy in zip(image.points2D, pixels, strict=True):
        point.xy = xy
