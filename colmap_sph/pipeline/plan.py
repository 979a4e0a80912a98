"""What a run would do and need, found without writing anything: ``colmap_sph run --dry-run``.

The same stages are asked that a run executes. Which pairs and images are to do is exact, but for pairs that fail
while they are matched, and, of more than a thousand of which nothing is there, for those that cannot be done: some
of these are asked, and stand for all. Time, memory and disk are sums of what the jobs say that they cost; the
constants stand in the stages, and ``scripts/calibrate_plan.py`` compares them with runs.
"""

import logging
from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from heapq import nlargest
from typing import TypeVar

from colmap_sph.errors import ColmapSphError
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.forecast.time_limit import TimeLimit
from colmap_sph.pipeline.forecast.within import Within, widest
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.memory import MemoryGate
from colmap_sph.pipeline.options import RunOptions, num_cores
from colmap_sph.pipeline.polishing import with_polished_poses
from colmap_sph.pipeline.preparation import Preparation
from colmap_sph.pipeline.reconstruct import (
    check_input,
    go_through_stages,
    with_good_images,
)
from colmap_sph.pipeline.report import RunReport
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.selection import choose_pairs, wanted_scene
from colmap_sph.pipeline.stages.stage import Cost, Kept, Result, Stage
from colmap_sph.project.files import free_space
from colmap_sph.project.polishing.polished import starting_model
from colmap_sph.project.project import Project, open_workspace
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.state.ownership import foreign_files, named
from colmap_sph.stereo.anchor import anchored

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


@dataclass(frozen=True)
class Plan:
    """What a run would do, and what it would need.

    Attributes
    ----------
    undistort : bool
        Whether the undistorted images are to be made.
    pair_source : str
        Where the pairs come from.
    pairs, pairs_done : int
        Pairs of images, and those whose disparity map is there.
    images, images_done : int
        Images, and those whose geometric maps are there.
    fuse : bool
        Whether the cloud is to be made.
    seconds : float
        Estimated wall time.
    memory, disk : float
        Estimated largest memory in use, and space for files to be made, in bytes.
    free_disk : int
        Free space where these go, bytes.
    region : str
        See `RunReport`.
    stages : tuple of StagePlan
        Of each stage, in their order; with a sparse model the undistortion before them.
    choice : str
        Where a time is asked for: what would be chosen for it, if the machine is as fast as estimated.
    """

    undistort: bool
    pair_source: str
    pairs: int
    pairs_done: int
    images: int
    images_done: int
    fuse: bool
    seconds: float
    memory: float
    disk: float
    free_disk: int
    region: str
    stages: tuple[StagePlan, ...]
    choice: str = ""


def make_plan(
    project: Project, options: RunOptions, *, overwrite: bool = False, limit: TimeLimit | None = None
) -> Plan:
    """Find what `reconstruct.run_project` would do; raises what it would raise before its first stage.

    Parameters
    ----------
    project : Project
    options : RunOptions
    overwrite : bool
        Everything would be done again.
    limit : TimeLimit, optional
        The time to end within.

    Returns
    -------
    Plan
    """
    check_input(project, options, limit)
    options = options if limit is None else widest(options, limit)
    survey = Survey()
    report = RunReport()
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
    context = Context(dense, scene, options, keys, report=report).in_region()
    options = context.options
    context = with_good_images(context, survey, to_come=to_come)
    there = dense if foreseen is None else None
    key = context.keys.stage("selection", context.scene_key)
    selection = choose_pairs(there, context.scene, options, project.database(), scene_key=key)
    context = replace(context, scene=wanted_scene(context.scene, selection))
    foreign = foreign_files(context.places, overwrite=overwrite)
    if foreign:
        logger.warning("Would get another name, as this program did not make it: %s", named(foreign))
    if given is not None and options.polish.is_wanted:
        context = with_polished_poses(context, selection.unique_pairs(), survey, given)
    pairs_to_match = selection.unique_pairs()
    choice = ""
    if limit is not None:
        before = sum(stage.seconds for stage in survey.stages) / _workers(options)
        within = Within(limit.begun(before), context, selection, goes_on=not overwrite)
        context, pairs_to_match, chosen = within.planned()
        choice = chosen.words
    go_through_stages(context, pairs_to_match, survey)
    stages = survey.stages
    pairs, _, maps, cloud = stages[-4:]
    return Plan(
        undistort=bool(to_make),
        pair_source=selection.source,
        pairs=pairs.total,
        pairs_done=pairs.done,
        images=maps.total,
        images_done=maps.done,
        fuse=cloud.done < cloud.total,
        seconds=sum(stage.seconds for stage in stages) / _workers(options),
        memory=max(stage.memory for stage in stages),
        disk=sum(stage.disk for stage in stages),
        free_disk=free_space(project.root),
        region=report.drawn_region,
        stages=tuple(stages),
        choice=choice,
    )


def _workers(options: RunOptions) -> int:
    return min(options.num_threads, num_cores())


@dataclass
class Survey:
    """An executor that asks every stage for what is to do, and does nothing.

    Attributes
    ----------
    stages : list of StagePlan
        What the stages said, in their order.
    """

    stages: list[StagePlan] = field(default_factory=list)

    def __call__(self, stage: Stage[Item, Task], /) -> dict[Item, Result]:
        """Foresee the result of each item; all images that are to do are taken to get some depth.

        Of items whose results are not there, an even part is asked, where they are very many; the others are
        taken to be like these.
        """
        missing = [item for item in stage.items if stage.is_missing(item)]
        asked = set(missing[:: -(-len(missing) // _ASKED) or 1])
        results: dict[Item, Result] = {item: _TO_MAKE for item in missing if item not in asked}
        scale = len(missing) / max(len(asked), 1)
        costs: list[tuple[Cost, float]] = []
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
                costs.append((job.cost, scale if item in asked else 1.0))
        results = {item: results[item] for item in stage.items if item in results}
        stage.tell_problems()
        made, there = stage.count(results)
        self.stages.append(
            StagePlan(
                stage.name,
                made + there,
                there,
                sum(cost.seconds * times for cost, times in costs),
                _memory_of(stage, [cost for cost, _ in costs]),
                sum(cost.disk * times for cost, times in costs),
            )
        )
        return results


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
