"""Scene and region → the part of the scene that shows the region, and what of each image does.

The sparse points in the region and near it tell which images see it, and where it has surfaces. With these alone
pairs are chosen, and parallaxes are searched.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.scene import Polygons, Region, Scene, View
from colmap_sph.stereo.partners.frusta import sees
from colmap_sph.stereo.region.window import outline_on, turned

# The scene reaches from the one to the other percentile of its points, and beyond by this share of it: beyond are
# outliers.
_PERCENTILES = (0.5, 99.5)
_BEYOND = 0.5
# Points near the region are at most so far from it, in units of its size; farther, where so many are not nearer.
_NEAR = 0.1
_ENOUGH_POINTS = 256
# Roofs and trees, which often carry no points, may rise above these by so much of their range, and by so much of
# the region's size.
_ABOVE = 0.5
_ABOVE_FLAT = 0.02
# Cells of the map of distances from polygons, along its longer side.
_CELLS = 1024


@dataclass(frozen=True, eq=False)
class Focus:
    """A region in the frame of a scene.

    Attributes
    ----------
    region : Region
        What results are cut to.
    box : (2, 3) float64 ndarray
        Where its surfaces are, with some room around, along the region's axes: what images need to show.
    """

    region: Region
    box: NDArray[np.float64]

    @property
    def near(self) -> Region:
        """What of the region may hold a surface, finite: a pixel shows the region where it shows this."""
        return replace(self.region, box=self.box)

    def outline(self, view: View) -> NDArray[np.float64]:
        """Of what of a view of the reduced scene may show the region, see `outline_on`."""
        outline = outline_on(turned(view, self.region), self.box)
        assert outline is not None
        return outline


def region_of(focus: Focus | None) -> Region | None:
    """What results are cut to; None: nothing."""
    return None if focus is None else focus.region


def focused(scene: Scene, region: Region, least_points: int, called: str) -> tuple[Scene, Focus, dict[str, int]]:
    """Reduce a scene to what shows a region.

    Parameters
    ----------
    scene : Scene
    region : Region
        In the model's frame.
    least_points : int
        Images that observe fewer points in the region and near it are left out.
    called : str
        The region's name in messages.

    Returns
    -------
    scene : Scene
        With the points in the region and near it, and the images that see them.
    focus : Focus
    too_few : dict of str to int
        Names of the images that see some of these points, but too few, and how many.

    Raises
    ------
    InputError
        The scene is not there, or without any point.
    """
    origin = scene.origin + scene.anchor
    region = region.moved(-origin)
    is_finite = np.isfinite(scene.points).all(axis=1)
    if not is_finite.any():
        raise InputError(
            f"{called} needs sparse points, by which the images of a region are found, and the model has none; "
            "triangulate some (colmap point_triangulator), or leave out --region."
        )
    points = region.along(scene.points)
    low, high = np.percentile(points[is_finite], _PERCENTILES, axis=0)
    beyond = _BEYOND * (high - low)
    inside_scene = np.stack([np.maximum(region.box[0], low - beyond), np.minimum(region.box[1], high + beyond)])
    near = np.zeros(len(points), bool)
    size = 0.0
    if (inside_scene[0] <= inside_scene[1]).all():
        size = float(np.linalg.norm(inside_scene[1] - inside_scene[0]))
        near = _near(region, points, size)
    if not near.any():
        reach = np.percentile(scene.points[is_finite], _PERCENTILES, axis=0) + origin
        corners = (f"{x:.6g} {y:.6g} {z:.6g}" for x, y, z in reach)
        raise InputError(
            f"{called} misses the scene, whose sparse points reach from {' to '.join(corners)}; give a region in "
            "the model's coordinates that holds some of them."
        )
    low, high = np.percentile(points[near], _PERCENTILES, axis=0)
    above = _ABOVE * (high - low) + _ABOVE_FLAT * size
    box = np.stack([np.maximum(inside_scene[0], low - above), np.minimum(inside_scene[1], high + above)])
    focus = Focus(region, box)
    part, too_few = _with_points(scene, near, focus, least_points)
    return part, focus, too_few


def _near(region: Region, points: NDArray[np.float64], size: float) -> NDArray[np.bool_]:
    """Which points, along its axes, lie in a region of some size or near it."""
    distances = _distances(region, points, size)
    enough = size
    if len(points) > _ENOUGH_POINTS:
        enough = float(np.partition(distances, _ENOUGH_POINTS)[_ENOUGH_POINTS])
    return np.asarray(distances <= max(_NEAR * size, min(enough, size)))


def _distances(region: Region, points: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """(n,) distances of points along a region's axes from it; infinite for no point, and beyond `most`."""
    with np.errstate(invalid="ignore"):
        beside = np.maximum(np.maximum(region.box[0] - points, points - region.box[1]), 0)
    distances: NDArray[np.float64] = np.linalg.norm(beside, axis=1)
    distances[~(distances <= most)] = np.inf
    if region.polygons:
        rows = np.flatnonzero(np.isfinite(distances))
        from_polygons = _distances_from(region.polygons, points[rows, :2], most)
        distances[rows] = np.maximum(distances[rows], from_polygons)
    return distances


def _distances_from(polygons: Polygons, places: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """(n,) distances of places from polygons, to the size of a cell of a map, and rather too small."""
    corners = np.concatenate([ring for rings in polygons for ring in rings])
    low = corners.min(axis=0) - most
    extent = corners.max(axis=0) + most - low
    cell = float(extent.max()) / _CELLS
    width, height = np.ceil(extent / cell).astype(int) + 1
    outside = np.ones((height, width), np.uint8)
    for rings in polygons:
        one = np.zeros_like(outside)
        cells = [np.floor((ring - low) / cell).astype(np.int32) for ring in rings]
        cv2.fillPoly(one, cells, 1)
        cv2.polylines(one, cells, isClosed=True, color=1)
        outside[one > 0] = 0
    distances = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * cell
    columns, rows = np.clip((places - low) // cell, 0, [width - 1, height - 1]).astype(int).T
    return np.asarray(distances[rows, columns], dtype=np.float64)


def _with_points(
    scene: Scene, kept: NDArray[np.bool_], focus: Focus, least_points: int
) -> tuple[Scene, dict[str, int]]:
    """The scene with some of its points and the views that show enough of them; and which views show fewer."""
    points = scene.points[kept]
    new_rows = np.cumsum(kept) - 1
    views = []
    too_few = {}
    for view in scene.views:
        observed = view.point_indices[kept[view.point_indices]]
        number = len(observed) if scene.has_tracks else np.count_nonzero(sees(view, points))
        if not number or outline_on(turned(view, focus.region), focus.box) is None:
            continue
        if number >= least_points:
            views.append(replace(view, point_indices=new_rows[observed]))
        else:
            too_few[view.name] = int(number)
    return replace(scene, views=tuple(views), points=points), too_few
