"""Stages → what there is of their results, and what the rest takes; nothing is made."""

import logging
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from heapq import nlargest
from typing import TypeVar

from colmap_sph.errors import ColmapSphError, OptionError
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.input.good_images import check_fusion_masks, with_good_images, without_misplaced
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.memory import MemoryGate
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.preparation import Preparation
from colmap_sph.pipeline.report import RunReport
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.polish import GivenModel
from colmap_sph.pipeline.stages.selection import choose_pairs, wanted_scene
from colmap_sph.pipeline.stages.stage import Cost, Kept, Result, Stage
from colmap_sph.pipeline.stages.vote import VoteStage
from colmap_sph.project.polishing.polished import starting_model
from colmap_sph.project.project import Project, open_workspace
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.partners.pairs import PairSelection

logger = logging.getLogger(__name__)

Item = TypeVar("Item", bound=Hashable)
Task = TypeVar("Task")

# Of the items of a stage that are to be made, so many or somewhat fewer are asked what that takes.
_ASKED = 1000
_TO_MAKE = Result("", made=True, facts=Facts(coverage=1.0))
# Bytes that the interpreter and the libraries have in use.
_BASE_MEMORY = 200e6


@dataclass(frozen=True)
class StagePlan:
    """What is there of a stage's results, and what the rest takes.

    Attributes
    ----------
    name : str
        As in the report of a run.
    total, done : int
        Results, and those that are there.
    seconds : float
        Estimated processor seconds of what is to do.
    memory, disk : float
        Bytes in use at a time, and of files to be made.
    """

    name: str
    total: int
    done: int
    seconds: float
    memory: float
    disk: float


@dataclass
class Survey:
    """An executor that asks every stage for what is to do, and does nothing.

    Attributes
    ----------
    stages : list of StagePlan
        What the stages said, in their order.
    workers : int
        That would work side by side.
    is_bounded : bool
        Whether a job that never fits into this machine's budget of memory is refused, as in a run.
    """

    stages: list[StagePlan] = field(default_factory=list)
    workers: int = 1
    is_bounded: bool = False

    @property
    def seconds(self) -> float:
        """Estimated wall time of all of them."""
        return sum(stage.seconds for stage in self.stages) / self.workers

    def __call__(self, stage: Stage[Item, Task], /) -> dict[Item, Result]:
        """Foresee the result of each item; all images that are to do are taken to get some depth.

        Of items whose results are not there, an even part is asked, where they are very many; the others are
        taken to be like these.
        """
        self.workers = stage.context.options.num_busy
        missing = [item for item in stage.items if stage.is_missing(item)]
        asked = set(missing[:: -(-len(missing) // _ASKED) or 1])
        results: dict[Item, Result] = {item: _TO_MAKE for item in missing if item not in asked}
        scale = len(missing) / max(len(asked), 1)
        costs: dict[Item, Cost] = {}
        for item in stage.items:
            if item in results:
                continue
            try:
                job = stage.job(item)
            except ColmapSphError as error:
                stage.skip(item, str(error))
                continue
            if job.done is not None:
                results[item] = Result(job.key, made=False, facts=job.done)
            else:
                results[item] = Result(job.key, made=True, facts=_TO_MAKE.facts)
                costs[item] = job.cost
        if self.is_bounded and costs and not stage.whole:
            _refuse_too_little(stage, costs)
        results = {item: results[item] for item in stage.items if item in results}
        stage.tell_problems()
        made, there = stage.count(results)
        like = {item: scale if item in asked else 1.0 for item in costs}
        self.stages.append(
            StagePlan(
                stage.name,
                made + there,
                there,
                sum(cost.seconds * like[item] for item, cost in costs.items()),
                _memory_of(stage, list(costs.values())),
                sum(cost.disk * like[item] for item, cost in costs.items()),
            )
        )
        return results


def _refuse_too_little(stage: Stage[Item, Task], costs: Mapping[Item, Cost]) -> None:
    """Raise `OptionError` where the costliest job would never fit beside what the stage keeps.

    Images that nobody has looked at yet are taken to be sharp. Soft ones are matched in less memory, so it is only
    told what sharp ones would take.
    """
    context = stage.context
    most = max(costs, key=lambda item: costs[item].memory)
    gate = MemoryGate(context.options.memory_budget, context.options.num_threads)
    try:
        with gate.keeping(stage.kept_memory(gate).total(gate.threads)):
            gate.check(costs[most].memory, stage.label(most))
    except OptionError as error:
        is_looked_at = context.details.keys() >= context.scene.index_of.keys()
        if is_looked_at or not isinstance(stage, MatchStage | VoteStage):
            raise
        logger.warning("%s This is for sharp images; soft ones take less, which the run will see.", error)


def _memory_of(stage: Stage[Item, Task], costs: list[Cost]) -> float:
    """Bytes in use while a stage works: as many of the costliest jobs as work side by side, and what it keeps."""
    if not costs:
        return _BASE_MEMORY
    threads = stage.context.options.num_threads
    working = sum(nlargest(threads, (cost.memory for cost in costs)))
    if stage.whole:
        return _BASE_MEMORY + working
    budget = stage.context.options.memory_budget
    kept: Kept = stage.kept_memory(MemoryGate(budget, threads))
    scratch = nlargest(threads, (min(kept.scratch, cost.scratch) for cost in costs))
    held = sum(scratch) + min(kept.caches * kept.cache, kept.filled)
    return min(_BASE_MEMORY + working + held, budget)


@dataclass(frozen=True)
class Foreseen:
    """What a run would work on once its images are undistorted.

    Attributes
    ----------
    context : Context
    selection : PairSelection
    given : GivenModel or None
        See `reconstruct`.
    to_make : frozenset of str
        Images that are to be undistorted.
    """

    context: Context
    selection: PairSelection
    given: GivenModel | None
    to_make: frozenset[str]


def foresee(
    project: Project, options: RunOptions, survey: Survey, report: RunReport, *, overwrite: bool = False
) -> Foreseen:
    """Find what `reconstruct.run_project` would match; raises what it would raise before its first stage.

    Parameters
    ----------
    project : Project
    options : RunOptions
    survey : Survey
        Gets the stages before that.
    report : RunReport
    overwrite : bool
        Everything would be done again.
    """
    foreseen = None
    given = None
    to_make: set[str] = set()
    if project.model is None:
        dense = open_workspace(project)
    else:
        preparation = Preparation(project, options, overwrite=overwrite, is_plan=True, report=report)
        options = preparation.options
        dense = preparation.workspace
        undistorted = preparation.undistort(survey, preparation.check(survey))
        to_make = {name for name, result in undistorted.items() if result.made}
        foreseen = preparation.scene(undistorted)
        given = preparation.given_model()
    folder = dense.sparse_dir if project.model is None else starting_model(dense)
    scene = anchored(read_scene(folder) if foreseen is None else foreseen)
    keys = Keys(dense, options, fresh=overwrite or foreseen is not None)
    to_come = scene.index_of if foreseen is not None else to_make
    context = Context(dense, scene, options, keys, report=report)
    check_fusion_masks(context)
    context = with_good_images(context.in_region(), survey, to_come=to_come)
    context = without_misplaced(context)
    there = None if foreseen is not None else dense
    key = context.keys.stage("selection", context.scene_key)
    selection = choose_pairs(there, context.scene, context.options, project.database(), scene_key=key)
    context = replace(context, scene=wanted_scene(context.scene, selection))
    return Foreseen(context, selection, given, frozenset(to_make))
