"""Measure a surface model and an orthophoto against exact depth maps, and against LiDAR.

    python scripts/measure_surface.py SURFACE MODEL DEPTH [--depth-scale 0.005] [--demo]
                                      [--lidar CLOUD [--cloud CLOUD]]

SURFACE is what `colmap_sph surface` has made in the model's own frame, MODEL its sparse model, DEPTH a folder with
exact depth at pixel centres. The truth of a cell is the highest exact point in its middle half each way, from all
images together: it has nothing from our own maps. With --demo, for the block of `colmap_sph demo`, colours are
also compared with a picture that the demo's renderer takes of the same village from straight above. --cloud
measures a fused cloud against the LiDAR as the surface is: by height, its highest point in a cell against the
LiDAR's points there, and in space, from each point, or cell, to the nearest of the LiDAR's.
"""

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_sph.evaluation import read_geometry
from colmap_sph.evaluation.depth_files import read_exact_depth
from colmap_sph.evaluation.geometry_io import PointCloud
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.scene import View
from colmap_sph.synthetic import BlockOptions, Camera, demo_cameras, look_at
from colmap_sph.synthetic.block import ground_corners
from colmap_sph.synthetic.light import Light, ShadowMap
from colmap_sph.synthetic.render import exact_picture
from colmap_sph.synthetic.village import build_village

# From where the demo's village is looked at, metres: rays are parallel to the millimetre.
_STRAIGHT_ABOVE = 1e6
_RELIEF = 22.0

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Cells:
    """A raster's size, and the map from places to its cells."""

    shape: tuple[int, int]
    left: float
    top: float
    cell: float

    def of(self, points: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Flat indices of (n, 3) points' cells, which points lie in one, and which in the middle half of one."""
        places = np.stack([points[:, 0] - self.left, self.top - points[:, 1]], axis=1) / self.cell
        numbers = np.floor(places).astype(np.int64)
        inside = np.asarray(((numbers >= 0) & (numbers < self.shape[::-1])).all(axis=1))
        middle = np.asarray(inside & (np.abs(places - numbers - 0.5) < 0.25).all(axis=1))
        return np.where(inside, numbers[:, 1] * self.shape[1] + numbers[:, 0], 0), inside, middle

    def points(self, heights: Array) -> Array:
        """(n, 3) centres of all cells, at these heights."""
        rows, columns = np.indices(self.shape)
        x = self.left + (columns + 0.5) * self.cell
        y = self.top - (rows + 0.5) * self.cell
        return np.stack([x.ravel(), y.ravel(), heights.ravel()], axis=1)


def exact_points(view: View, depth: Array) -> Array:
    """World points of a map's pixel centres."""
    rows, columns = np.nonzero(depth > 0)
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1) @ np.linalg.inv(view.K).T
    return np.asarray((rays * depth[rows, columns][:, None]) @ view.R + view.center)


def sees(view: View, depth: Array, points: Array, tolerance: float) -> NDArray[np.bool_]:
    """Whether a view's exact depth map has points on the surface that it sees."""
    pixels, z = view.project(points)
    places = np.floor(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64)
    inside = (z > 0) & ((places >= 0) & (places < [view.width, view.height])).all(axis=1)
    seen = np.zeros(len(points), bool)
    seen[inside] = np.abs(depth[places[inside, 1], places[inside, 0]] - z[inside]) < tolerance
    return seen


def report_heights(name: str, off: Array, cell: float) -> None:
    """Print how far heights are off."""
    median = float(np.median(off))
    nmad = 1.4826 * float(np.median(np.abs(off - median)))
    share = float((np.abs(off) <= 2 * cell).mean())
    mean = float(np.abs(off).mean())
    print(f"{name}: {len(off):,} cells, median {median:+.4f}, NMAD {nmad:.4f}, within 2 cells {share:.4f}, "
          f"mean absolute {mean:.4f}")  # fmt: skip


def seen_from_above(cells: Cells) -> Array:
    """(h, w, 3) exact colours of the demo's village at each cell."""
    options = BlockOptions()
    surfaces = build_village(options.nadir_gsd, options.buildings, options.trees, options.seed).surfaces
    sun = Light().sun
    corners = ground_corners(demo_cameras(options), _RELIEF)
    light = Light(sun, shadows=ShadowMap.cast(surfaces, sun, corners, options.nadir_gsd))
    height, width = cells.shape
    x, y = cells.left + width * cells.cell / 2, cells.top - height * cells.cell / 2
    R, t = look_at((x, y, _STRAIGHT_ABOVE), (x, y, 0), up=(0, 1, 0))
    focal = _STRAIGHT_ABOVE / cells.cell
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(K, R, t, width, height)
    rays = math.ceil(2 * cells.cell / options.nadir_gsd)
    return exact_picture(surfaces, camera, supersample=rays, light=light).astype(np.float64)


def report_colours(cells: Cells, colours: Array, has_colour: NDArray[np.bool_]) -> None:
    """Print how far an orthophoto's (h, w, 3) colours are off those of the demo's village."""
    exact = seen_from_above(cells)
    off = np.abs(colours - exact).mean(axis=2)[has_colour]
    # What one cell's shift does to the exact picture itself, for comparison.
    shifted = np.abs(exact[:, 1:] - exact[:, :-1]).mean(axis=2)[has_colour[:, 1:]]
    print(f"colours: off by {np.median(off):.1f} of 255 (median), within 20 {(off <= 20).mean():.4f}; "
          f"a shift by one cell {np.median(shifted):.1f}, {(shifted <= 20).mean():.4f}")  # fmt: skip


def points_of(path: Path) -> Array:
    """(n, 3) points of a cloud, or corners of a mesh."""
    found = read_geometry(path)
    return np.asarray(found.points if isinstance(found, PointCloud) else found.vertices, np.float64)


def highest(cells: Cells, points: Array) -> Array:
    """(h, w) height of the highest point in each cell, NaN for none."""
    index, inside, _ = cells.of(points)
    top = np.full(math.prod(cells.shape), -np.inf)
    np.maximum.at(top, index[inside], points[inside, 2])
    return np.where(np.isfinite(top), top, np.nan).reshape(cells.shape)


def report_against_lidar(name: str, cells: Cells, height: Array, points: Array, lidar: Array) -> None:
    """Print how far heights of cells, and points in the LiDAR's extent, are off the LiDAR's points."""
    index, _, middle = cells.of(lidar)
    middle &= np.isfinite(height.ravel()[index])
    report_heights(name, height.ravel()[index[middle]] - lidar[middle, 2], cells.cell)
    inside = (points[:, :2] >= lidar[:, :2].min(axis=0)) & (points[:, :2] <= lidar[:, :2].max(axis=0))
    points = points[inside.all(axis=1) & np.isfinite(points[:, 2])]
    distance, _ = cKDTree(lidar).query(points)
    print(
        f"{name}, in space: {len(points):,}, mean distance {distance.mean():.4f}, median {np.median(distance):.4f}"
    )


def main() -> None:
    """Read, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("surface", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("depth", type=Path)
    parser.add_argument("--depth-scale", type=float)
    parser.add_argument("--lidar", type=Path)
    parser.add_argument("--cloud", type=Path)
    parser.add_argument("--demo", action="store_true")
    given = parser.parse_args()
    with rasterio.open(given.surface / "dsm.tif") as file:
        height, _, _ = file.read().astype(np.float64)
        cells = Cells(height.shape, file.transform.c, file.transform.f, file.transform.a)
    with rasterio.open(given.surface / "orthophoto_images.tif") as file:
        source = file.read(1)
    names = json.loads((given.surface / "surface.json").read_text())["images"]
    views = read_scene(given.model).views
    endings = (".png", ".npy", ".tif")
    truths = {
        view.name: read_exact_depth(
            next(path for ending in endings if (path := given.depth / (Path(view.name).stem + ending)).exists()),
            shape=(view.height, view.width),
            depth_scale=given.depth_scale,
        ).astype(np.float64)
        for view in views
    }
    truth = np.full(height.size, -np.inf)
    for view in views:
        points = exact_points(view, truths[view.name])
        index, _, middle = cells.of(points)
        np.maximum.at(truth, index[middle], points[middle, 2])
    known = np.isfinite(truth)
    tops = cells.points(truth)
    seeing = np.zeros(height.size, np.int64)
    right = np.zeros(height.size, bool)
    for view in views:
        seen = np.zeros(height.size, bool)
        seen[known] = sees(view, truths[view.name], tops[known], 2 * cells.cell)
        seeing += seen
        right |= seen & (source.ravel() == names.index(view.name) + 1)
    measured = (height.ravel() > -9999) & known
    by_three = measured & (seeing >= 3)
    report_heights("seen by three", height.ravel()[by_three] - truth[by_three], cells.cell)
    report_heights("all", height.ravel()[measured] - truth[measured], cells.cell)
    coloured = known & (source.ravel() > 0)
    print(
        f"orthophoto: {coloured.sum():,} cells, from an image that sees their surface {right[coloured].mean():.4f}"
    )
    print(f"of cells seen by three images {by_three.sum() / (known & (seeing >= 3)).sum():.4f} have a height")
    if given.demo:
        with rasterio.open(given.surface / "orthophoto.tif") as file:
            *colours, alpha = file.read()
        report_colours(cells, np.dstack(colours).astype(np.float64), alpha > 0)
    if given.lidar is not None:
        lidar = points_of(given.lidar)
        height[height <= -9999] = np.nan
        report_against_lidar("LiDAR", cells, height, cells.points(height), lidar)
        if given.cloud is not None:
            cloud = points_of(given.cloud)
            report_against_lidar("cloud against LiDAR", cells, highest(cells, cloud), cloud, lidar)


if __name__ == "__main__":
    main()
