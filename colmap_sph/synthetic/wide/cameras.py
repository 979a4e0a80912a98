"""Fisheyes and panoramas, given by the ray of each pixel.

Rays have unit length: their parameter is the range, the distance from the camera's centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from colmap_sph.synthetic.primitives import FloatArray
from colmap_sph.synthetic.rays import Camera, Index, Rays

_STEPS = 60


@dataclass(frozen=True)
class WideCamera(Camera):
    """A camera whose `project`, `back_project` and traced distances have the range in place of the z-depth."""

    def directions(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Unit rays (3, N) in the camera frame of image coordinates (N,); NaN where the lens shows nothing."""
        raise NotImplementedError

    def places(self, directions: FloatArray) -> FloatArray:
        """Image coordinates (N, 2) of rays (N, 3) in the camera frame; NaN where the lens does not show them."""
        raise NotImplementedError

    def rays(self, x: FloatArray, y: FloatArray) -> Rays:
        """As `Camera.rays`."""
        across, down = np.meshgrid(x, y)
        return WideRays(self, self.directions(across.ravel(), down.ravel()).reshape(3, *across.shape))

    def rays_at(self, image: FloatArray) -> Rays:
        """As `Camera.rays_at`."""
        return WideRays(self, self.directions(image[:, 0], image[:, 1]))

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Image coordinates (N, 2) and range (N,) of world points (N, 3)."""
        in_camera = points @ self.R.T + self.t
        return self.places(in_camera), np.linalg.norm(in_camera, axis=1)

    def back_project(self, image: FloatArray, depth: FloatArray) -> FloatArray:
        """World points (N, 3) at image coordinates (N, 2) and range (N,)."""
        rays = self.directions(image[:, 0], image[:, 1]).T
        points: FloatArray = (rays * depth[:, None] - self.t) @ self.R
        return points


@dataclass(frozen=True)
class Fisheye(WideCamera):
    """COLMAP's OPENCV_FISHEYE: r = f (a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9), a the angle off the axis.

    Attributes
    ----------
    coefficients : tuple of float
        k1 ... k4.
    half_angle : float
        Degrees off the axis up to which the lens shows anything.
    """

    coefficients: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    half_angle: float = 95.0

    @property
    def colmap(self) -> tuple[str, list[float]]:
        """As `Camera.colmap`."""
        K = self.K
        return "OPENCV_FISHEYE", [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *self.coefficients]

    def _radius(self, angle: FloatArray) -> FloatArray:
        square = angle**2
        k1, k2, k3, k4 = self.coefficients
        radius: FloatArray = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
        return radius

    def directions(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """As `WideCamera.directions`: the angle is found by halving an interval."""
        u = (x - self.K[0, 2]) / self.K[0, 0]
        v = (y - self.K[1, 2]) / self.K[1, 1]
        radius = np.hypot(u, v)
        low = np.zeros_like(radius)
        high = np.full_like(radius, np.radians(self.half_angle))
        is_seen = radius <= self._radius(high)
        for _ in range(_STEPS):
            middle = (low + high) / 2
            beyond = self._radius(middle) > radius
            high = np.where(beyond, middle, high)
            low = np.where(beyond, low, middle)
        across = np.sin(low) / np.maximum(radius, 1e-12)
        return np.where(is_seen, np.stack([u * across, v * across, np.cos(low)]), np.nan)

    def places(self, directions: FloatArray) -> FloatArray:
        """As `WideCamera.places`."""
        off_axis = np.hypot(directions[:, 0], directions[:, 1])
        angle = np.arctan2(off_axis, directions[:, 2])
        scale = self._radius(angle) / np.maximum(off_axis, 1e-12)
        image = directions[:, :2] * scale[:, None] * self.K[[0, 1], [0, 1]] + self.K[:2, 2]
        return np.where(angle[:, None] <= np.radians(self.half_angle), image, np.nan)


@dataclass(frozen=True)
class Panorama(WideCamera):
    """COLMAP's EQUIRECTANGULAR: columns are angles about the y axis, rows angles from the horizon; K is unused."""

    @property
    def colmap(self) -> tuple[str, list[float]]:
        """As `Camera.colmap`."""
        return "EQUIRECTANGULAR", [self.width, self.height]

    def directions(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """As `WideCamera.directions`."""
        east = (x / self.width - 0.5) * 2 * np.pi
        down = (y / self.height - 0.5) * np.pi
        return np.stack([np.sin(east) * np.cos(down), np.sin(down), np.cos(east) * np.cos(down)])

    def places(self, directions: FloatArray) -> FloatArray:
        """As `WideCamera.places`."""
        east = np.arctan2(directions[:, 0], directions[:, 2])
        down = np.arctan2(directions[:, 1], np.hypot(directions[:, 0], directions[:, 2]))
        return np.column_stack([(east / (2 * np.pi) + 0.5) * self.width, (down / np.pi + 0.5) * self.height])


class WideRays(Rays):
    """Unit rays of a wide camera.

    Parameters
    ----------
    camera : WideCamera
    directions : (3, ...) float64 ndarray
        In the camera frame; NaN where the lens shows nothing.
    """

    def __init__(self, camera: WideCamera, directions: FloatArray) -> None:
        self.shape = directions.shape[1:]
        self.origins = camera.centre.reshape(3, *(1,) * len(self.shape))
        self.directions = np.einsum("ji,j...->i...", camera.R, directions)

    def windows(self, hulls: Sequence[FloatArray]) -> list[Index | None]:
        """As `Rays.windows`: the rays within a cone about a ball that holds the hull."""
        return [self._cone(hull) for hull in hulls]

    def take(self, index: Index) -> tuple[FloatArray, FloatArray]:
        """As `Rays.take`."""
        directions = self.directions[(slice(None), *index)]
        return self.origins.reshape(3, *(1,) * (directions.ndim - 1)), directions

    def _cone(self, hull: FloatArray) -> Index | None:
        middle = (hull.min(axis=0) + hull.max(axis=0)) / 2
        radius = np.linalg.norm(hull - middle, axis=1).max()
        towards = middle - self.origins.ravel()
        distance = np.linalg.norm(towards)
        if distance <= radius:
            return (slice(None),) * len(self.shape)
        cosine = np.einsum("i,i...->...", towards / distance, self.directions)
        near: npt.NDArray[np.bool_] = cosine >= np.sqrt(1 - (radius / distance) ** 2) - 1e-9
        return (near,) if near.any() else None
