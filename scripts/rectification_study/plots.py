"""The study's pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray

from colmap_sph.evaluation import DepthView
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.pair_files import read_pair
from colmap_sph.scene import Scene
from colmap_sph.stereo.rectified_pair import Side, Surface
from colmap_sph.stereo.resampling import resample
from rectification_study.pairs import CORRECT, ExactMaps, pair_depths, pair_files
from rectification_study.runs import SURFACES, Run

matplotlib.use("Agg")
from matplotlib import pyplot as plt

COLOURS = {"frame": "tab:orange", "spherical": "tab:blue"}
_DPI = 130


def points_per_image(content: Mapping[str, Any], folder: Path) -> Path:
    """Bars as in the paper's Figure 5: pixels with a geometric depth of every image."""
    points = {surface: content["points"][surface]["pixels_per_image"] for surface in SURFACES}
    names = sorted(points["spherical"])
    figure, axes = plt.subplots(figsize=(max(8.0, 0.3 * len(names)), 4), layout="constrained")
    places = np.arange(len(names))
    for shift, surface in zip((-0.2, 0.2), SURFACES, strict=True):
        heights = [points[surface].get(name, 0) / 1e6 for name in names]
        axes.bar(places + shift, heights, 0.4, color=COLOURS[surface], label=surface)
    axes.set_xticks(places, [Path(name).stem for name in names], rotation=90, fontsize=8)
    axes.set_ylabel("million points")
    axes.set_title("Pixels with a geometric depth")
    axes.legend(loc="lower right")
    return _saved(figure, folder / "points_per_image.png")


def pairs_by_angle(content: Mapping[str, Any], folder: Path) -> Path:
    """Gain of every pair against the angle between its viewing directions."""
    usable = [pair for pair in content["pairs"] if all("matched" in pair[surface] for surface in SURFACES)]
    keys = ["matched", "correct"] if usable and "correct" in usable[0]["spherical"] else ["matched"]
    figure, panels = plt.subplots(1, len(keys) + 1, figsize=(5 * len(keys) + 5, 4), layout="constrained")
    angles = [pair["view_angle_deg"] for pair in usable]
    for axes, key in zip(panels, keys, strict=False):
        gains = [100 * (pair["spherical"][key] / max(pair["frame"][key], 1) - 1) for pair in usable]
        axes.scatter(angles, gains, s=12, alpha=0.6, color=COLOURS["spherical"])
        axes.axhline(0, color="black", linewidth=0.8)
        axes.yaxis.set_major_formatter("{x:+g}")
        axes.set_ylabel("spherical against frame [%]")
        axes.set_title(f"{key} pixels of each pair")
    for surface in SURFACES:
        ratio = [pair[surface]["warped"] / 1e6 for pair in usable]
        panels[-1].scatter(angles, ratio, s=12, alpha=0.6, color=COLOURS[surface], label=surface)
    panels[-1].set_title("million pixels warped")
    panels[-1].legend()
    for axes in panels:
        axes.set_xlabel("angle between viewing directions [deg]")
    return _saved(figure, folder / "pairs_by_angle.png")


def depth_side_by_side(
    scene: Scene,
    runs: Mapping[Surface, Run],
    pair: Mapping[str, Any],
    exact: Sequence[DepthView] | None,
    options: RunOptions,
    folder: Path,
) -> Path:
    """As the paper's Figure 3: a pair's rectified images, depth map and errors on both surfaces, a row each."""
    names = pair["left"], pair["right"]
    left, right = (scene.view(name) for name in names)
    maps = ExactMaps(exact)
    truth = maps.depth(left.name)
    columns = 3 if truth is None else 4
    figure, panels = plt.subplots(2, columns, figsize=(5 * columns, 8), layout="constrained")
    depths = {}
    for surface in SURFACES:
        disparity = read_pair(pair_files(runs[surface])[names])
        depths[surface] = pair_depths(left, right, disparity, options)[0]
        for axes, view in zip(panels[SURFACES.index(surface)], (left, right), strict=False):
            side: Side = "left" if view.name == disparity.left else "right"
            image = cv2.imread(str(runs[surface].workspace.image_path(view.name)), cv2.IMREAD_GRAYSCALE)
            rectified, valid = resample(np.asarray(image, np.uint8), view, disparity.geometry, side)
            axes.imshow(np.where(valid, rectified, 255), cmap="gray", vmin=0, vmax=255)
            axes.set_title(f"{surface}: {view.name}, {rectified.shape[1]} x {rectified.shape[0]}")
    known = np.concatenate([depth[depth > 0] for depth in depths.values()])
    low, high = np.percentile(known, [1, 99]) if len(known) else (0, 1)
    for row, (surface, depth) in zip(panels, depths.items(), strict=True):
        shown = row[2].imshow(_masked(depth), cmap="turbo", vmin=low, vmax=high)
        row[2].set_title(f"{surface}: depth of {left.name}, {(depth > 0).mean():.1%} of its pixels")
        figure.colorbar(shown, ax=row[2], shrink=0.7)
        if truth is not None:
            errors = maps.errors(left, depth)
            shown = row[3].imshow(errors, cmap="inferno", vmin=0, vmax=2 * CORRECT, interpolation="nearest")
            good = np.count_nonzero(errors <= CORRECT) / np.count_nonzero(truth)
            row[3].set_title(f"{surface}: error [GSD]; {good:.1%} of the truth within {CORRECT:g} GSD")
            figure.colorbar(shown, ax=row[3], shrink=0.7)
    for axes in panels.ravel():
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_facecolor("lightgrey")
    figure.suptitle(
        f"{left.name} and {right.name}: {pair['view_angle_deg']:.0f} degrees between the viewing directions"
    )
    stem = "-".join(name.replace("/", "_").rpartition(".")[0] or name for name in names)
    return _saved(figure, folder / f"pair-{stem}.png")


def _masked(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(depth > 0, depth, np.float32(np.nan))


def _saved(figure: Any, path: Path) -> Path:
    figure.savefig(path, dpi=_DPI)
    plt.close(figure)
    return path
