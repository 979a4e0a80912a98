"""The whole main job: what a run works on, its stages in their order, and the report.

Stages talk through files in the workspace: disparity maps of pairs, photometric maps with their standard
deviations, geometric maps, the cloud. What an earlier run finished with the same input is used as it is.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from colmap_sph.errors import NoResultError, OptionError
from colmap_sph.pipeline.checks.contradictions import check_numbers
from colmap_sph.pipeline.checks.pose_check import check_poses
from colmap_sph.pipeline.checks.self_check import (
    judge_agreement,
    judge_reprojection,
    judge_rows,
    refuse_disagreement,
    share_in_sight,
)
from colmap_sph.pipeline.context import Context, Until
from colmap_sph.pipeline.execute import Executor, execute, executor_of
from colmap_sph.pipeline.forecast.foresight import foreseen_stages
from colmap_sph.pipeline.forecast.sizes import with_affordable_size
from colmap_sph.pipeline.forecast.time_limit import TimeLimit, time_limit
from colmap_sph.pipeline.forecast.within import Within, widest
from colmap_sph.pipeline.input.good_images import telling_changed
from colmap_sph.pipeline.input.prepared import prepare
from colmap_sph.pipeline.input.start import Request, start
from colmap_sph.pipeline.keys import program_digests
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.pipeline.report_files import command_of, keep_or_make_page, write_report
from colmap_sph.pipeline.stages.confirm import ConfirmStage
from colmap_sph.pipeline.stages.fuse import fuse_stage
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.stage import Result, keys_of
from colmap_sph.pipeline.stages.vote import VoteStage, report_photometric
from colmap_sph.pipeline.stages.wide.range_maps import RangeStage
from colmap_sph.pipeline.workers import room_for_workers
from colmap_sph.project.claim import check_folder, check_links, claimed
from colmap_sph.project.project import Project, open_workspace
from colmap_sph.project.state.obstacles import check_no_folders
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.partners.pairing import Pair

Item = TypeVar("Item", str, Pair)


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
    verify: bool = False,
    within: str | float | None = None,
) -> RunReport:
    """From a sparse model, or a dense workspace, to depth maps, normal maps and a fused cloud.

    What an earlier run in the same workspace has finished with the same input and options is not done again.

    Parameters
    ----------
    model, images, masks, output, workspace : Path, optional
        What to work on, see `Project`.
    options : RunOptions, optional
    progress : Progress, optional
    overwrite : bool
        Do everything again. A workspace that this program undistorted is removed first; one given as `workspace`
        keeps its images and model. Files that this program did not make, where it will write, get another name.
    verify : bool
        Look at every byte of earlier results first, and make again what is damaged.
    within : str or float, optional
        The time to end within, such as "20min", or seconds: sampling, partners and refinement, as far as the
        options have them at their defaults, are chosen accordingly, see `Within`.

    Returns
    -------
    RunReport

    Raises
    ------
    ColmapSphError
        Bad input or options, unwritable output, or nothing to reconstruct.

    Examples
    --------
    >>> options = RunOptions(memory="6GiB")
    >>> report = run("sparse/0", options=options)  # doctest: +SKIP
    >>> print(report.points, report.coverage)  # doctest: +SKIP
    """
    paths = (None if path is None else Path(path) for path in (model, images, masks, output, workspace))
    options = options or RunOptions()
    limit = None if within is None else time_limit(within, options)
    return run_project(
        Project(*paths), options, progress=progress, overwrite=overwrite, verify=verify, limit=limit
    )


def run_project(
    project: Project,
    options: RunOptions,
    *,
    progress: Progress | None = None,
    overwrite: bool = False,
    verify: bool = False,
    limit: TimeLimit | None = None,
    started: float | None = None,
) -> RunReport:
    """Do what `run` does, for what is in one record.

    Parameters
    ----------
    project : Project
    options : RunOptions
    progress, overwrite, verify
        See `run`.
    limit : TimeLimit, optional
        The time to end within.
    started : float, optional
        When the run began, as `time.monotonic` tells; default: now.
    """
    report = RunReport(started=started or time.monotonic())
    check_input(project, options, limit)
    if limit is not None:
        options = with_affordable_size(project, options, limit, overwrite=overwrite)
    if options.scheduler:
        project = project.absolute()  # workers have other current folders
    program_digests()  # kept from here on: an update meanwhile has no part in this run
    progress = Silent() if progress is None else progress
    report.command = command_of(project, options)
    dense = open_workspace(project) if project.model is None else Workspace(project.root)
    with claimed(dense), executor_of(options, dense) as executor:
        request = Request(progress=progress, report=report, overwrite=overwrite, verify=verify)
        options, request = prepare(project, options, dense, executor, request)
        return reconstruct(dense, options, request, executor=executor, limit=limit)


def check_input(project: Project, options: RunOptions, limit: TimeLimit | None = None) -> None:
    """Raise `ColmapSphError` for what is wrong before anything is touched."""
    options.check()
    if limit is not None:
        limit.check(options)
        if options.scheduler:
            raise OptionError("--within knows this machine alone; leave out it or --scheduler.")
    project.check()
    check_folder(project.root)
    check_links(Workspace(project.root), is_given=project.workspace is not None)
    check_no_folders(Workspace(project.root))
    if project.model is None and options.undistortion.max_image_size != UndistortionOptions().max_image_size:
        raise OptionError("--workspace holds undistorted images; leave out --max-image-size.")
    if project.model is None and options.polish.is_wanted:
        raise OptionError(
            "--polish-poses replaces the model in the workspace, and the one in --workspace is yours; give the "
            "sparse model that it was undistorted from as --model, or leave out --polish-poses."
        )


def reconstruct(
    workspace: Workspace,
    options: RunOptions,
    request: Request,
    *,
    executor: Executor = execute,
    until: Until = "cloud",
    limit: TimeLimit | None = None,
) -> RunReport:
    """Match, vote, confirm and fuse everything in a dense workspace; see `run`.

    Parameters
    ----------
    workspace : Workspace
    options : RunOptions
    request : Request
    executor : callable
        Makes the results of a stage, see `Executor`.
    until : {"photometric", "geometric", "cloud"}
        The last results to make: maps of a kind, or the cloud.
    limit : TimeLimit, optional
        The time to end within.

    Returns
    -------
    RunReport
        That of the request.
    """
    report = request.report
    report.until = until
    options = options if limit is None else widest(options, limit)
    with room_for_workers():
        context, selection = start(workspace, options, executor, request)
        misplaced = judge_reprojection(report, context.scene)
        with telling_changed(context):
            if limit is None:
                request.progress.foresee(foreseen_stages(context, selection.unique_pairs(), until=until))
                go_through_stages(context, selection.unique_pairs(), executor, until=until)
            else:
                context = go_through_stages_within(
                    Within(limit, context, selection, goes_on=not request.overwrite), executor
                )
        judge_agreement(report, misplaced=misplaced, in_sight=share_in_sight(context.scene))
    write_report(context)
    keep_or_make_page(context)
    refuse_disagreement(report)
    if until == "cloud" and not report.points:
        raise NoResultError(f"No point survived fusion. {report.advice}")
    return report


def go_through_stages(
    context: Context,
    pairs: Sequence[Pair],
    executor: Executor,
    *,
    until: Until = "cloud",
    is_plan: bool = False,
) -> None:
    """Go through the stages in their order: each begins where all results of the one before are known.

    Parameters
    ----------
    context : Context
    pairs : sequence of (str, str)
        Names of the images of each pair.
    executor : callable
        What is done with each stage, see `Executor`.
    until : {"photometric", "geometric", "cloud"}
        The last results to make.
    is_plan : bool
        Whether the executor makes nothing, so that there is nothing to judge.
    """
    check_numbers(context, pairs)
    matched = by_name(executor(MatchStage(context, context.order.sorted_pairs(pairs))))
    if not is_plan:
        _judge_pairs(context, matched)
    votes = by_name(executor(VoteStage(context, matched)))
    if until == "photometric":
        report_photometric(context, votes)
        return
    maps = by_name(executor(ConfirmStage(context, matched, votes)))
    _join_views(context, maps, executor)
    if until == "cloud":
        executor(fuse_stage(context, keys_of(matched), maps))


def go_through_stages_within(within: Within, executor: Executor) -> Context:
    """Go through all stages in the time that there is; return the context with the options that were chosen."""
    context, matched, votes = within.match_and_vote(executor)
    _judge_pairs(context, matched)
    context = within.refined(context, matched, votes)
    maps = by_name(executor(ConfirmStage(context, matched, by_name(votes))))
    _join_views(context, maps, executor)
    executor(fuse_stage(context, keys_of(matched), maps))
    return context


def _join_views(context: Context, maps: Mapping[str, Result], executor: Executor) -> None:
    """Make the range maps of wide images, where there are any."""
    stage = RangeStage(context, maps)
    if stage.items:
        executor(stage)


def _judge_pairs(context: Context, matched: Mapping[Pair, Result]) -> None:
    measured = {pair: result.facts.row_residual for pair, result in matched.items()}
    judge_rows(context.report, context.scene, measured)
    check_poses(context, matched)


def by_name(results: Mapping[Item, Result]) -> dict[Item, Result]:
    """Results in the order of their items' names, whatever the order in which they were worked on."""
    return {item: results[item] for item in sorted(results)}
