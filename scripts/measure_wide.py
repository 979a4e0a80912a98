"""Measure a workspace of fisheyes or panoramas against exact range, counted per original image.

    python scripts/measure_wide.py SCENE [--width 480] [--images 10] [--panoramas] [-- options of colmap_sph run]

SCENE is a folder: where it does not exist, a courtyard is rendered into it. The program runs on it, and of the
pixels of the original images that show a surface, these shares are printed: covered by their range maps; within
2 % of the exact range; of those that are covered, off by more than 5 %. The next number is the coverage within 2
degrees of the border of any of the views cut from an image over that 12 degrees away from all, which show other
things. Hence another: of pixels that one view shows within 2 degrees inside its border and another more than 8,
how many have a depth in the one, over how many in the other. The last are processor seconds of the command.
"""

import argparse
import itertools
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.wide.range_maps import read_range_map
from colmap_sph.project.workspace import Workspace
from colmap_sph.synthetic.wide.courtyard import CourtyardOptions, make_courtyard

Float = NDArray[np.float64]


def margins(K: Float, width: int, height: int, rays: Float) -> Float:
    """Radians by which unit rays (n, 3) in a pinhole's frame lie inside its borders."""
    low = np.linalg.inv(K) @ [0.0, 0.0, 1.0]
    high = np.linalg.inv(K) @ [width, height, 1.0]
    sides = np.array([[1, 0, -low[0]], [-1, 0, high[0]], [0, 1, -low[1]], [0, -1, high[1]]])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    return np.asarray(np.arcsin(np.clip(rays @ sides.T, -1, 1)).min(axis=1))


def has_depth(path: Path, K: Float, rays: Float) -> NDArray[np.bool_]:
    """Whether a view's depth map has one in the pixels that rays (n, 3) in its frame meet; beside it, none."""
    depth = read_depth_map(path)
    ahead = np.flatnonzero(rays[:, 2] > 0)
    columns, rows = np.floor((rays[ahead] @ K.T)[:, :2] / rays[ahead, 2:]).T
    meets = (columns >= 0) & (rows >= 0) & (columns < depth.shape[1]) & (rows < depth.shape[0])
    has = np.zeros(len(rays), np.bool_)
    has[ahead[meets]] = depth[rows[meets].astype(int), columns[meets].astype(int)] > 0
    return has


def count_at_borders(inside: Float, has: NDArray[np.bool_]) -> Float:
    """Pixels (v, n) at one view's border and well inside another; those with a depth in the one; in the other."""
    counts = np.zeros(3)
    for one, other in itertools.permutations(range(len(inside)), 2):
        both = (inside[one] > 0) & (inside[one] < np.radians(2)) & (inside[other] > np.radians(8))
        counts += [np.count_nonzero(both), np.count_nonzero(has[one, both]), np.count_nonzero(has[other, both])]
    return counts


def measure_image(
    workspace: Path, views: pycolmap.Reconstruction, original: pycolmap.Image, truth: Path
) -> tuple[tuple[Float, Float, Float], Float]:
    """Range, exact range, margin to any view's border, of pixels that show a surface; counts at borders."""
    with np.load(truth) as arrays:
        exact, rays = arrays["range"].astype(np.float64), arrays["rays"].astype(np.float64)
    seen = exact > 0
    exact, rays = exact[seen], rays[seen]
    path = Workspace(workspace).range_map_path(original.name)
    found = read_range_map(path)[0][seen].astype(np.float64) if path.exists() else np.zeros(len(rays))
    world = rays @ original.cam_from_world().rotation.matrix()
    border = np.full(len(rays), 9.0)
    inside, has = [], []
    for image in views.images.values():
        if np.linalg.norm(image.projection_center() - original.projection_center()) > 1e-5:
            continue
        camera = views.camera(image.camera_id)
        local = world @ image.cam_from_world().rotation.matrix().T
        margin = margins(camera.calibration_matrix(), camera.width, camera.height, local)
        border = np.minimum(border, np.where(local[:, 2] > 0, np.abs(margin), 9.0))
        depth = Workspace(workspace).depth_map_path(image.name, "geometric")
        if depth.exists():
            inside.append(np.where(local[:, 2] > 0, margin, -9.0))
            has.append(has_depth(depth, camera.calibration_matrix(), local))
    return (found, exact, border), count_at_borders(np.array(inside), np.array(has))


def measure(scene: Path, workspace: Path) -> str:
    """One row of numbers."""
    originals = pycolmap.Reconstruction(scene / "sparse" / "0")
    views = pycolmap.Reconstruction(workspace / "sparse")
    parts = [
        measure_image(workspace, views, image, scene / "truth" / f"{image.name}.npz")
        for image in originals.images.values()
    ]
    pixels, counts = zip(*parts, strict=True)
    found, exact, border = (np.concatenate(column) for column in zip(*pixels, strict=True))
    _, at_border, inside = np.sum(counts, axis=0)
    covered = found > 0
    error = np.abs(found - exact) / exact
    near, far = border < np.radians(2), border > np.radians(12)
    seam = covered[near].mean() / max(covered[far].mean(), 1e-9) if near.any() and far.any() else np.nan
    bad = (error[covered] > 0.05).mean() if covered.any() else np.nan
    return (
        f"covered {100 * covered.mean():5.1f}  within 2 % {100 * (covered & (error < 0.02)).mean():5.1f}  "
        f"off by > 5 % {100 * bad:5.2f}  seams {seam:.3f}, of the same pixels {at_border / max(inside, 1):.3f}"
    )


def main() -> None:
    """Render what is not there, run, and print."""
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--output", type=Path, help="workspace; default: SCENE/dense")
    parser.add_argument("--width", type=int, default=480, help="pixels of the images")
    parser.add_argument("--images", type=int, default=10, help="how many are taken")
    parser.add_argument("--panoramas", action="store_true")
    parser.add_argument("--measure-only", action="store_true", help="of a workspace that is there")
    given = parser.parse_args(sys.argv[1:split])
    if not (given.scene / "sparse").exists():
        options = CourtyardOptions(width=given.width, images=given.images, panoramas=given.panoramas)
        make_courtyard(given.scene, options)
    output = given.output or given.scene / "dense"
    seconds = ""
    if not given.measure_only:
        command = [sys.executable, "-m", "colmap_sph", "run", "--model", given.scene / "sparse" / "0"]
        command += ["--output", output, *sys.argv[split + 1 :]]
        if subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode not in (0, 5):
            sys.exit("the run failed")
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = f"  cpu {used.ru_utime + used.ru_stime:.1f} s"
    print(f"{given.scene.name}: {measure(given.scene, output)}{seconds}")


if __name__ == "__main__":
    main()
