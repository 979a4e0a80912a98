"""A part of a stage, made by one of many jobs that share a workspace and know nothing of each other.

The jobs of a stage find the same items in the same order, and each makes its own; all of the stages before must be
there. So all jobs see the same, and the run that comes last finds everything under its keys.
"""

import logging
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import Any, TypeVar

from colmap_sph.errors import InputError, OptionError
from colmap_sph.pipeline.checks.contradictions import check_numbers
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.engine.lag import PATIENCE
from colmap_sph.pipeline.execute import execute, made_by_threads, tell_counts
from colmap_sph.pipeline.forecast.foresight import estimate
from colmap_sph.pipeline.input.good_images import telling_changed
from colmap_sph.pipeline.input.prepared import find_prepared, prepare
from colmap_sph.pipeline.input.start import Request, start
from colmap_sph.pipeline.keys import program_digests
from colmap_sph.pipeline.known.remembering import RememberingStage
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.reconstruct import by_name, check_input
from colmap_sph.pipeline.report import Progress, Silent
from colmap_sph.pipeline.shards.part import Part, StageName
from colmap_sph.pipeline.stages.check_images import CheckStage
from colmap_sph.pipeline.stages.confirm import ConfirmStage
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.stage import Result, Stage
from colmap_sph.pipeline.stages.vote import VoteStage
from colmap_sph.pipeline.workers import for_all, room_for_workers
from colmap_sph.platforms.files import look_again
from colmap_sph.project.claim import claimed, shared
from colmap_sph.project.project import Project, open_workspace
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.partners.pairing import Pair

logger = logging.getLogger(__name__)

Item = TypeVar("Item", bound=Hashable)

_WHAT = {"prepare": "images", "match": "pairs", "vote": "images", "confirm": "images"}
_FIRST_WAIT = 0.2
_NAMED_SHARDS = 5


@dataclass(frozen=True)
class PartReport:
    """What became of a part.

    Attributes
    ----------
    what : str
        What its items are: "pairs" or "images".
    total, items : int
        Of the stage, and of the part.
    made, reused : int
        Results that were made now, and that were there.
    failed : mapping of str to str
        Items that could not be made, and that may be another time, with the reason.
    pairs : int
        That are to be matched in all.
    """

    what: str
    total: int
    items: int
    made: int
    reused: int
    failed: Mapping[str, str]
    pairs: int


def run_part(
    project: Project,
    options: RunOptions,
    stage: StageName,
    part: Part,
    *,
    progress: Progress | None = None,
    overwrite: bool = False,
    verify: bool = False,
) -> PartReport:
    """Make a part of a stage in a workspace that other jobs may work in at the same time.

    Parameters
    ----------
    project : Project
    options : RunOptions
        The same in all jobs, but for threads and memory.
    stage : StageName
    part : Part
    progress : Progress, optional
    overwrite, verify : bool
        See `run`; for "prepare" alone.

    Returns
    -------
    PartReport

    Raises
    ------
    ColmapSphError
        As of `run`; or a stage before is not complete.
    """
    check_input(project, options)
    program_digests()
    _check_alone(options, stage, is_begun_anew=overwrite or verify)
    request = Request(progress=Silent() if progress is None else progress, overwrite=overwrite, verify=verify)
    workspace = open_workspace(project) if project.model is None else Workspace(project.root)
    if stage == "prepare":
        return _prepare(project, options, workspace, request)
    if not workspace.state_dir.is_dir():
        raise _unprepared(workspace)
    with shared(workspace), room_for_workers():
        prepared = find_prepared(project, options, workspace, request)
        if prepared is None:
            raise _unprepared(workspace)
        options, request = prepared
        context, selection = start(workspace, options, _only_prepared, request)
        return _make(_stage_of(stage, part, context, selection.unique_pairs()), part, _WHAT[stage])


def _check_alone(options: RunOptions, stage: StageName, *, is_begun_anew: bool) -> None:
    if options.scheduler:
        raise OptionError("--stage is for jobs without a scheduler; leave out it or --scheduler.")
    if is_begun_anew and stage != "prepare":
        raise OptionError(
            f"--overwrite and --verify would take from other jobs what they work with; give them with --stage "
            f"prepare, and leave them out with --stage {stage}."
        )


def _unprepared(workspace: Workspace) -> InputError:
    return InputError(
        f"{workspace.root} is not prepared for these options yet; run the same once with --stage prepare, without "
        "--shard, before all other stages."
    )


def _prepare(project: Project, options: RunOptions, workspace: Workspace, request: Request) -> PartReport:
    """Do all that comes before the first pair, in a workspace that this job holds alone."""
    with claimed(workspace), room_for_workers():
        options, request = prepare(project, options, workspace, execute, request)
        context, selection = start(workspace, options, execute, request)
    report = request.report
    number = len(context.scene.views)
    made = sum(report.made.values())
    return PartReport(
        "images", number, number, made, number - made, report.skipped_images, len(selection.unique_pairs())
    )


def _only_prepared(stage: Stage[Any, Any], /) -> dict[Any, Result]:
    """An executor for what comes before the first pair, which a job of another stage finds done."""
    if not isinstance(stage, CheckStage) or stage.is_new:
        raise _unprepared(stage.context.workspace)
    return execute(stage)  # what was found bad, or touched since, is looked at again


def _stage_of(name: StageName, part: Part, context: Context, pairs: Sequence[Pair]) -> RememberingStage[Any, Any]:
    """The stage of this name; `InputError` where one before is not complete."""
    check_numbers(context, pairs)
    match = MatchStage(context, context.order.sorted_pairs(pairs))
    if name == "match":
        return match
    matched = by_name(_all_there(match, "match", name, part))
    vote = VoteStage(context, matched)
    if name == "vote":
        return vote
    return ConfirmStage(context, matched, by_name(_all_there(vote, "vote", name, part)))


def _all_there(stage: Stage[Item, Any], name: StageName, wanted: StageName, part: Part) -> dict[Item, Result]:
    """All results of a stage before the one that is wanted."""
    context = stage.context
    found: dict[Item, Result] = {}
    failed: set[Item] = set()

    def fail(item: Item, reason: str) -> None:
        failed.add(item)
        stage.skip(item, reason)

    missing = list(stage.items)
    deadline = monotonic() + PATIENCE
    wait = _FIRST_WAIT
    with context.stage(stage.name, len(stage.items)):
        look_again(_folders_of(stage))
        while True:
            found |= _asked(stage, missing, fail)
            missing = [item for item in missing if item not in found and item not in failed]
            if not missing or monotonic() > deadline:
                break
            sleep(wait)  # another machine may have made them just now
            wait *= 2
            look_again(_folders_of(stage))
        if missing:
            raise InputError(
                f"--stage {wanted} needs all of --stage {name}, of which {len(missing)} of {len(stage.items)} "
                f"{_WHAT[name]} are missing, such as {stage.label(missing[0])}{_which(part, stage, missing)}; run "
                "that first."
            )
        results = {item: found[item] for item in stage.items if item in found}
        stage.close(results)
    return results


def _which(part: Part, stage: Stage[Any, Any], missing: Sequence[Any]) -> str:
    """Which shards would make what is missing, if there were as many of that stage."""
    if part.parts == 1:
        return ""
    shards = [each for each in part.all if not {*each.of(stage.items)}.isdisjoint(missing)]
    more = " and others" if len(shards) > _NAMED_SHARDS else ""
    return f" (of shards {', '.join(map(str, shards[:_NAMED_SHARDS]))}{more})"


def _asked(
    stage: Stage[Item, Any], items: Sequence[Item], fail: Callable[[Item, str], None]
) -> dict[Item, Result]:
    """Results of those items that are there."""

    def ask(item: Item) -> Result | None:
        job = stage.job(item)
        return None if job.done is None else Result(job.key, made=False, facts=job.done)

    def advance(result: Result | None) -> None:
        if result is not None:
            stage.context.progress.advance()

    threads = stage.context.options.num_threads
    asked = for_all(ask, items, threads=threads, advance=advance, skip=fail)
    return {item: result for item, result in asked.items() if result is not None}


def _folders_of(stage: Stage[Any, Any]) -> set[Path]:
    assert isinstance(stage, RememberingStage)
    return {Path(file).parent for item in stage.items for file in stage.files(item)}


def _make(stage: RememberingStage[Any, Any], part: Part, what: str) -> PartReport:
    """Make a part of a stage."""
    context = stage.context
    report = context.report
    items = part.of(stage.items)
    before = {**report.skipped_images, **report.incomplete}
    context.progress.foresee([estimate(stage, items=items)])
    with telling_changed(context), stage.opened(), context.stage(stage.name, len(items)):
        results = made_by_threads(stage, items)
        stage.remember(results)
    tell_counts(stage, results)
    failed = {**report.skipped_images, **report.incomplete}
    return PartReport(
        what,
        len(stage.items),
        len(items),
        sum(result.made for result in results.values()),
        sum(not result.made for result in results.values()),
        {name: reason for name, reason in failed.items() if name not in before},
        report.pairs,
    )
