"""Scene and pairs → what the stages that are to come will take, for the time left of a run.

A dry run asks every item, see `plan`. A run asks a few of each stage, as each item's job is work of milliseconds.
What an earlier run has left ready of the first stage shows among these few. Of later stages it shows when they
come to it, as their keys are not known before.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from colmap_sph.errors import ColmapSphError
from colmap_sph.pipeline.context import Context, Until
from colmap_sph.pipeline.report import StageEstimate
from colmap_sph.pipeline.stages.confirm import ConfirmStage
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.fuse import FuseStage, foreseen_fusion
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.stage import Job, Result, Stage
from colmap_sph.pipeline.stages.vote import VoteStage
from colmap_sph.stereo.partners.pairing import Pair

_ASKED = 8
"""Items of each stage."""
_EXPECTED = Result("", made=True, facts=Facts(coverage=1.0))


def foreseen_stages(
    context: Context,
    pairs: Sequence[Pair],
    before: Iterable[Stage[Any, Any]] = (),
    *,
    until: Until = "cloud",
) -> list[StageEstimate]:
    """Estimate what the stages of `go_through_stages` will take; tells nobody of what cannot be done.

    Parameters
    ----------
    context : Context
    pairs : sequence of (str, str)
        Names of the images of each pair.
    before : iterable of Stage
        Others, before these.
    until : {"photometric", "geometric", "cloud"}
        The last results to make.

    Returns
    -------
    list of StageEstimate
        In their order.
    """
    matched = dict.fromkeys(pairs, _EXPECTED)
    votes = {view.name: _EXPECTED for view in context.scene.views}
    stages: tuple[Stage[Any, Any], ...] = (
        *before,
        MatchStage(context, pairs),
        VoteStage(context, matched),
        ConfirmStage(context, matched, votes),
    )
    if until == "photometric":
        stages = stages[:-1]
    estimates = [estimate(stage) for stage in stages]
    if until == "cloud":
        estimates.append(estimated_fusion(context))
    return estimates


def estimated_fusion(context: Context) -> StageEstimate:
    """Estimate what the last stage will take."""
    parts, each = foreseen_fusion(context)
    return StageEstimate(FuseStage.name, parts, parts * each, each)


def estimate(stage: Stage[Any, Any], asked: int = _ASKED, *, items: Sequence[Any] | None = None) -> StageEstimate:
    """Estimate what a stage, or some items of it, will take from so many of these."""
    items = stage.items if items is None else items
    jobs = list(_some_jobs(stage, asked, items))
    to_make = [job.cost.seconds for job in jobs if job.done is None]
    each = sum(to_make) / max(len(to_make), 1)
    share = len(to_make) / max(len(jobs), 1)
    return StageEstimate(stage.name, len(items), share * each * len(items), each)


def _some_jobs(stage: Stage[Any, Any], asked: int, items: Sequence[Any]) -> Iterator[Job[Any]]:
    number = len(items)
    asked = min(number, asked)
    for index in range(asked):
        try:
            yield stage.job(items[index * number // asked])
        except ColmapSphError:  # the stage itself will tell
            continue
