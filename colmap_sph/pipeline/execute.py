"""A stage's jobs, executed: what is there is left alone, the rest is made by worker threads within the memory."""

import logging
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any, Protocol, TypeVar

from colmap_sph.errors import OptionError
from colmap_sph.pipeline.memory import MemoryGate
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.stage import Job, Result, Stage
from colmap_sph.pipeline.workers import for_all
from colmap_sph.platforms.memory import give_back_freed_memory
from colmap_sph.project.state.background import vouching_in_background
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.search.idle import busy, lending

logger = logging.getLogger(__name__)

Item = TypeVar("Item", bound=Hashable)
Task = TypeVar("Task")


class Executor(Protocol):
    """What is done with each stage: all of its jobs, or a plan of them."""

    def __call__(self, stage: Stage[Any, Any], /) -> dict[Any, Result]:
        """Return the result of each item; those that fail are left out."""


@contextmanager
def executor_of(options: RunOptions, workspace: Workspace) -> Iterator[Executor]:
    """What makes the results of a run in a workspace that it holds: threads of this machine, or a cluster."""
    if not options.scheduler:
        yield execute
        return
    if find_spec("distributed") is None:
        raise OptionError(
            "--scheduler needs Dask, which is not installed; install this program with it: pip install '.[dask]'."
        )
    # Not before: who needs no cluster need not have Dask.
    from colmap_sph.pipeline.engine.cluster import on_cluster

    with on_cluster(options.scheduler, workspace) as cluster:
        yield cluster


def execute(stage: Stage[Item, Task]) -> dict[Item, Result]:
    """Make all results of a stage that are not there.

    Returns
    -------
    dict
        Result of each item, in the items' order, without those that failed or were not wanted any more.

    Raises
    ------
    ColmapSphError
        A wrong option, an output that cannot be written, or nothing to go on with.
    """
    context = stage.context
    with stage.opened(), context.stage(stage.name, stage.steps):
        results = made_by_threads(stage)
        stage.close(results)
    tell_counts(stage, results)
    return results


def made_by_threads(stage: Stage[Item, Task], items: Sequence[Item] | None = None) -> dict[Item, Result]:
    """Make the results of a stage that is open and announced, or of some of its items; see `execute`."""
    options = stage.context.options
    give_back_freed_memory()  # what the stage before kept for its own sizes
    gate = MemoryGate(options.memory_budget, options.num_threads)
    kept = stage.kept_memory(gate)

    def work(item: Item) -> Result | None:
        if not stage.is_wanted(item):
            return None
        job = stage.job(item)
        if job.done is not None:
            return Result(job.key, made=False, facts=job.done)
        if stage.whole:
            return _made(stage, job)
        with gate.reserve(job.cost.memory, stage.label(item)), busy():
            return _made(stage, job)

    keeping = gate.keeping(kept.total(gate.threads))
    with keeping, stage.holding(kept), vouching_in_background(), lending(gate.threads):
        items = stage.items if items is None else items  # not before: what is kept may tell the best order
        return _one_by_one(work, stage, items) if stage.whole else _by_threads(work, stage, items)


def tell_counts(stage: Stage[Item, Task], results: Mapping[Item, Result]) -> None:
    """Report how many results of a stage were made, and how many were there."""
    made, reused = stage.count(results)
    report = stage.context.report
    if made or reused:
        report.made[stage.name] = made
        report.reused[stage.name] = reused
    if reused:
        logger.info("%s: %d were up to date", stage.name.capitalize(), reused)


def _made(stage: Stage[Item, Task], job: Job[Task]) -> Result:
    start = time.perf_counter()
    facts = stage.make(job.task)
    return Result(job.key, True, facts, seconds=job.cost.seconds, taken=time.perf_counter() - start)


def _by_threads(
    work: Callable[[Item], Result | None], stage: Stage[Item, Task], items: Sequence[Item]
) -> dict[Item, Result]:
    context = stage.context

    def advance(result: Result | None) -> None:
        context.progress.advance(0.0 if result is None else result.seconds)

    results = for_all(work, items, threads=context.options.num_threads, advance=advance, skip=stage.skip)
    return {item: result for item, result in results.items() if result is not None}


def _one_by_one(
    work: Callable[[Item], Result | None], stage: Stage[Item, Task], items: Sequence[Item]
) -> dict[Item, Result]:
    """In the calling thread, the only one in which COLMAP's library heeds Ctrl-C."""
    results = {}
    for item in items:
        result = work(item)
        if result is not None:
            results[item] = result
            stage.context.progress.advance(result.seconds)
    return results
