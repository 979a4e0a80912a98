"""Sparse points with exact tracks over an analytic scene, and the COLMAP model made of them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from colmap_sph.errors import OutputError
from colmap_sph.synthetic.primitives import FloatArray, Surface
from colmap_sph.synthetic.rays import Camera, trace_points

MAX_INCIDENCE = 75.0
"""Degrees between a surface's normal and the ray up to which points are found, as a rule."""

# Of the depth: far below any thickness in a scene, far above the rounding of a projection.
_SAME_DEPTH = 1e-7
_BORDER = 4.0


@dataclass(frozen=True)
class SparsePoints:
    """Surface points and where the cameras see them.

    Attributes
    ----------
    points : (N, 3) float64
        Exact surface points, world frame, metres.
    observations : tuple of (n, 2) float64, one per camera
        Exact image coordinates.
    point_indices : tuple of (n,) int64, one per camera
        Row of `points` for every observation.
    """

    points: FloatArray
    observations: tuple[FloatArray, ...]
    point_indices: tuple[npt.NDArray[np.int64], ...]


def _candidates(
    surfaces: Sequence[Surface],
    cameras: Sequence[Camera],
    count: int,
    rng: np.random.Generator,
    blank: Collection[int],
) -> tuple[FloatArray, FloatArray]:
    """Points (N, 3) and world normals (N, 3) behind random places of every picture."""
    points = []
    normals = []
    for camera in cameras:
        image = rng.uniform([0.0, 0.0], [camera.width, camera.height], (count, 2))
        hits = trace_points(surfaces, camera, image)
        for number in np.unique(hits.surface[hits.surface >= 0]):
            if number in blank:
                continue
            chosen = hits.surface == number
            place = camera.back_project(image[chosen], hits.distance[chosen])
            normal = surfaces[number].normals(place.T, hits.face[chosen]).T
            away = np.sum(normal * (place - camera.centre), axis=1) > 0
            points.append(place)
            normals.append(np.where(away[:, None], -normal, normal))
    return np.concatenate(points), np.concatenate(normals)


def visible(
    surfaces: Sequence[Surface],
    camera: Camera,
    points: FloatArray,
    normals: FloatArray,
    *,
    max_incidence: float = MAX_INCIDENCE,
) -> npt.NDArray[np.bool_]:
    """Whether a camera sees points of surfaces, not too grazing.

    Parameters
    ----------
    surfaces : sequence of Surface
    camera : Camera
    points, normals : (N, 3) float64 ndarray
        On the surfaces, and outward; world frame.
    max_incidence : float
        Degrees between normal and ray up to which a surface is not too grazing.

    Returns
    -------
    (N,) bool ndarray
    """
    image, depth = camera.project(points)
    seen: npt.NDArray[np.bool_] = (depth > 0) & _inside(camera, image)
    towards = camera.centre - points
    cosine = np.sum(towards * normals, axis=1) / np.linalg.norm(towards, axis=1)
    seen &= cosine > np.cos(np.radians(max_incidence))
    places = np.flatnonzero(seen)
    nearest = trace_points(surfaces, camera, image[places]).distance
    seen[places] = np.abs(nearest - depth[places]) < _SAME_DEPTH * depth[places]
    places = np.flatnonzero(seen)
    seen[places] = _inside(camera, camera.observe(points[places]))
    return seen


def _inside(camera: Camera, image: FloatArray) -> npt.NDArray[np.bool_]:
    """Whether image coordinates (N, 2) lie in the picture, but for a border."""
    inside: npt.NDArray[np.bool_] = np.all(
        (image > _BORDER) & (image < np.array([camera.width, camera.height]) - _BORDER), axis=1
    )
    return inside


def sample_sparse_points(
    surfaces: Sequence[Surface],
    cameras: Sequence[Camera],
    count: int,
    rng: np.random.Generator,
    *,
    min_track_length: int = 3,
    max_incidence: float = MAX_INCIDENCE,
    blank: Collection[int] = (),
    moving: Sequence[Sequence[Surface]] | None = None,
) -> SparsePoints:
    """Sample surface points that at least `min_track_length` cameras see.

    Parameters
    ----------
    surfaces : sequence of Surface
    cameras : sequence of Camera
    count : int
        Number of points wanted; fewer where cameras overlap little.
    rng : numpy.random.Generator
    min_track_length : int
    max_incidence : float
        See `visible`.
    blank : collection of int
        Numbers of surfaces without texture: no point can be found on them.
    moving : sequence of sequence of Surface, one per camera, optional
        What else stands before each camera, and hides points.

    Returns
    -------
    SparsePoints
    """
    points, normals = _candidates(surfaces, cameras, 2 * count // len(cameras) + 1, rng, blank)
    others = moving or [()] * len(cameras)
    seen = np.stack(
        [
            visible((*surfaces, *before), camera, points, normals, max_incidence=max_incidence)
            for camera, before in zip(cameras, others, strict=True)
        ]
    )
    kept = rng.permutation(np.flatnonzero(seen.sum(axis=0) >= min_track_length))[:count]
    points = points[kept]
    seen = seen[:, kept]
    indices = tuple(np.flatnonzero(row) for row in seen)
    observations = tuple(camera.observe(points[rows]) for camera, rows in zip(cameras, indices, strict=True))
    return SparsePoints(points, observations, indices)


def _same_camera(first: Camera, second: Camera) -> bool:
    same_size = (first.width, first.height) == (second.width, second.height)
    return same_size and first.colmap == second.colmap


def _colmap_camera(camera: Camera, camera_id: int) -> pycolmap.Camera:
    name, parameters = camera.colmap
    return pycolmap.Camera(
        camera_id=camera_id, model=name, width=camera.width, height=camera.height, params=parameters
    )


def build_reconstruction(
    names: Sequence[str],
    cameras: Sequence[Camera],
    sparse: SparsePoints,
    *,
    colours: npt.NDArray[np.uint8] | None = None,
    keypoint_noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> pycolmap.Reconstruction:
    """Build a COLMAP model: shared cameras, posed images, points with tracks.

    Parameters
    ----------
    names : sequence of str
        Image names.
    cameras : sequence of Camera
        One per image; equal calibrations become one COLMAP camera.
    sparse : SparsePoints
    colours : (N, 3) uint8, optional
        RGB of the points.
    keypoint_noise : float
        Standard deviation in pixels added to the exact observations.
    rng : numpy.random.Generator, optional
        Needed for the noise.

    Returns
    -------
    pycolmap.Reconstruction
    """
    rng = rng or np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    kinds: list[Camera] = []
    tracks = [pycolmap.Track() for _ in sparse.points]
    for number, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        camera_id = next((k + 1 for k, kind in enumerate(kinds) if _same_camera(kind, camera)), 0)
        if camera_id == 0:
            kinds.append(camera)
            camera_id = len(kinds)
            model.add_camera_with_trivial_rig(_colmap_camera(camera, camera_id))
        exact = sparse.observations[number]
        keypoints = exact + keypoint_noise * rng.standard_normal(exact.shape)
        image = pycolmap.Image(name=name, keypoints=keypoints, camera_id=camera_id, image_id=number + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(camera.R), camera.t)
        model.add_image_with_trivial_frame(image, pose)
        for place, row in enumerate(sparse.point_indices[number]):
            tracks[row].add_element(number + 1, place)
    if colours is None:
        colours = np.full((len(sparse.points), 3), 128, dtype=np.uint8)
    for point, track, colour in zip(sparse.points, tracks, colours, strict=True):
        model.add_point3D(point, track, colour)
    model.update_point_3d_errors()
    return model


def write_reconstruction(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model in COLMAP's binary format.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        model.write_binary(str(folder))
    except (OSError, ValueError, RuntimeError) as error:
        raise OutputError(f"cannot write the sparse model to {folder}: {error}") from error
