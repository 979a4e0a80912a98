"""Pinhole pictures of analytic scenes with exact depth and normals.

COLMAP's frames throughout: x right, y down, z forward, `x_cam = R x_world + t`, the first pixel's centre at
(0.5, 0.5). The picture is the mean over every pixel's area; depth and normals belong to one ray per pixel, so
they are exact and know no mixed pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import OptionError
from colmap_sph.synthetic.light import Light
from colmap_sph.synthetic.photographs.optics import sensor_readings
from colmap_sph.synthetic.photographs.sky import Sky
from colmap_sph.synthetic.primitives import FloatArray, Surface
from colmap_sph.synthetic.rays import Camera, Hits, Rays, trace
from colmap_sph.synthetic.texture import Float32Array

# Rays traced at once: enough to make NumPy's overhead small, few enough for 150 MB.
_BAND_RAYS = 600_000
_SKY = (0.72, 0.82, 0.93)


@dataclass(frozen=True)
class Rendering:
    """A picture and its truth.

    Attributes
    ----------
    image : (H, W, 3) uint8
        RGB, every pixel the mean of its area.
    depth : (H, W) float64
        z-depth along the ray through (col + origin, row + origin); 0 where nothing is met.
    normals : (H, W, 3) float64
        Unit normals in the camera frame, towards the camera; 0 where nothing is met.
    surface : (H, W) int16
        Number of the surface in the scene; -1 where nothing is met.
    """

    image: npt.NDArray[np.uint8]
    depth: FloatArray
    normals: FloatArray
    surface: npt.NDArray[np.int16]


def _groups(number: npt.NDArray[np.int16]) -> list[tuple[int, npt.NDArray[np.int64]]]:
    """Surface numbers that occur, each with the flat indices where."""
    flat = number.ravel()
    order = np.argsort(flat, kind="stable")
    edges = np.flatnonzero(np.diff(flat[order])) + 1
    return [(int(flat[part[0]]), part) for part in np.split(order, edges) if part.size and flat[part[0]] >= 0]


def _band_colour(surfaces: Sequence[Surface], rays: Rays, light: Light, sky: Sky | None) -> Float32Array:
    """Displayed RGB (..., 3) in [0, 1] along every ray."""
    hits = trace(surfaces, rays)
    colour = np.empty((hits.surface.size, 3), dtype=np.float32)
    colour[:] = _SKY
    directions = rays.directions.reshape(3, -1)
    if sky is not None:
        nothing = hits.surface.ravel() < 0
        colour[nothing] = sky.colour(directions[:, nothing])
    distance = hits.distance.ravel()
    face = hits.face.ravel()
    for number, places in _groups(hits.surface):
        surface = surfaces[number]
        faces = face[places]
        points = rays.points(distance[places], places)
        normals = surface.normals(points, faces)
        coordinates = surface.texture_coordinates(points, faces)
        shade = light.brightness(points, normals)
        used = surface.material_index(faces)
        for material in np.unique(used):
            chosen = slice(None) if len(surface.materials) == 1 else used == material
            shade[chosen] *= surface.materials[material].colour(coordinates[:, chosen])
        if light.specular > 0:
            shade += light.highlight(points, normals, directions[:, places])
        colour[places] = shade
    return np.clip(colour, 0.0, 1.0).reshape(*hits.surface.shape, 3)


def exact_picture(
    surfaces: Sequence[Surface],
    camera: Camera,
    *,
    supersample: int = 2,
    light: Light | None = None,
    sky: Sky | None = None,
) -> Float32Array:
    """What arrives at a sensor: every pixel the mean over its area.

    Parameters
    ----------
    surfaces : sequence of Surface
    camera : Camera
    supersample : int
        Rays per pixel in each direction.
    light : Light, optional
    sky : Sky, optional
        What is seen where no surface is met; one colour without it.

    Returns
    -------
    (H, W, 3) float32 ndarray
        Displayed RGB in 0 ... 255.
    """
    light = light or Light()
    width, height = camera.width, camera.height
    x = (np.arange(width * supersample) + 0.5) / supersample
    band = max(_BAND_RAYS // (width * supersample**2), 1)
    picture = np.empty((height, width, 3), dtype=np.float32)
    for top in range(0, height, band):
        bottom = min(top + band, height)
        y = (np.arange(top * supersample, bottom * supersample) + 0.5) / supersample
        colour = _band_colour(surfaces, camera.rays(x, y), light, sky)
        blocks = colour.reshape(bottom - top, supersample, width, supersample, 3)
        picture[top:bottom] = 255.0 * blocks.mean(axis=(1, 3))
    return picture


def _normals_in_camera(surfaces: Sequence[Surface], camera: Camera, rays: Rays, hits: Hits) -> FloatArray:
    normals = np.zeros((3, hits.surface.size))
    directions = rays.directions.reshape(3, -1)
    distance = hits.distance.ravel()
    face = hits.face.ravel()
    for number, places in _groups(hits.surface):
        towards = directions[:, places]
        outward = surfaces[number].normals(rays.points(distance[places], places), face[places])
        outward = np.where(np.sum(outward * towards, axis=0) > 0, -outward, outward)
        normals[:, places] = np.einsum("ij,jn->in", camera.R, outward)
    return np.ascontiguousarray(normals.T).reshape(*hits.surface.shape, 3)


def exact_geometry(
    surfaces: Sequence[Surface], camera: Camera, *, origin: float = 0.5
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int16]]:
    """Depth, normals and surface numbers without a picture; see `render`.

    Parameters
    ----------
    surfaces : sequence of Surface
    camera : Camera
    origin : float
        Geometry is that along the rays through (col + origin, row + origin).

    Returns
    -------
    depth : (H, W) float64 ndarray
        z-depth; 0 where nothing is met.
    normals : (H, W, 3) float64 ndarray
        Unit normals in the camera frame, towards the camera; 0 where nothing is met.
    surface : (H, W) int16 ndarray
        Number of the surface; -1 where nothing is met.
    """
    x: FloatArray = np.arange(camera.width, dtype=np.float64) + origin
    y: FloatArray = np.arange(camera.height, dtype=np.float64) + origin
    rays = camera.rays(x, y)
    hits = trace(surfaces, rays)
    depth = np.where(np.isfinite(hits.distance), rays.depth(hits.distance), 0.0)
    return depth, _normals_in_camera(surfaces, camera, rays, hits), hits.surface


def render(
    scene: Sequence[Surface],
    K: npt.ArrayLike,
    R: npt.ArrayLike,
    t: npt.ArrayLike,
    width: int,
    height: int,
    *,
    origin: float = 0.5,
    supersample: int = 2,
    light: Light | None = None,
    noise: float = 0.0,
    seed: int | Sequence[int] = 0,
) -> Rendering:
    """Render one view.

    Parameters
    ----------
    scene : sequence of Surface
    K : (3, 3) array_like
        Calibration matrix; the first pixel's centre is (0.5, 0.5).
    R, t : (3, 3) and (3,) array_like
        `x_cam = R x_world + t`, metres.
    width, height : int
        Pixels.
    origin : float
        Depth and normals belong to the image coordinates (col + origin, row + origin): 0.5 is the pixel's
        centre, 0.0 the place at which COLMAP's fusion takes a depth map's value.
    supersample : int
        Rays per pixel in each direction for the picture, spread over the pixel's area about its centre.
    light : Light, optional
    noise : float
        Standard deviation of the sensor noise in grey levels.
    seed : int or sequence of int
        Seed of the sensor noise.

    Returns
    -------
    Rendering

    Raises
    ------
    OptionError
        If a size, the supersampling or the noise is out of its bounds.
    """
    if width < 1 or height < 1 or supersample < 1 or noise < 0:
        raise OptionError(
            f"render wants width, height, supersample >= 1 and noise >= 0, "
            f"got {width}, {height}, {supersample}, {noise}"
        )
    K, R, t = (np.asarray(array, dtype=np.float64) for array in (K, R, t))
    camera = Camera(K, R, t, width, height)
    picture = exact_picture(scene, camera, supersample=supersample, light=light)
    image = sensor_readings(picture, noise, 0.0, np.random.default_rng(seed))
    depth, normals, surface = exact_geometry(scene, camera, origin=origin)
    return Rendering(image, depth, normals, surface)
