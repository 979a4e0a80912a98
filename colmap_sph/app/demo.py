"""The built-in example: render a block, reconstruct it, compare it with its exact depth."""

import json
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
from colmap_sph.project.claim import check_links, check_ways_out
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.sparse_model import MODEL_FILES, RIG_FILES
from colmap_sph.project.undistortion.marker import check_ours
from colmap_sph.project.workspace import Workspace
from colmap_sph.synthetic import BlockOptions, Camera, DemoBlock, demo_cameras, exact_geometry, make_demo_block

_RECORD = "colmap_sph_demo.json"
"""Names the files that a demo makes beside its dense workspace: another may replace them."""


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
        Folder for images, model, exact depth and dense workspace; an earlier demo in it is replaced, and no other
        file.
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
    block = block or BlockOptions()
    block.check()
    _make_room(output, block)

    def rendered(done: int, total: int) -> None:
        if done == 1:
            shown.start("render block", total)
        shown.advance()

    demo = make_demo_block(output, block, threads=options.num_threads, progress=rendered)
    report = run(
        demo.sparse_dir,
        images=demo.images_dir,
        output=output / "dense",
        options=options,
        progress=progress,
        overwrite=True,
    )
    _write_exact_depth(demo)
    workspace = Workspace(output / "dense")
    progress.start("compare with truth", 2)
    depth_maps = _score_demo_maps(demo, workspace)
    progress.advance()
    cloud = _score_cloud(demo, workspace)
    progress.advance()
    return DemoResult(workspace, report, depth_maps, cloud)


def _make_room(output: Path, block: BlockOptions) -> None:
    """Make sure that only an earlier demo's files will be replaced, and record those of this one."""
    names = demo_cameras(block)
    parts = [f"images/{name}" for name in names] + [f"truth/{name}.npz" for name in names]
    parts += [f"depth/{_depth_name(name)}" for name in names]
    parts += [f"sparse/0/{stem}.bin" for stem in (*MODEL_FILES, *RIG_FILES)]
    dense = Workspace(output / "dense")
    check_ways_out(output, (output / name for name in ("images", "sparse", "truth", "depth", _RECORD)))
    check_links(dense, is_given=False)
    try:
        is_empty = not output.exists() or not any(output.iterdir())
    except OSError as error:
        raise OutputError(
            f"The folder {output} cannot be used ({reason_of(error)}); choose another --output."
        ) from error
    made = set() if is_empty else _recorded_files(output / _RECORD)
    foreign = next((part for part in parts if part not in made and (output / part).exists()), None)
    if foreign is not None:
        raise OutputError(f"{output / foreign} was not made by an earlier demo; move it away.")
    check_ours(dense)
    make_dir(output)
    with atomic_file(output / _RECORD) as file:
        file.write(json.dumps({"files": sorted({*parts, *made})}, indent=1).encode())


def _recorded_files(record: Path) -> set[str]:
    """Files that an earlier demo made beside its record; `OutputError` where there is none."""
    try:
        files = json.loads(record.read_bytes())["files"]
        return {str(name) for name in files}
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise OutputError(
            f"{record.parent} already holds other files than those of a demo; choose another --output."
        ) from error


def _depth_name(name: str) -> str:
    return f"{Path(name).stem}.npy"


def _write_exact_depth(demo: DemoBlock) -> None:
    """Write exact depth at the pixels' centres, as `colmap_sph evaluate` takes it."""
    folder = demo.root / "depth"
    make_dir(folder)
    for name, camera in zip(demo.names, demo.cameras, strict=True):
        depth, _, _ = exact_geometry(demo.surfaces, camera, origin=0.5)
        with atomic_file(folder / _depth_name(name)) as file:
            np.save(file, depth.astype(np.float32))


def _score_demo_maps(demo: DemoBlock, workspace: Workspace) -> dict[str, DepthMapScores]:
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
