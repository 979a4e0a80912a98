"""What each pair finds of what both of its images see, and how much of it is right, with this program as it is.

    python scripts/measure_pairs.py --scene walk --output /tmp/pairs
    python scripts/measure_pairs.py --scene drive --width 960 --output /tmp/pairs --rectification.sampling 1.4
    python scripts/measure_pairs.py --model sparse/0 --exact-depth depth --depth-scale 0.001 --output /tmp/pairs

Renders the scene into OUTPUT, unless it is there or a model is given, runs the program beside it (what has not
changed is not done again) and prints a table. `study_rectification.py` compares sphere and frame.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from benchmarking import table
from rectification_study import found, pairs, scenes

import colmap_sph
from colmap_sph.app.evaluate_command import exact_depth_views
from colmap_sph.errors import ColmapSphError, OptionError
from colmap_sph.evaluation import DepthView
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.pair_files import read_estimate, read_pair
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, View


@dataclass(frozen=True)
class Measurement:
    """Measure what pairs find on a scene with exact depth."""

    output: Path
    """Folder for rendered scenes and workspaces."""
    scene: scenes.SceneName = "walk"
    """Scene to render."""
    width: int = 480
    """Width of rendered pictures, pixels."""
    model: Path | None = None
    """Sparse model, such as that of an aerial block, instead of a scene."""
    images: Path | None = None
    """Original images. Default: the folder `images` beside or above the model."""
    exact_depth: Path | None = None
    """With a model: folder of exact depth maps at pixel centres, named as the images."""
    depth_scale: float | None = None
    """Metres of one unit of integer depth maps."""
    by: Literal["baseline", "angle"] = "baseline"
    """Whether pairs are summed by baseline or by angle between the viewing directions."""
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = field(default_factory=RunOptions)


def main(asked: Measurement) -> None:
    """Render, run, measure, print."""
    name = "given" if asked.model is not None else f"{asked.scene}-{asked.width}"
    files = files_of(asked, asked.output / name)
    workspace = Workspace(asked.output / f"{name}-{asked.run.rectification.surface}")
    report = colmap_sph.run(files.model, images=files.images, output=workspace.root, options=asked.run)
    scene = read_scene(workspace.sparse_dir)
    exact = exact_depth_views(files.exact_depth, workspace.sparse_dir, files.depth_scale)
    scored = score(scene, workspace, exact, asked.run, list(report.skipped_pairs))
    print(pair_table(scored, asked.by))
    print()
    print(map_table(workspace, exact, scene, float(np.mean(list(report.coverage.values())))))


def files_of(asked: Measurement, folder: Path) -> scenes.StudyScene:
    """Those that are given, or of the scene that is rendered into a folder."""
    if asked.model is None:
        return scenes.find_scene(asked.scene, folder, asked.width, asked.run.num_threads)
    if asked.exact_depth is None:
        raise OptionError("--model needs --exact-depth, what is found is compared with it.")
    return scenes.StudyScene(asked.model, asked.images, asked.exact_depth, asked.depth_scale)


def score(
    scene: Scene, workspace: Workspace, exact: list[DepthView], options: RunOptions, skipped: list[str]
) -> list[dict[str, Any]]:
    """Counts of every pair that was matched or could not be rectified, with its angle and baseline."""
    maps = pairs.ExactMaps(exact)
    files = pairs.pair_files_of(workspace)
    names = sorted({*files, *pairs.skipped_pairs(skipped)})
    return [_score_pair(scene, maps, files, pair, options) for pair in names]


def _score_pair(
    scene: Scene,
    maps: pairs.ExactMaps,
    files: dict[tuple[str, str], Path],
    pair: tuple[str, str],
    options: RunOptions,
) -> dict[str, Any]:
    left, right = (scene.view(name) for name in pair)
    disparity = read_pair(files[pair]) if pair in files else None
    depths = None if disparity is None else pairs.pair_depths(left, right, disparity, options)
    counts = found.count_pair((left, right), depths, (maps.known(left), maps.known(right)))
    cosine = float(np.clip(left.viewing_direction @ right.viewing_direction, -1, 1))
    geometry = None if disparity is None else disparity.geometry
    warped = 0 if geometry is None else geometry.height * (geometry.left_width + geometry.right_width)
    return {
        "rectified": disparity is not None,
        "angle": float(np.degrees(np.arccos(cosine))),
        "baseline": float(np.linalg.norm(left.center - right.center)),
        "counts": counts,
        "warped": warped,
    }


def pair_table(scored: list[dict[str, Any]], by: str) -> str:
    """Sums over classes of pairs, and over all."""
    class_of: Callable[[dict[str, Any]], float] = lambda pair: round(pair["baseline"])  # noqa: E731
    if by == "angle":
        class_of = lambda pair: float(np.digitize(pair["angle"], pairs.ANGLE_EDGES))  # noqa: E731
    classes = sorted({class_of(pair) for pair in scored})
    groups = [(_label(value, by), [pair for pair in scored if class_of(pair) == value]) for value in classes]
    rows = []
    for label, group in [*groups, ("all", scored)]:
        lost = sum(not pair["rectified"] for pair in group)
        warped = sum(pair["warped"] for pair in group) / 1e6
        cells = found.share_cells([pair["counts"] for pair in group])
        rows.append([label, str(len(group)), str(lost), *cells, f"{warped:.1f}"])
    header = [by, "pairs", "not rectified", "found of seen", "of found: < 1 %", "< 1 GSD", "< 1 px", "Mpx"]
    return table(header, rows)


def _label(value: float, by: str) -> str:
    if by == "baseline":
        return f"{value:g}"
    return f"{pairs.ANGLE_EDGES[int(value) - 1]:g} to {pairs.ANGLE_EDGES[int(value)]:g}"


def map_table(workspace: Workspace, exact: list[DepthView], scene: Scene, coverage: float) -> str:
    """Coverage of all pixels, of those of known depth, how many of these are right, and of the sky."""
    maps = pairs.ExactMaps(exact)
    empty = {view.name: view.read_depth() == 0 for view in exact}
    rows = []
    for kind in ("photometric", "geometric"):
        depths = {view.name: _depth_of(workspace, view, kind) for view in scene.views}
        counts = [_count_map(view, depths[view.name], maps.known(view)) for view in scene.views]
        known, covered, percent, gsd = np.sum(counts, axis=0)
        cells = [covered / max(known, 1), percent / max(covered, 1), gsd / max(covered, 1)]
        sky = [(depths[name] > 0)[nothing] for name, nothing in empty.items()]
        cells.append(np.concatenate(sky).mean() if any(map(len, sky)) else 0.0)
        rows.append([kind, f"{coverage:.3f}" if kind == "geometric" else "-", *(f"{cell:.3f}" for cell in cells)])
    header = ["maps", "coverage", "found of truth", "of found: < 1 %", "< 1 GSD", "found where nothing is"]
    return table(header, rows)


def _depth_of(workspace: Workspace, view: View, kind: str) -> found.Map:
    """The depth that a view's pairs voted for, or its geometric map."""
    if kind == "photometric":
        return read_estimate(workspace.photometric_dir / f"{view.name}.sph", view).depth
    return read_depth_map(workspace.depth_map_path(view.name, "geometric"))


def _count_map(view: View, depth: found.Map, truth: found.Map) -> tuple[int, int, int, int]:
    both = (truth > 0) & (depth > 0)
    error = np.abs(depth[both] / truth[both] - 1)
    return int((truth > 0).sum()), len(error), int((error <= 0.01).sum()), int((error * view.K[0, 0] <= 1).sum())


if __name__ == "__main__":
    try:
        main(tyro.cli(Measurement, config=(tyro.conf.FlagConversionOff,)))
    except ColmapSphError as error:
        sys.exit(f"error: {error}")
