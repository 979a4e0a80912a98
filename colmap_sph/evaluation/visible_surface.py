"""The surface that images with exact depth see: a truth that knows what is hidden."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import InputError, NoResultError
from colmap_sph.evaluation.neighbours import Points, thin

_CHUNK = 1 << 18
_THIN_AFTER = 2_000_000
"""The union is thinned anew when it has doubled and grown by so many points."""
_SAME_DEPTH = 0.005
"""Relative depth difference up to which a view is taken to see a point."""


@dataclass(frozen=True)
class DepthView:
    """An image with exact depth: x_cam = R x + t, the first pixel's centre is at (0.5, 0.5) in the image."""

    name: str
    K: npt.NDArray[np.float64]
    R: npt.NDArray[np.float64]
    t: npt.NDArray[np.float64]
    read_depth: Callable[[], npt.NDArray[np.float32]]
    """Gives the (H, W) z-depth at pixel CENTRES, in the unit of t, 0 = none. Called when needed, never kept,
    so that a large block fits in memory."""


def visible_surface(views: Sequence[DepthView], spacing: float) -> Points:
    """Samples (N, 3) of all surface that the views see, at most one per voxel of edge `spacing`.

    Parameters
    ----------
    views : sequence of DepthView
    spacing : float
        In the unit of the views.

    Raises
    ------
    NoResultError
        No view has any depth.
    """
    parts: list[Points] = []
    limit = _THIN_AFTER
    for view in views:
        seen = back_project(view, _depth_of(view))
        if len(seen):
            parts.append(seen[thin(seen, spacing)])
        if sum(map(len, parts)) > limit:
            parts = [_thinned_union(parts, spacing)]
            limit = 2 * len(parts[0]) + _THIN_AFTER
    if not parts:
        raise NoResultError("none of the exact depth maps has a pixel with a depth: there is no truth")
    return _thinned_union(parts, spacing)


def count_views(points: Points, views: Sequence[DepthView]) -> npt.NDArray[np.int32]:
    """How many views see each of (N, 3) points.

    A view sees a point when it projects into the image and the exact depth at one of the four pixel centres
    around it is within 0.5 % of the point's own.
    """
    counts = np.zeros(len(points), np.int32)
    for view in views:
        depth = _depth_of(view)
        for start in range(0, len(points), _CHUNK):
            rows, z, around = _look_up(view, depth, points[start : start + _CHUNK])
            agrees = np.zeros(len(rows), bool)
            for exact in around:
                agrees |= (exact > 0) & (np.abs(exact - z) <= _SAME_DEPTH * z)
            counts[start + rows[agrees]] += 1
    return counts


def observed(points: Points, views: Sequence[DepthView]) -> npt.NDArray[np.bool_]:
    """Which of (N, 3) points can be judged: those that project to a pixel with exact depth in some view.

    What the exact surface hides is judged too: it was reconstructed from images that see something in front.
    """
    result = np.zeros(len(points), bool)
    for view in views:
        left = np.nonzero(~result)[0]
        if not len(left):
            break
        depth = _depth_of(view)
        for start in range(0, len(left), _CHUNK):
            chunk = left[start : start + _CHUNK]
            rows, _, around = _look_up(view, depth, points[chunk])
            has_depth = np.zeros(len(rows), bool)
            for exact in around:
                has_depth |= exact > 0
            result[chunk[rows[has_depth]]] = True
    return result


def back_project(view: DepthView, depth: npt.NDArray[np.float32]) -> Points:
    """World points (N, 3) of the pixels of one exact depth map, sampled at pixel centres."""
    row, column = np.nonzero(depth > 0)
    z = depth[row, column].astype(np.float64)
    x, y = column + 0.5, row + 0.5
    world_rays = view.R.T @ np.linalg.inv(view.K)
    centre = -view.R.T @ view.t
    points = np.empty((len(z), 3))
    for axis in range(3):
        ray = world_rays[axis]
        points[:, axis] = (ray[0] * x + ray[1] * y + ray[2]) * z + centre[axis]
    return points


def _thinned_union(parts: Sequence[Points], spacing: float) -> Points:
    points = np.concatenate(parts)
    return np.asarray(points[thin(points, spacing)])


def _depth_of(view: DepthView) -> npt.NDArray[np.float32]:
    depth = view.read_depth()
    if depth.ndim != 2:
        raise InputError(f"the exact depth of {view.name} has shape {depth.shape}, not (rows, columns)")
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32, copy=False)


def _look_up(
    view: DepthView, depth: npt.NDArray[np.float32], points: Points
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], Iterator[npt.NDArray[np.float32]]]:
    """The rows of `points` that project into the image, their depths, and the exact depth of the four pixels
    whose centres surround each."""
    height, width = depth.shape
    # Column by column: a threaded matrix product of so slim matrices stalls on a busy machine.
    X, Y, Z = points.T
    matrix = view.K @ view.R
    offset = view.K @ view.t
    x, y, z = (row[0] * X + row[1] * Y + row[2] * Z + shift for row, shift in zip(matrix, offset, strict=True))
    safe = np.where(z > 0, z, 1.0)
    x = x / safe
    y = y / safe
    rows = np.nonzero((z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height))[0]
    x = x[rows]
    y = y[rows]

    def around() -> Iterator[npt.NDArray[np.float32]]:
        # A pixel's centre is at +0.5: the centres around (x, y) belong to floor(x ± 0.5), floor(y ± 0.5).
        for dy in (-0.5, 0.5):
            for dx in (-0.5, 0.5):
                column = np.clip(np.floor(x + dx), 0, width - 1).astype(np.int64)
                row = np.clip(np.floor(y + dy), 0, height - 1).astype(np.int64)
                yield depth[row, column]

    return rows, z[rows], around()
