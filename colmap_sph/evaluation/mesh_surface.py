"""Distances to the surface of a triangle mesh, and samples of it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import InputError
from colmap_sph.evaluation.geometry_io import Mesh
from colmap_sph.evaluation.neighbours import PointIndex, Points

_MAX_SAMPLES = 8_000_000
_CANDIDATES = 8
_CHUNK = 1 << 17


class MeshSurface:
    """Random samples of a mesh, evenly by area, and distances to the mesh itself.

    A point's distance is the exact distance to the triangles of its eight nearest samples: never below the true
    distance, and above it only where a nearer triangle has no sample among them (on rolling ground 0.03 % of
    the mean distance at a spacing of a fifth of the triangles' edges).
    """

    def __init__(self, mesh: Mesh, spacing: float) -> None:
        self.corners = mesh.vertices[mesh.faces]
        areas = 0.5 * np.linalg.norm(
            np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0]), axis=1
        )
        total = float(areas.sum())
        if not total > 0:
            raise InputError(f"{mesh.name} has no surface: all its triangles are degenerate")
        count = int(np.clip(total / spacing**2, 1000, _MAX_SAMPLES))
        self.samples, owners = _sample_by_area(self.corners, areas, count)
        # Centroids give triangles that no sample hit a chance to be found.
        centroids = self.corners.mean(axis=1)
        self._owners = np.concatenate([owners, np.arange(len(centroids))])
        self.index = PointIndex(np.concatenate([self.samples, centroids]))

    def distances(self, points: Points, *, threads: int = 1, bound: float = np.inf) -> npt.NDArray[np.float64]:
        """Distance of each point to the mesh.

        Parameters
        ----------
        points : (n, 3) float64 ndarray
        threads : int
        bound : float
            Metres.

        Returns
        -------
        (n,) float64 ndarray
            Metres; infinite beyond `bound`.
        """
        result = np.empty(len(points))
        for start in range(0, len(points), _CHUNK):
            chunk = points[start : start + _CHUNK]
            faces = self._owners[self.index.nearest(chunk, _CANDIDATES, threads=threads)]
            best = np.full(len(chunk), np.inf)
            for candidate in faces.T:
                best = np.minimum(best, distances_to_triangles(chunk, self.corners[candidate]))
            result[start : start + _CHUNK] = best
        result[result > bound] = np.inf
        return result


def distances_to_triangles(points: Points, corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Distance of each of (N, 3) points to its own triangle of (N, 3, 3) corners."""
    a, b, c = np.moveaxis(corners, 1, 0)
    to_edges = np.stack([_to_segments(points, a, b), _to_segments(points, b, c), _to_segments(points, c, a)])
    nearest_edge = to_edges.min(axis=0)
    normal = np.cross(b - a, c - a)
    squared_length = np.einsum("ij,ij->i", normal, normal)
    proper = squared_length > 0
    scale = np.where(proper, squared_length, 1.0)
    inside = proper
    for start, end in ((a, b), (b, c), (c, a)):
        side = np.einsum("ij,ij->i", np.cross(end - start, points - start), normal)
        inside = inside & (side >= 0)
    height = np.abs(np.einsum("ij,ij->i", points - a, normal)) / np.sqrt(scale)
    return np.asarray(np.where(inside, height, nearest_edge))


def _to_segments(points: Points, start: Points, end: Points) -> npt.NDArray[np.float64]:
    direction = end - start
    squared_length = np.einsum("ij,ij->i", direction, direction)
    along = np.einsum("ij,ij->i", points - start, direction)
    along = np.clip(along / np.where(squared_length > 0, squared_length, 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - along[:, None] * direction, axis=1))


def _sample_by_area(
    corners: npt.NDArray[np.float64], areas: npt.NDArray[np.float64], count: int
) -> tuple[Points, npt.NDArray[np.int64]]:
    """Points (count, 3) spread over triangles (F, 3, 3) and the triangle of each; the seed is fixed.

    Regular steps through the running sum of areas, so a triangle gets its share of points to within one; the
    place inside a triangle is random. Osada et al. (2002), Shape distributions, doi:10.1145/571647.571648.
    """
    random = np.random.default_rng(0)
    steps = (np.arange(count) + 0.5) / count * areas.sum()
    owners = np.minimum(np.searchsorted(np.cumsum(areas), steps), len(areas) - 1)
    root = np.sqrt(random.random(count))[:, None]
    other = random.random(count)[:, None]
    a, b, c = (corners[owners, corner] for corner in range(3))
    return (1 - root) * a + root * (1 - other) * b + root * other * c, owners
