"""Sparse points → do the depth maps of the images that observe them agree? A run's check of itself.

The sparse points come from the same poses as the depth maps, but from other measurements. Where images do not
belong to their poses, or are turned, next to no point agrees with the maps; where all fits, nearly all do.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, percent
from colmap_sph.scene import Region, Scene, View
from colmap_sph.stereo.depth import Depths
from colmap_sph.stereo.partners.observers import observers_of_points
from colmap_sph.stereo.region.inside import is_inside

# Sparse points of a view to look at, an even part of them.
_MAX_POINTS = 500
# A map agrees with a point where in no image that observes it the two lie farther apart than this: a few times the
# noise of structure from motion, of a pixel or less. ...
_MAX_DISTANCE = 4.0
# ... A point tells something where it would not agree at this many times its distance.
_TELLING = 1.25
# Maps of so many views tell whether all are of this model; fewer points with a depth say nothing.
_SOME_VIEWS = 8
_FEWEST_FOUND = 30
# Of the points that have a depth at all, nearly all agree with it as a rule, and next to none by chance.
_LEAST_OF_FOUND = 0.1


@dataclass(frozen=True, eq=False)
class SparseSights:
    """Some of the sparse points that a view observes, and the other views that observe them.

    Attributes
    ----------
    pixels : (n, 2) float64 ndarray
        Where the view sees them, in image coordinates.
    depth : (n,) float64 ndarray
        z-depth in the view.
    point : (m,) int64 ndarray
        For every sight from another view the row of the point, ascending.
    at_center, at_point : (m, 3) float64 ndarray
        In homogeneous pixels of that other view: the centre of this view, and the point.
    """

    pixels: NDArray[np.float64]
    depth: NDArray[np.float64]
    point: NDArray[np.int64]
    at_center: NDArray[np.float64]
    at_point: NDArray[np.float64]

    def between(self, depths: Depths | None) -> "SparseSights":
        """The same where only these depths are wanted: no other point is asked."""
        if depths is None:
            return self
        wanted = (self.depth >= depths[0]) & (self.depth <= depths[1])
        return replace(self, depth=np.where(wanted, self.depth, 0.0))


class SparseTracks:
    """Which views observe each sparse point of a scene; may be used by several threads.

    Parameters
    ----------
    scene : Scene
    region : Region, optional
        No point outside of it is asked.
    """

    def __init__(self, scene: Scene, region: Region | None = None) -> None:
        self._scene = scene
        self._is_wanted = np.ones(len(scene.points), bool) if region is None else is_inside(region, scene.points)
        observed = [view.point_indices for view in scene.views]
        self._first, self._views = observers_of_points(observed, len(scene.points))
        self._cameras = np.array([view.K @ view.cam_from_world for view in scene.views])

    def sights(self, name: str) -> SparseSights:
        """Return the sparse points of a view, an even part of them where there are many."""
        index = self._scene.index_of[name]
        view = self._scene.views[index]
        rows = view.point_indices
        rows = rows[:: -(-len(rows) // _MAX_POINTS) or 1]
        points = self._scene.points[rows]
        pixels, depth = view.project(points)
        counts = self._first[rows + 1] - self._first[rows]
        point = np.repeat(np.arange(len(rows)), counts)
        places = np.arange(len(point)) - np.repeat(np.cumsum(counts) - counts, counts)
        others = self._views[self._first[rows][point] + places]
        point, others = point[others != index], others[others != index]
        cameras = self._cameras[others]
        at_center = cameras[:, :, :3] @ view.center + cameras[:, :, 3]
        at_point = np.einsum("mij,mj->mi", cameras[:, :, :3], points[point]) + cameras[:, :, 3]
        depth = np.where(self._is_wanted[rows], depth, 0.0)
        return SparseSights(pixels, depth, point, at_center, at_point)


def compare_with_sparse(
    view: View, depth: NDArray[np.float32], sights: SparseSights, mask: NDArray[np.uint8] | None = None
) -> tuple[int, int, int]:
    """Compare a view's depth map with its sparse points.

    Parameters
    ----------
    view : View
    depth : (H, W) float32 ndarray
        z-depth along the ray ``K⁻¹ (col, row, 1)``; 0 = none.
    sights : SparseSights
    mask : (H, W) uint8 ndarray, optional
        0 where the image is ignored: points there are not asked.

    Returns
    -------
    tested : int
        Sparse points in the view's sight, and seen by others under enough parallax to tell their depth.
    found : int
        Those of them with a depth in the map.
    agreeing : int
        Those of them whose depth agrees.
    """
    inside = (sights.pixels >= 0) & (sights.pixels < [view.width, view.height])
    asked = inside.all(axis=1) & (sights.depth > 0)
    # The map's place (col, row) is the image coordinates (col, row), see `pixel origin` in docs/algorithm.md.
    places = np.where(asked[:, None], np.rint(sights.pixels), 0).astype(np.int64)
    columns, rows = np.minimum(places, [view.width - 1, view.height - 1]).T
    if mask is not None:
        asked &= mask[rows, columns] > 0
    asked &= _distances(sights, np.full(len(asked), _TELLING)) > _MAX_DISTANCE
    nearest = _nearest_depth(depth, rows, columns, sights.depth)
    found = asked & (nearest > 0)
    ratio = np.divide(nearest, sights.depth, out=np.ones(len(asked)), where=found)
    agreeing = found & (_distances(sights, ratio) <= _MAX_DISTANCE)
    return int(asked.sum()), int(found.sum()), int(agreeing.sum())


def check_some_maps(
    scene: Scene,
    names: Sequence[str],
    read: Callable[[str], NDArray[np.float32] | None],
    *,
    maps: str,
    model: str,
) -> None:
    """Make sure that depth maps that were made earlier are of this model, and not of one of another scale, say.

    Parameters
    ----------
    scene : Scene
    names : sequence of str
        Views that have maps, of which some are looked at.
    read : callable
        Name of a view → (H, W) float32 depth map, maybe with fewer pixels than the view; None: there is none.
    maps, model : str
        Where they are, for the message.

    Raises
    ------
    InputError
        Hardly any sparse point agrees with the maps. Where few points have a depth, nothing is said.
    """
    tracks = SparseTracks(scene)
    found = agreeing = 0
    for name in names[:: -(-len(names) // _SOME_VIEWS) or 1]:
        view, depth = scene.view(name), read(name)
        if depth is not None:
            rows = np.arange(view.height) * depth.shape[0] // view.height
            columns = np.arange(view.width) * depth.shape[1] // view.width
            whole = np.where(np.isfinite(depth), depth, np.float32(0))[np.ix_(rows, columns)]
            _, of_view, right = compare_with_sparse(view, whole, tracks.sights(name))
            found += of_view
            agreeing += right
    if found >= _FEWEST_FOUND and agreeing < _LEAST_OF_FOUND * found:
        raise InputError(
            f"The depth maps in {maps} are not of the model in {model}: only {percent(agreeing / found)} of its "
            "sparse points that have a depth there agree with it. Was the model scaled, aligned or replaced after "
            "they were made? Put back the one they were made with, or make them again."
        )


def _distances(sights: SparseSights, ratio: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) pixels: how far points move in the view where they move most, their distance times `ratio`."""
    moved = sights.at_center + ratio[sights.point][:, None] * (sights.at_point - sights.at_center)
    in_front = (moved[:, 2] > 0) & (sights.at_point[:, 2] > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = moved[:, :2] / moved[:, 2:] - sights.at_point[:, :2] / sights.at_point[:, 2:]
    shift = np.where(in_front, np.hypot(*shift.T), np.inf)
    farthest = np.zeros(len(ratio))
    np.maximum.at(farthest, sights.point, shift)
    return farthest


def _nearest_depth(
    depth: NDArray[np.float32],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    expected: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(n,): of the 3 x 3 depths around pixels the one nearest to what is expected; 0 = none."""
    height, width = depth.shape
    best = np.zeros(len(rows))
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            found = depth[np.clip(rows + down, 0, height - 1), np.clip(columns + right, 0, width - 1)]
            is_better = (found > 0) & (~(best > 0) | (np.abs(found - expected) < np.abs(best - expected)))
            best[is_better] = found[is_better]
    return best
