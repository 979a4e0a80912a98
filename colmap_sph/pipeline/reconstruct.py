"""The whole main job: order of the stages, and the report.

Stages talk through files in the workspace: disparity maps of pairs, photometric maps with their standard
deviations, geometric maps, the cloud. What an earlier run finished with the same input is used as it is.
"""

import itertools
import json
import resource
import sys
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path

from colmap_sph.errors import NoResultError, OptionError
from colmap_sph.pipeline.cloud_stage import fuse_views
from colmap_sph.pipeline.context import Context, timed_stage
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.pipeline.stages import check_views, estimate_views, match_pairs
from colmap_sph.pipeline.workers import one_opencv_thread
from colmap_sph.project.claim import claimed
from colmap_sph.project.database import read_verified_matches
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.pair_lists import read_patch_match_cfg
from colmap_sph.project.project import Project, open_workspace
from colmap_sph.project.scene_reader import leave_out_bad_images, read_scene
from colmap_sph.project.staging import discard_results
from colmap_sph.project.undistortion import (
    UndistortionOptions,
    prepare_workspace,
)
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, SourceImages
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.pairs import PairSelection, select_pairs


def run(
    model: Path | str | None = None,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    output: Path | str | None = None,
    workspace: Path | str | None = None,
    options: RunOptions | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> RunReport:
    """From a sparse model, or a dense workspace, to depth maps, normal maps and a fused cloud.

    What an earlier run in the same workspace has finished with the same input and options is not done again.

    Parameters
    ----------
    model : Path, optional
        COLMAP sparse model; its images are undistorted into `output`.
    images : Path, optional
        Original images; found by COLMAP's usual layouts if not given.
    masks : Path, optional
        Folder of masks ``NAME.png``, black where image NAME is to be ignored: of the original images, or with
        `workspace` of the undistorted ones.
    output : Path, optional
        Dense workspace to create; "dense" beside the model's project if not given.
    workspace : Path, optional
        An existing dense workspace, instead of `model`, `images` and `output`.
    options : RunOptions, optional
    progress : Progress, optional
    overwrite : bool
        Do everything again. A workspace that this program undistorted is removed first; one given as `workspace`
        keeps its images and model.

    Returns
    -------
    RunReport

    Raises
    ------
    ColmapSphError
        Bad input or options, unwritable output, or nothing to reconstruct.
    """
    options, report = options or RunOptions(), RunReport()
    progress = Silent() if progress is None else progress
    project = check_arguments(
        model, images=images, masks=masks, output=output, workspace=workspace, options=options
    )
    if project.model is None:
        dense = open_workspace(project)
        with claimed(dense):
            if overwrite:
                discard_results(dense)
            return reconstruct(dense, options, progress=progress, report=report)
    with claimed(Workspace(project.root)):
        with timed_stage("undistort", 1, progress, report):
            prepared = prepare_workspace(project, options.undistortion, overwrite=overwrite)
            progress.advance()
        return reconstruct(
            prepared.workspace,
            options,
            progress=progress,
            report=report,
            database=project.database(),
            expected=prepared.expected,
        )


def check_arguments(
    model: Path | str | None,
    *,
    images: Path | str | None,
    masks: Path | str | None,
    output: Path | str | None,
    workspace: Path | str | None,
    options: RunOptions,
) -> Project:
    """Return the arguments as a project; raise for what is wrong before anything is touched."""
    options.check()
    given = (model, images, masks, output, workspace)
    project = Project(*(None if path is None else Path(path) for path in given))
    project.check()
    if project.model is None and options.undistortion != UndistortionOptions():
        raise OptionError("--workspace holds undistorted images; leave out --max-image-size.")
    return project


def reconstruct(
    workspace: Workspace,
    options: RunOptions,
    *,
    progress: Progress | None = None,
    report: RunReport | None = None,
    database: Path | None = None,
    expected: Iterable[str] = (),
) -> RunReport:
    """Match, fuse and check everything in a dense workspace; see `run`.

    Images whose names are `expected` and which the workspace does not have are reported as skipped.
    """
    progress, report = Silent() if progress is None else progress, report or RunReport()
    make_dir(workspace.state_dir)
    with one_opencv_thread():
        whole = anchored(read_scene(workspace.sparse_dir))
        scene = leave_out_bad_images(whole, workspace)
        for name in sorted({*expected, *whole.index_of} - scene.index_of.keys()):
            report.skipped_images[name] = "its image is missing, damaged or not of its camera's size; see the log"
        workspace.create_stereo_dirs(scene.index_of)
        with timed_stage("select pairs", 1, progress, report):
            selection = choose_pairs(workspace, scene, options, database)
            report.pair_source = selection.source
            progress.advance()
        scene = wanted_scene(scene, selection)
        context = Context(workspace, scene, options, Keys(workspace, options), progress, report)
        pairs = match_pairs(context, selection.unique_pairs())
        votes = estimate_views(context, pairs)
        maps = check_views(context, pairs, votes)
        fuse_views(context, pairs, maps)
    _write_report(context)
    if not report.points:
        raise NoResultError(f"No point survived fusion. {report.advice}")
    return report


def choose_pairs(workspace: Workspace, scene: Scene, options: RunOptions, database: Path | None) -> PairSelection:
    """Select the pairs of a scene, as the user's ``patch-match.cfg`` says where there is one."""
    path = workspace.patch_match_cfg_path
    written: dict[str, SourceImages] | None = read_patch_match_cfg(path) if path.exists() else None
    return select_pairs(scene, options.pairs, explicit=written, matches=matches_for(scene, database))


def matches_for(scene: Scene, database: Path | None) -> dict[tuple[str, str], int] | None:
    """The verified matches that stand in for a scene's tracks where it has none."""
    return None if database is None or scene.has_tracks else read_verified_matches(database)


def wanted_scene(scene: Scene, selection: PairSelection) -> Scene:
    """Return the scene without the views that are not asked for."""
    wanted = {*selection.partners, *itertools.chain(*selection.unique_pairs())}
    return replace(scene, views=tuple(view for view in scene.views if view.name in wanted))


def _write_report(context: Context) -> None:
    report = context.report
    unit = 1 if sys.platform == "darwin" else 1024
    report.peak_memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    content = {"options": asdict(context.options), **asdict(report)}
    with atomic_file(context.workspace.report_path) as file:
        file.write(json.dumps(content, indent=1, default=str).encode())
