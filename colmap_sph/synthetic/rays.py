"""Cameras, their rays, and the first surface along each.

COLMAP's frames: x right, y down, z forward, `x_cam = R x_world + t`, the first pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from colmap_sph.synthetic.primitives import FloatArray, Surface

_NEAR = 1e-6

Index = tuple[Any, ...]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with its pose.

    Attributes
    ----------
    K : (3, 3) float64
        Calibration matrix in COLMAP's image coordinates (first pixel's centre at 0.5).
    R, t : (3, 3) and (3,) float64
        `x_cam = R x_world + t`.
    width, height : int
        Pixels.
    """

    K: FloatArray
    R: FloatArray
    t: FloatArray
    width: int
    height: int

    @property
    def centre(self) -> FloatArray:
        """Camera centre (3,) in the world."""
        return -self.R.T @ self.t

    def rays(self, x: FloatArray, y: FloatArray) -> Rays:
        """Rays through the grid of image coordinates x (W,) and y (H,), pixels."""
        return PinholeRays(self, x, y, grid=True)

    def rays_at(self, image: FloatArray) -> Rays:
        """Rays through image coordinates (N, 2), pixels, of the camera that a written model knows."""
        return PinholeRays(self, image[:, 0], image[:, 1], grid=False)

    @property
    def colmap(self) -> tuple[str, list[float]]:
        """Name of its COLMAP camera model, and the parameters."""
        return "PINHOLE", [self.K[0, 0], self.K[1, 1], self.K[0, 2], self.K[1, 2]]

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Image coordinates (N, 2) and z-depth (N,) of world points (N, 3)."""
        in_camera = points @ self.R.T + self.t
        with np.errstate(divide="ignore", invalid="ignore"):
            homogeneous = in_camera @ self.K.T
            image = homogeneous[:, :2] / homogeneous[:, 2:]
        return image, in_camera[:, 2]

    def observe(self, points: FloatArray) -> FloatArray:
        """Image coordinates (N, 2) at which world points (N, 3) appear."""
        return self.project(points)[0]

    def back_project(self, image: FloatArray, depth: FloatArray) -> FloatArray:
        """World points (N, 3) at image coordinates (N, 2) and z-depth (N,)."""
        rays = np.column_stack([image, np.ones(len(image))]) @ np.linalg.inv(self.K).T
        points: FloatArray = (rays * depth[:, None] - self.t) @ self.R
        return points


@dataclass(frozen=True)
class Hits:
    """What rays meet first: ray parameter (inf: nothing), number of the surface (-1: nothing), its face."""

    distance: FloatArray
    surface: npt.NDArray[np.int16]
    face: npt.NDArray[np.int8]


class Rays:
    """Rays of one camera: origins and directions (3, ...) and the part of them that can meet a surface."""

    origins: FloatArray
    directions: FloatArray
    shape: tuple[int, ...]

    def image(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where world points (N, 3) appear: coordinates (N, 2) among the rays, depth (N,)."""
        raise NotImplementedError

    def window(self, low: FloatArray, high: FloatArray) -> Index | None:
        """Index of the rays within a rectangle of those coordinates; None if there is none."""
        raise NotImplementedError

    def depth(self, distance: FloatArray) -> FloatArray:
        """z-depth (...) in the camera of the rays' points at parameters (...), infinite ones stay."""
        return distance

    def points(self, distance: FloatArray, places: npt.NDArray[np.int64]) -> FloatArray:
        """World points (3, N) on the rays of flat indices `places`, at parameters (N,)."""
        directions = self.directions.reshape(3, -1)[:, places]
        if self.origins.size == 3:
            return self.origins.reshape(3, 1) + distance * directions
        origins = np.broadcast_to(self.origins, self.directions.shape).reshape(3, -1)[:, places]
        points: FloatArray = origins + distance * directions
        return points

    def windows(self, hulls: Sequence[FloatArray]) -> list[Index | None]:
        """Index of the rays that may meet the convex hull of each set of points (M, 3)."""
        if not hulls:
            return []
        starts = np.cumsum([0] + [len(hull) for hull in hulls[:-1]])
        image, depth = self.image(np.concatenate(hulls))
        low, high = np.minimum.reduceat(image, starts), np.maximum.reduceat(image, starts)
        nearest = np.minimum.reduceat(depth, starts)
        farthest = np.maximum.reduceat(depth, starts)
        everything: Index = (slice(None),) * len(self.shape)
        found: list[Index | None] = []
        for number in range(len(hulls)):
            if nearest[number] > _NEAR:
                found.append(self.window(low[number], high[number]))
            else:  # the object reaches behind the camera: its outline has no bounds
                found.append(everything if farthest[number] > 0 else None)
        return found

    def take(self, index: Index) -> tuple[FloatArray, FloatArray]:
        """Origins and directions of the rays at an index."""
        return _take(self.origins, index), _take(self.directions, index)


def _take(array: FloatArray, index: Index) -> FloatArray:
    constant = all(size == 1 for size in array.shape[1:])
    return array if constant else array[(slice(None), *index)]


def grid_window(x: FloatArray, y: FloatArray, low: FloatArray, high: FloatArray) -> Index | None:
    """Index of the part of a grid of ascending x and y that lies between two corners; None if nothing does."""
    left, right = np.searchsorted(x, [low[0], high[0]])
    top, bottom = np.searchsorted(y, [low[1], high[1]])
    return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None


class OrthographicRays(Rays):
    """Parallel rays on the grid x, y along the first two axes.

    Parameters
    ----------
    x : (W,) float64 ndarray
    y : (H,) float64 ndarray
        Places of the grid along the first two axes, metres.
    origins : (3, H, W) float64 ndarray
        World frame.
    direction : (3, 1, 1) float64 ndarray
        World frame.
    axes : (3, 3) float64 ndarray
        Rows: along x, along y, along the rays; world frame.
    """

    def __init__(
        self, x: FloatArray, y: FloatArray, origins: FloatArray, direction: FloatArray, axes: FloatArray
    ) -> None:
        self.x = x
        self.y = y
        self.axes = axes
        self.origins = origins
        self.directions = direction
        self.shape = (y.size, x.size)

    def image(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        return points @ self.axes[:2].T, np.full(len(points), np.inf)

    def window(self, low: FloatArray, high: FloatArray) -> Index | None:
        return grid_window(self.x, self.y, low, high)


class PinholeRays(Rays):
    """Rays of unit z through image coordinates: a grid, or a list of places.

    Parameters
    ----------
    camera : Camera
    x, y : (W,) and (H,), or (N,) and (N,) float64 ndarray
        Image coordinates, pixels.
    grid : bool
        Whether x and y are the sides of a grid, or one place each.
    """

    def __init__(self, camera: Camera, x: FloatArray, y: FloatArray, *, grid: bool) -> None:
        self.camera = camera
        self.x = x
        self.y = y
        self.grid = grid
        self.shape = (y.size, x.size) if grid else x.shape
        ones = (1,) * len(self.shape)
        across = x[None, :] if grid else x
        down = y[:, None] if grid else y
        along_x, along_y, constant = (camera.R.T @ np.linalg.inv(camera.K)).T
        self.origins = camera.centre.reshape(3, *ones)
        self.directions = (
            along_x.reshape(3, *ones) * across + along_y.reshape(3, *ones) * down + constant.reshape(3, *ones)
        )

    def image(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.camera.project(points)

    def window(self, low: FloatArray, high: FloatArray) -> Index | None:
        if self.grid:
            return grid_window(self.x, self.y, low, high)
        inside = (self.x >= low[0]) & (self.x <= high[0]) & (self.y >= low[1]) & (self.y <= high[1])
        places = np.flatnonzero(inside)
        return (places,) if places.size else None


def trace(surfaces: Sequence[Surface], rays: Rays) -> Hits:
    """First surface along every ray."""
    distance = np.full(rays.shape, np.inf)
    number = np.full(rays.shape, -1, dtype=np.int16)
    face = np.zeros(rays.shape, dtype=np.int8)
    everything: Index = (slice(None),) * len(rays.shape)
    hulls = [surface.corners() for surface in surfaces]
    windows = iter(rays.windows([hull for hull in hulls if hull is not None]))
    for index, (surface, hull) in enumerate(zip(surfaces, hulls, strict=True)):
        window = everything if hull is None else next(windows)
        if window is None:
            continue
        here, side = surface.intersect(*rays.take(window))
        nearer = here < distance[window]
        distance[window] = np.where(nearer, here, distance[window])
        number[window] = np.where(nearer, np.int16(index), number[window])
        face[window] = np.where(nearer, side, face[window]).astype(np.int8)
    return Hits(distance, number, face)


def trace_points(surfaces: Sequence[Surface], camera: Camera, image: FloatArray) -> Hits:
    """First surface along the rays through places of the image.

    Parameters
    ----------
    surfaces : sequence of Surface
    camera : Camera
    image : (N, 2) float64 ndarray
        Image coordinates, pixels.

    Returns
    -------
    Hits
        Their distance is the z-depth, of a wide camera the range.
    """
    return trace(surfaces, camera.rays_at(image))
