"""A dense workspace with its images → the scene to reconstruct and the pairs to match: how every run begins."""

import logging
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from colmap_sph.errors import InputError
from colmap_sph.pipeline.context import Context, timed_stage
from colmap_sph.pipeline.forecast.foresight import foreseen_stages
from colmap_sph.pipeline.input.good_images import check_fusion_masks, with_good_images, without_misplaced
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.polishing import MatchToPolishStage, with_polished_poses
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.pipeline.stages.polish import GivenModel
from colmap_sph.pipeline.stages.selection import choose_pairs, wanted_scene
from colmap_sph.project.files import make_dir
from colmap_sph.project.polishing.polished import starting_model
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.state.obstacles import check_no_folders
from colmap_sph.project.state.ownership import damaged_files, named, results_of, take_places
from colmap_sph.project.workspace import MapKind, Workspace
from colmap_sph.scene import Scene
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.partners.pairs import PairSelection

if TYPE_CHECKING:
    from colmap_sph.pipeline.execute import Executor

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Request:
    """How a run is asked for, beside its workspace and its options.

    Attributes
    ----------
    progress : Progress
    report : RunReport
        What is known of the run so far.
    database : Path or None
        COLMAP's database, whose verified matches serve where the model has no or few tracks.
    expected : collection of str
        Names of images that are reported as skipped where the workspace's model does not have them.
    given : GivenModel or None
        The model that the workspace's was undistorted from: its poses may be polished where the options say so.
    overwrite : bool
        Files that this program did not make, where maps and cloud go, get another name; without it they are
        refused.
    verify : bool
        Look at every byte of earlier results first, and make again what is damaged.
    pair_list : Path or None
        Which pairs to match, in the format of ``patch-match.cfg`` and instead of the workspace's own.
    needs_all : bool
        Whether an image that is missing or damaged ends the run (`InputError`) before anything is made.
    """

    progress: Progress = field(default_factory=Silent)
    report: RunReport = field(default_factory=RunReport)
    database: Path | None = None
    expected: Collection[str] = ()
    given: GivenModel | None = None
    overwrite: bool = False
    verify: bool = False
    pair_list: Path | None = None
    needs_all: bool = False


def start(
    workspace: Workspace, options: RunOptions, executor: "Executor", request: Request
) -> tuple[Context, PairSelection]:
    """Check the images, choose the pairs, and polish the poses where that is asked for.

    Parameters
    ----------
    workspace, options, executor
        See `reconstruct`.
    request : Request

    Returns
    -------
    context : Context
        Of the images that are to be matched.
    selection : PairSelection
    """
    report = request.report
    make_dir(workspace.state_dir)
    is_polishing = request.given is not None and options.polish.is_wanted
    scene = read_scene(starting_model(workspace) if is_polishing else workspace.sparse_dir)
    # Images that this program undistorted are no larger.
    scene = anchored(scene.no_larger_than(options.undistortion.max_image_size))
    report.views = _views_of_photographs(scene)
    context = Context(workspace, scene, options, Keys(workspace, options), request.progress, report)
    check_fusion_masks(context)
    check_no_folders(workspace, context.written_files())
    context = context.in_region()
    _report_missing(context, request.expected)
    context = with_good_images(context, executor, verify=request.verify)
    if request.needs_all and report.skipped_images:
        reason = min(report.skipped_images.items())[1]
        raise InputError(f"{reason}; mend it, or allow images to be left out (allow_missing_files).")
    context = _without_misplaced(context)
    workspace.create_stereo_dirs(context.scene.index_of)
    selection = _selection(context, request.database, request.pair_list)
    context = replace(context, scene=wanted_scene(context.scene, selection))
    take_places(context.places, overwrite=request.overwrite)
    if request.verify:
        _verify(context)
    if request.given is not None and is_polishing:
        pairs = selection.unique_pairs()
        request.progress.foresee(foreseen_stages(context, pairs, (MatchToPolishStage(context, pairs),)))
        context = with_polished_poses(context, pairs, executor, request.given)
    return context, selection


def _without_misplaced(context: Context) -> Context:
    """See `without_misplaced`; maps of these images, of runs before, are removed: more would be made of them."""
    sound = without_misplaced(context)
    for name in sorted(context.scene.index_of.keys() - sound.scene.index_of.keys()):
        for kind in get_args(MapKind):
            context.map_files(name, kind).remove()
    return sound


def _views_of_photographs(scene: Scene) -> dict[str, list[str]]:
    """Names of the views that were cut from each photograph, of those that were cut."""
    return {
        photograph.name: [view.name for view in photograph.views]
        for photograph in scene.photographs
        if photograph.lead.original
    }


def _report_missing(context: Context, expected: Collection[str]) -> None:
    """Report images that the workspace's model does not have, though it was made of them."""
    skipped = context.report.skipped_images
    for name in sorted({*expected} - context.scene.index_of.keys() - skipped.keys()):
        skipped[name] = "the model has no possible pose or calibration of it"
        context.progress.leave_out("image", name, skipped[name])


def _selection(context: Context, database: Path | None, pair_list: Path | None) -> PairSelection:
    with timed_stage("select pairs", 1, context.progress, context.report):
        key = context.keys.stage("selection", context.scene_key)
        selection = choose_pairs(
            context.workspace, context.scene, context.options, database, pair_list, scene_key=key, keep=True
        )
        context.report.pair_source = selection.source
        context.progress.advance()
    return selection


def _verify(context: Context) -> None:
    """Look at every byte of earlier results; what is damaged is not there for the stages that follow."""
    results = list(results_of(context.workspace))
    damaged = []
    with timed_stage("verify", len(results), context.progress, context.report):
        for result in results:
            damaged += damaged_files(result)
            context.progress.advance()
    if damaged:
        logger.warning("Damaged, and made again: %s", named(damaged))
    else:
        logger.info("No earlier result is damaged")
