"""Rendered pairs as scenes of ours, and where a point belongs in their rectified images."""

import cv2
import numpy as np

from colmap_sph import synthetic as syn
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.rectified_pair import Side

SIDES: tuple[Side, Side] = ("left", "right")


def scene_of(surfaces, cameras, count=600, seed=0, min_track_length=2):
    """Scene with exact sparse points; the views are called a, b, c, … in the cameras' order."""
    rng = np.random.default_rng(seed)
    sparse = syn.sample_sparse_points(
        surfaces, cameras, count, rng, min_track_length=min(min_track_length, len(cameras))
    )
    views = tuple(
        View(k + 1, chr(ord("a") + k), camera.width, camera.height, camera.K, camera.R, camera.t, indices)
        for k, (camera, indices) in enumerate(zip(cameras, sparse.point_indices, strict=True))
    )
    return Scene(views, sparse.points)


def scene_of_pair(pair, count=600):
    """(scene, left view, right view) of a synthetic pair."""
    scene = scene_of(pair.surfaces, (pair.left, pair.right), count)
    return scene, *scene.views


def grey(rendering):
    """(H, W) uint8 picture."""
    return cv2.cvtColor(rendering.image, cv2.COLOR_RGB2GRAY)


def whole(image: np.ndarray) -> RectifiedImage:
    """A rectified image of which every pixel was seen."""
    return RectifiedImage(image.astype(np.float32), np.full(image.shape, 255, np.uint8))


def pixel_rays(view, x, y):
    """World directions (n, 3), of depth 1 in the view, through image coordinates."""
    rays = np.linalg.solve(view.K, np.stack([np.ravel(x), np.ravel(y), np.ones(np.size(x))]))
    return (view.R.T @ rays).T


def project(view, points):
    """Image coordinates (n, 2) and depth (n,) of world points."""
    camera = points @ view.R.T + view.t
    pixel = camera @ view.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return pixel[:, :2] / pixel[:, 2:], camera[:, 2]


def array_coordinates(pair, side, directions):
    """(columns, rows) in a rectified image of world directions (n, 3), by the surface's definition."""
    x, y, z = pair.rectified_from_world @ np.asarray(directions).T
    if pair.surface == "spherical":
        along, across = np.arctan2(x, np.sqrt(y**2 + z**2)), np.arctan2(y, z)
        if pair.flatness:
            along = np.tan(pair.flatness * along) / pair.flatness
    else:
        along, across = x / z, y / z
    origin = pair.left_origin if side == "left" else pair.right_origin
    return along * pair.columns_per_radian - origin, across * pair.rows_per_radian - pair.row_origin


def disparities(pair, left, right, points):
    """Exact disparity of world points, and their columns and rows in the left rectified image."""
    columns, rows = array_coordinates(pair, "left", points - left.center)
    right_columns, _ = array_coordinates(pair, "right", points - right.center)
    return columns - right_columns, columns, rows


def surface_points(view, depth, origin):
    """World points (H, W, 3) of a depth map whose pixels stand for (col + origin, row + origin)."""
    x, y = np.meshgrid(np.arange(view.width) + origin, np.arange(view.height) + origin)
    rays = pixel_rays(view, x, y).reshape(*depth.shape, 3)
    return view.center + depth[..., None] * rays


def source_pixels(view, pair, side):
    """Image coordinates (x, y) (COLMAP's, float64) and depth of all rectified pixels."""
    column, row = np.meshgrid(np.arange(pair.width(side)), np.arange(pair.height))
    along = (column + pair.column_origin(side)) / pair.columns_per_radian
    across = (row + pair.row_origin) / pair.rows_per_radian
    if pair.surface == "spherical":
        along = np.arctan(pair.flatness * along) / pair.flatness if pair.flatness else along
        rays = [np.sin(along), np.cos(along) * np.sin(across), np.cos(along) * np.cos(across)]
    else:
        rays = [along, across, np.ones_like(along)]
    camera_rays = np.stack(rays, axis=-1) @ pair.rectified_from_world @ view.R.T
    pixel = camera_rays @ view.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return pixel[..., 0] / pixel[..., 2], pixel[..., 1] / pixel[..., 2], camera_rays[..., 2]


def exact_disparity(surfaces, left, right, pair, side):
    """Exact disparity map (H, W) float64 of a side's rectified pixels, and whether the other image sees them.

    NaN outside the image. `surfaces` are the synthetic scene's.
    """
    view, other = (left, right) if side == "left" else (right, left)
    x, y, depth = source_pixels(view, pair, side)
    inside = (depth > 0) & (x >= 0) & (x <= view.width) & (y >= 0) & (y <= view.height)
    camera = syn.Camera(view.K, view.R, view.t, view.width, view.height)
    distance = np.full(x.shape, np.inf)
    distance[inside] = syn.trace_points(surfaces, camera, np.column_stack([x[inside], y[inside]])).distance
    met = np.isfinite(distance)
    points = view.center + distance[met][:, None] * pixel_rays(view, x[met], y[met])
    disparity, seen = np.full(x.shape, np.nan), np.zeros(x.shape, dtype=bool)
    disparity[met] = disparities(pair, left, right, points)[0]
    pixel, depth = project(other, points)
    camera = syn.Camera(other.K, other.R, other.t, other.width, other.height)
    nearest = syn.trace_points(surfaces, camera, pixel).distance
    in_view = (depth > 0) & (pixel > 0).all(axis=1) & (pixel < [other.width, other.height]).all(axis=1)
    seen[met] = in_view & (np.abs(nearest - depth) < 1e-6 * depth)
    return disparity, seen
