"""Surfaces that a ray meets in closed form: planes, convex polyhedra, ellipsoids.

World frame: metres, z up. A ray is `origin + s * direction`; with a direction of unit z in the camera frame
the parameter s is the z-depth. Rays and points are stored component first, `(3, ...)`, so that every
component is contiguous. Solids are met from outside only.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from colmap_sph.synthetic.texture import Material

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]

CORNER_SIGNS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
"""(8, 3) the corners of a box of half sides 1."""


def _dot(vector: FloatArray, field_: FloatArray) -> FloatArray:
    """Scalar product of one (3,) vector with a (3, ...) field."""
    product: FloatArray = vector[0] * field_[0] + vector[1] * field_[1] + vector[2] * field_[2]
    return product


def _unit(vector: npt.ArrayLike) -> FloatArray:
    array = np.asarray(vector, dtype=np.float64)
    return array / np.linalg.norm(array)


def _tangents(normal: FloatArray, yaw: float = 0.0) -> FloatArray:
    """Two in-plane unit axes (2, 3): the horizontal one and the one up the slope (yaw turns level planes)."""
    horizontal = np.array([-normal[1], normal[0], 0.0])
    if np.hypot(horizontal[0], horizontal[1]) < 1e-9:
        horizontal = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    horizontal = _unit(horizontal)
    return np.stack([horizontal, np.cross(normal, horizontal)])


class Surface(ABC):
    """One object of a scene; its faces are numbered and may carry different materials."""

    materials: tuple[Material, ...]

    @abstractmethod
    def intersect(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
        """First intersection in front of the origins.

        Parameters
        ----------
        origins, directions : (3, ...) float64
            Rays in the world frame; the two broadcast against each other.

        Returns
        -------
        distance : (...) float64
            Ray parameter s > 0, inf where the ray misses.
        face : (...) int
            Number of the face, meaningless where the ray misses.
        """

    @abstractmethod
    def normals(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """Outward unit normals (3, N) in the world frame at surface points (3, N)."""

    @abstractmethod
    def texture_coordinates(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """Coordinates (2, N) in metres within the surface, which its materials are drawn in."""

    def corners(self) -> FloatArray | None:
        """Corners (M, 3) whose convex hull holds the surface; None for an unbounded one."""
        return None

    def material_index(self, faces: IntArray) -> IntArray:
        """Index into `materials` for each face number."""
        return np.minimum(faces, len(self.materials) - 1)


@dataclass(frozen=True)
class Plane(Surface):
    """A plane through `point`, seen from both sides, endless unless `half_size` bounds it.

    Parameters
    ----------
    point, normal : (3,) array_like
    material : Material
    half_size : (float, float), optional
        Half lengths in metres along the horizontal in-plane axis and along the axis up the slope.
    """

    point: npt.ArrayLike
    normal: npt.ArrayLike
    material: Material
    half_size: tuple[float, float] | None = None
    materials: tuple[Material, ...] = field(init=False)
    _point: FloatArray = field(init=False, repr=False)
    _normal: FloatArray = field(init=False, repr=False)
    _axes: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        normal = _unit(self.normal)
        object.__setattr__(self, "materials", (self.material,))
        object.__setattr__(self, "_point", np.asarray(self.point, dtype=np.float64))
        object.__setattr__(self, "_normal", normal)
        object.__setattr__(self, "_axes", _tangents(normal))

    def intersect(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
        """See `Surface.intersect`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self._normal @ self._point - _dot(self._normal, origins)) / _dot(self._normal, directions)
        hit = np.isfinite(distance) & (distance > 0)
        if self.half_size is not None:
            offset = origins - self._point.reshape((3,) + (1,) * (origins.ndim - 1))
            for axis, half in zip(self._axes, self.half_size, strict=True):
                with np.errstate(invalid="ignore"):
                    hit &= np.abs(_dot(axis, offset) + distance * _dot(axis, directions)) <= half
        distance = np.where(hit, distance, np.inf)
        return distance, np.zeros(distance.shape, dtype=np.int8)

    def normals(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """See `Surface.normals`."""
        return np.broadcast_to(self._normal[:, None], points.shape)

    def texture_coordinates(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """See `Surface.texture_coordinates`."""
        coordinates: FloatArray = np.einsum("ij,jn->in", self._axes, points - self._point[:, None])
        return coordinates

    def corners(self) -> FloatArray | None:
        """See `Surface.corners`."""
        if self.half_size is None:
            return None
        signs = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * np.asarray(self.half_size)
        corners: FloatArray = self._point + signs @ self._axes
        return corners


@dataclass(frozen=True)
class ConvexPolyhedron(Surface):
    """Intersection of the half-spaces `face_normals @ x <= offsets`.

    Parameters
    ----------
    face_normals : (F, 3) float64
        Outward unit normals.
    offsets : (F,) float64
    hull : (M, 3) float64
        Points whose convex hull holds the solid (a bounding box will do).
    anchor : (3,) float64
        Origin of the texture coordinates.
    materials : tuple of Material
        One for every face (the last serves the remaining ones).
    yaw : float
        Turns the texture of level faces, in radians.
    """

    face_normals: FloatArray
    offsets: FloatArray
    hull: FloatArray
    anchor: FloatArray
    materials: tuple[Material, ...]
    yaw: float = 0.0

    def intersect(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
        """See `Surface.intersect`."""
        shape = np.broadcast_shapes(origins.shape, directions.shape)[1:]
        enter = np.full(shape, -np.inf)
        leave = np.full(shape, np.inf)
        face = np.zeros(shape, dtype=np.int8)
        for number, (normal, offset) in enumerate(zip(self.face_normals, self.offsets, strict=True)):
            gap = offset - _dot(normal, origins)
            slope = np.broadcast_to(_dot(normal, directions), shape)
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = gap / slope
            later = (slope < 0) & (distance > enter)
            np.copyto(enter, distance, where=later)
            face[later] = number
            np.copyto(leave, distance, where=(slope > 0) & (distance < leave))
            leave[(slope == 0) & (gap < 0)] = -np.inf
        return np.where((enter <= leave) & (enter > 0), enter, np.inf), face

    def normals(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """See `Surface.normals`."""
        return self.face_normals[faces].T

    def texture_coordinates(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """See `Surface.texture_coordinates`."""
        axes = np.stack([_tangents(normal, self.yaw) for normal in self.face_normals])[faces]
        coordinates: FloatArray = np.einsum("nij,jn->in", axes, points - self.anchor[:, None])
        return coordinates

    def corners(self) -> FloatArray | None:
        """See `Surface.corners`."""
        return self.hull


@dataclass(frozen=True)
class Ellipsoid(Surface):
    """An ellipsoid with axes along the world axes.

    Parameters
    ----------
    centre, radii : (3,) float64
    material : Material
    """

    centre: FloatArray
    radii: FloatArray
    material: Material
    materials: tuple[Material, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "materials", (self.material,))

    def intersect(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
        """See `Surface.intersect`."""
        column = (3,) + (1,) * (directions.ndim - 1)
        offset = (origins - self.centre.reshape(column)) / self.radii.reshape(column)
        scaled = directions / self.radii.reshape(column)
        square = np.sum(scaled * scaled, axis=0)
        nearest = -np.sum(offset * scaled, axis=0) / square
        # Distance of the line from the centre, not b^2 - 4ac: no cancellation for far away spheres.
        miss = np.sum((offset + nearest * scaled) ** 2, axis=0)
        with np.errstate(invalid="ignore"):
            distance = nearest - np.sqrt((1.0 - miss) / square)
            distance = np.where(distance > 0, distance, np.inf)
        return distance, np.zeros(distance.shape, dtype=np.int8)

    def normals(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """See `Surface.normals`."""
        gradient = (points - self.centre[:, None]) / self.radii[:, None] ** 2
        unit: FloatArray = gradient / np.linalg.norm(gradient, axis=0)
        return unit

    def texture_coordinates(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """Projection along the axis nearest to the normal; its seams do not show in foliage."""
        local = points - self.centre[:, None]
        axis = np.argmax(np.abs(self.normals(points, faces)), axis=0)
        columns = np.arange(local.shape[1])
        return np.stack([local[(axis + 1) % 3, columns], local[(axis + 2) % 3, columns] + 10.0 * axis])

    def corners(self) -> FloatArray | None:
        """See `Surface.corners`."""
        return self.centre + CORNER_SIGNS * self.radii
