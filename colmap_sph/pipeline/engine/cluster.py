"""The workers of a Dask scheduler as an executor: what `execute` is for the threads of one machine."""

import logging
import queue
import secrets
import time
from collections import Counter
from collections.abc import Hashable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import distributed
from distributed.scheduler import KilledWorker

from colmap_sph.errors import InputError, LostWorkersError, counted, reason_of
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.engine import entry
from colmap_sph.pipeline.engine.connection import connected, dashboard_of
from colmap_sph.pipeline.engine.division import Asked, Division
from colmap_sph.pipeline.engine.group import Answer, Group, Piece, RunSeen, folders_of
from colmap_sph.pipeline.engine.lag import PATIENCE
from colmap_sph.pipeline.engine.worker import WorkerFacts, sees_token, unseen
from colmap_sph.pipeline.execute import execute, tell_counts
from colmap_sph.pipeline.keys import program_digests
from colmap_sph.pipeline.memory import MemoryGate
from colmap_sph.pipeline.program import versions
from colmap_sph.pipeline.stages.stage import Kept, Result, Stage
from colmap_sph.platforms.files import look_again
from colmap_sph.project.claim import remove_leftovers
from colmap_sph.project.files import atomic_file, remove
from colmap_sph.project.workspace import Workspace

logger = logging.getLogger(__name__)

Item = TypeVar("Item", bound=Hashable)
Task = TypeVar("Task")

# Groups that wait while others are made: for so many threads one, and no fewer than these.
_WAITING_SHARE = 4
_LEAST_WAITING = 2
# Seconds after which to look whether workers have come or gone.
_LOOK_SECONDS = 2.0


@contextmanager
def on_cluster(scheduler: str, workspace: Workspace) -> Iterator["Cluster"]:
    """An executor that has the workers of a scheduler work for one run, in a workspace that it holds.

    Parameters
    ----------
    scheduler : str
        Its address, or the file in which it stands.
    workspace : Workspace
        On a disk that all workers share.

    Raises
    ------
    ColmapSphError
        The scheduler does not answer, or a worker cannot work for the run.
    """
    path = Workspace(workspace.root.absolute()).token_path
    run = RunSeen(secrets.token_hex(16), path, program_digests(), versions())
    with connected(scheduler) as client:
        cluster = Cluster(client, run)
        try:
            yield cluster
            cluster.dismiss()
            if cluster.has_lost_workers():
                remove_leftovers(workspace)
        finally:
            # Without it workers begin nothing more. It may be another run's by now.
            with suppress(OSError):
                if sees_token(run, 0.0):
                    remove(path)


class Cluster:
    """Has a scheduler's workers make the results of stages.

    Parameters
    ----------
    client : distributed.Client
    run : RunSeen
    """

    def __init__(self, client: distributed.Client, run: RunSeen) -> None:
        self._client = client
        self._run = run
        self._number = 0
        self._threads: dict[str, int] = {}
        self._looked = 0.0
        self._is_one_lost = False
        self._is_announced = False

    def __call__(self, stage: Stage[Item, Task], /) -> dict[Item, Result]:
        """Make all results of a stage that are not there; see `execute`."""
        if stage.whole:
            return execute(stage)
        context = stage.context
        with stage.opened(), context.stage(stage.name, len(stage.items)):
            self._number += 1
            least = self._least_worker(context)
            gate = MemoryGate(least.budget, least.threads, in_use=least.in_use)
            kept = stage.kept_memory(gate)
            with stage.holding(kept):
                results = _Shift(self, stage, kept).made()
            stage.close(results)
        tell_counts(stage, results)
        return results

    # ---- the workers ---------------------------------------------------------------------------------------

    @property
    def threads(self) -> int:
        """Of all workers; they are looked at now and then."""
        if time.monotonic() - self._looked > _LOOK_SECONDS:
            self._look()
        return sum(self._threads.values())

    def _look(self) -> None:
        before = self._threads
        with suppress(OSError):  # a scheduler that is gone is told of elsewhere
            self._threads = dict(self._client.nthreads())
        self._is_one_lost |= not before.keys() <= self._threads.keys()
        if before and not self._threads:
            logger.warning("No worker is left; waiting for one to come back")
        self._looked = time.monotonic()

    def has_lost_workers(self) -> bool:
        """Whether a worker that was there is not any more."""
        self._look()
        return self._is_one_lost

    @property
    def neighbours(self) -> dict[str, int]:
        """How many workers there are on each machine."""
        return dict(Counter(map(entry.host_of, self._threads)))

    def _least_worker(self, context: Context) -> WorkerFacts:
        """Wait for workers, and check that each can work for the run; the least of all their limits."""
        if self._number == 1:
            with atomic_file(self._run.path, sync=False) as file:
                file.write(self._run.token.encode())
        deadline = time.monotonic() + PATIENCE
        while True:
            self._wait_for_workers()
            facts = self._facts()
            refusals = [each.refusal for each in facts.values() if each.refusal]
            if refusals:
                raise InputError(refusals[0])
            blind = [address for address, each in facts.items() if not each.sees_files]
            if facts and not blind:
                break
            if blind and time.monotonic() > deadline:
                others = f" and {counted(len(blind) - 1, 'other')} do" if len(blind) > 1 else " does"
                raise InputError(unseen(f"The worker at {blind[0]}{others}", self._run.path.parent))
            time.sleep(0.2)
        self._announce(context)
        return WorkerFacts(
            min(each.budget - each.in_use for each in facts.values()),
            0,
            max(each.threads for each in facts.values()),
            "",
            sees_files=True,
        )

    def _wait_for_workers(self) -> None:
        self._look()
        if not self._threads:
            logger.warning("The scheduler has no worker yet; waiting for one to join it")
        while not self._threads:
            time.sleep(0.2)
            self._check_connection()
            self._look()

    def _announce(self, context: Context) -> None:
        """Tell who works, and where they can be watched."""
        workers, threads = len(self._threads), sum(self._threads.values())
        words = f"{counted(workers, 'worker')} with {counted(threads, 'thread')}"
        link = dashboard_of(self._client)
        words += f"; their dashboard: {link}" if link else ""
        context.progress.engage(threads, "" if self._is_announced else words)
        if not self._is_announced:
            logger.info("Cluster: %s", words)
        self._is_announced = True

    def _facts(self) -> dict[str, WorkerFacts]:
        """What each worker says of itself; those that are gone meanwhile say nothing."""
        answers = self._client.run(entry.describe, self._run, self.neighbours, on_error="return")
        facts = {}
        for address, answer in answers.items():
            if isinstance(answer, WorkerFacts):
                facts[address] = answer
            elif not isinstance(answer, OSError):
                raise InputError(
                    f"The worker at {address} cannot run this program ({reason_of(answer)}); start it from the "
                    "same installation."
                )
        return facts

    def _check_connection(self) -> None:
        if self._client.status not in ("running", "connecting"):
            raise scheduler_lost()

    # ---- what they work at ---------------------------------------------------------------------------------

    def submit(
        self, stage: Stage[Any, Task], kept: Kept, pieces: list[Piece[Task]], done: queue.Queue[distributed.Future]
    ) -> distributed.Future:
        """Have a group made; the future goes into the queue when it is."""
        group = Group(self._run, type(stage), self._number, kept, self.neighbours, pieces)
        key = f"{stage.name.replace(' ', '_')}-{secrets.token_hex(16)}"
        future = self._client.submit(entry.work, group, key=key, pure=False)
        future.add_done_callback(done.put)
        return future

    def next_done(self, done: queue.Queue[distributed.Future]) -> distributed.Future:
        """Wait for the next group to be made; meanwhile look after the workers."""
        while True:
            try:
                return done.get(timeout=_LOOK_SECONDS)
            except queue.Empty:
                self._check_connection()
                self._look()

    def cancel(self, futures: list[distributed.Future]) -> None:
        """Have what is not begun never begin."""
        with suppress(Exception):  # for another reason the run ends already
            self._client.cancel(futures, force=True)

    def dismiss(self) -> None:
        """Have the workers let go of what they keep in memory."""
        with suppress(Exception):  # they do so by themselves when there is other work
            if self._client.status == "running":
                self._client.run(entry.rest, self._run, on_error="ignore")


def scheduler_lost() -> LostWorkersError:
    """What to say where the scheduler does not answer any more."""
    return LostWorkersError(
        "The connection to the scheduler is lost; start it and its workers again, and run the same command to go "
        "on."
    )


class _Shift:
    """One stage, as it is made by a cluster."""

    def __init__(self, cluster: Cluster, stage: Stage[Any, Any], kept: Kept) -> None:
        self._cluster = cluster
        self._stage = stage
        self._kept = kept
        self._results: dict[Any, Result] = {}
        self._running: dict[object, _Running] = {}
        self._suspects: list[Asked[Any, Any]] = []
        self._culprit: LostWorkersError | None = None
        self._done: queue.Queue[distributed.Future] = queue.Queue()
        self._folders: set[Path] = set()

    def made(self) -> dict[Any, Result]:
        """All results, in the items' order."""
        groups = Division(self._stage, self._tell).groups(lambda: self._cluster.threads)
        try:
            is_more = True
            while is_more or self._running or self._suspects:
                while is_more and len(self._running) < self._window():
                    asked = next(groups, None)
                    is_more = asked is not None
                    if asked is not None:
                        self._submit(asked)
                if not self._running and self._suspects:
                    self._submit([self._suspects.pop()], is_alone=True)
                if self._running:
                    self._take(self._cluster.next_done(self._done))
            if self._culprit is not None:
                raise self._culprit
        finally:
            groups.close()
            self._cluster.cancel([each.future for each in self._running.values()])
        look_again(self._folders)
        return {item: self._results[item] for item in self._stage.items if item in self._results}

    def _window(self) -> int:
        """How many groups may be with the workers."""
        threads = self._cluster.threads
        return threads + max(threads // _WAITING_SHARE, _LEAST_WAITING)

    def _submit(self, asked: list[Asked[Any, Any]], *, is_alone: bool = False) -> None:
        pieces = []
        for each in asked:
            assert each.job is not None
            pieces.append(Piece(each.job.task, self._stage.label(each.item), each.job.cost.memory))
            self._folders |= folders_of(each.job.task)
        future = self._cluster.submit(self._stage, self._kept, pieces, self._done)
        self._running[future.key] = _Running(future, asked, is_alone)

    def _take(self, future: distributed.Future) -> None:
        """Take what became of a group."""
        running = self._running.pop(future.key)
        try:
            answer: Answer = future.result()
        except KilledWorker as error:
            self._find_culprit(running, error)
            return
        except (distributed.client.FutureCancelledError, OSError) as error:
            raise scheduler_lost() from error
        for level, words in answer.words:
            logger.log(level, "%s", words)
        report = self._stage.context.report
        report.peak_memory = max(report.peak_memory, answer.peak_memory)
        for asked, outcome in zip(running.asked, answer.outcomes, strict=True):
            assert asked.job is not None
            if outcome.facts is None:
                self._stage.skip(asked.item, outcome.failure)
                self._stage.context.progress.advance()
                continue
            seconds = asked.job.cost.seconds
            self._results[asked.item] = Result(asked.job.key, True, outcome.facts, seconds, outcome.taken)
            self._stage.context.progress.advance(seconds)

    def _find_culprit(self, running: "_Running", error: KilledWorker) -> None:
        """Find the item that workers die of: what else was with a worker when it died is suspected, too."""
        if running.is_alone:
            culprit = LostWorkersError(
                f"{error.allowed_failures + 1} workers were lost while they made "
                f"{self._stage.label(running.asked[0].item)}, perhaps for lack of memory; give each more of it "
                "(--memory-limit of Dask, or fewer workers on a machine), and run the same command to go on."
            )
            if not self._suspects or self._culprit is not None:
                raise culprit
            self._culprit = culprit  # one may be an exception: all others are made before the run ends
            return
        logger.warning("Workers were lost again and again at the same %d items: tried again", len(running.asked))
        if len(running.asked) == 1:
            self._suspects += running.asked
        else:
            for each in running.asked:
                self._submit([each])

    def _tell(self, asked: Asked[Any, Any]) -> None:
        """Take what need not be made, or cannot be."""
        if asked.failure:
            self._stage.skip(asked.item, asked.failure)
        elif asked.job is not None and asked.job.done is not None:
            self._results[asked.item] = Result(asked.job.key, made=False, facts=asked.job.done)
        self._stage.context.progress.advance()


@dataclass(frozen=True, eq=False)
class _Running:
    """A group that is with the workers; alone, where nothing else is."""

    future: distributed.Future
    asked: list[Asked[Any, Any]]
    is_alone: bool
