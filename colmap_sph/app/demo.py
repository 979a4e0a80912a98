"""The built-in example: render a block, reconstruct it, compare it with its exact depth."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import OutputError, reason_of
from colmap_sph.evaluation import (
    CloudScores,
    DepthMapScores,
    DepthView,
    EvaluationOptions,
    compare_depth_map,
    evaluate_cloud,
    make_reference,
    read_geometry,
)
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.reconstruct import run
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.workspace import Workspace
from colmap_sph.synthetic import BlockOptions, Camera, DemoBlock, make_demo_block


@dataclass(frozen=True)
class DemoResult:
    """What came out of the demo.

    Attributes
    ----------
    workspace : Workspace
        The dense workspace.
    report : RunReport
    depth_maps : dict
        Image name → scores of its geometric depth map against exact depth.
    cloud : CloudScores
        The fused cloud against all surface that three or more images see.
    """

    workspace: Workspace
    report: RunReport
    depth_maps: dict[str, DepthMapScores]
    cloud: CloudScores


def run_demo(
    output: Path,
    *,
    options: RunOptions | None = None,
    block: BlockOptions | None = None,
    progress: Progress | None = None,
) -> DemoResult:
    """Render the demo block into `output`, reconstruct it in ``output/dense`` and score the result.

    Parameters
    ----------
    output : Path
        Folder for images, model, exact depth and dense workspace; an earlier demo in it is replaced.
    options : RunOptions, optional
    block : BlockOptions, optional
    progress : Progress, optional

    Returns
    -------
    DemoResult

    Raises
    ------
    OutputError
        The folder cannot be written, or holds something else than an earlier demo.
    """
    options = options or RunOptions()
    progress = Silent() if progress is None else progress
    shown = progress
    _make_room(output)

    def rendered(done: int, total: int) -> None:
        if done == 1:
            shown.start("render block", total)
        shown.advance()

    demo = make_demo_block(output, block, threads=options.num_threads, progress=rendered)
    report = run(
        demo.sparse_dir, images=demo.images_dir, output=output / "dense", options=options, progress=progress
    )
    workspace = Workspace(output / "dense")
    progress.start("compare with truth", 2)
    depth_maps = score_depth_maps(demo, workspace)
    progress.advance()
    cloud = _score_cloud(demo, workspace)
    progress.advance()
    return DemoResult(workspace, report, depth_maps, cloud)


def _make_room(output: Path) -> None:
    """Remove an earlier demo's dense workspace; refuse a folder of any other content."""
    if not output.exists():
        return
    try:
        if any(output.iterdir()) and not (output / "truth").is_dir():
            raise OutputError(f"{output} already holds other files; choose another --output for the demo.")
        if (output / "dense").exists():
            shutil.rmtree(output / "dense")
    except OSError as error:
        raise OutputError(
            f"The folder {output} cannot be used ({reason_of(error)}); choose another --output."
        ) from error


def score_depth_maps(demo: DemoBlock, workspace: Workspace) -> dict[str, DepthMapScores]:
    """Compare the geometric maps of a demo block's images with exact depth and normals."""
    scores = {}
    for name, camera in zip(demo.names, demo.cameras, strict=True):
        depth, normals = demo.truth(name)
        scores[name] = compare_depth_map(
            read_depth_map(workspace.depth_map_path(name, "geometric")),
            depth,
            gsd=depth / np.float32(camera.K[0, 0]),
            normals=read_normal_map(workspace.normal_map_path(name, "geometric")),
            truth_normals=normals,
        )
    return scores


def _score_cloud(demo: DemoBlock, workspace: Workspace) -> CloudScores:
    options = EvaluationOptions(gsd=demo.gsd, register=False)
    views = [_truth_view(demo, name, camera) for name, camera in zip(demo.names, demo.cameras, strict=True)]
    return evaluate_cloud(read_geometry(workspace.fused_path), make_reference(views, options), options)


def _truth_view(demo: DemoBlock, name: str, camera: Camera) -> DepthView:
    def read_depth() -> NDArray[np.float32]:
        return demo.truth(name)[0]

    # The demo's truth lies at COLMAP's pixel origin, half a pixel from the centre: a shifted principal point.
    K = camera.K.copy()
    K[:2, 2] += 0.5
    return DepthView(name, K, camera.R, camera.t, read_depth)
