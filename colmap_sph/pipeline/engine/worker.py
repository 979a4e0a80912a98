"""What a worker process does: it makes groups of tasks, with one memory gate and one stage's caches at a time."""

import logging
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2

from colmap_sph.errors import ColmapSphError, InputError, OptionError, OutputError
from colmap_sph.pipeline.engine.group import Answer, Group, Outcome, Piece, RunSeen, folders_of
from colmap_sph.pipeline.engine.lag import PATIENCE, made_with_patience
from colmap_sph.pipeline.keys import program_digests
from colmap_sph.pipeline.memory import MemoryGate
from colmap_sph.pipeline.program import versions
from colmap_sph.pipeline.stages.stage import holding_caches
from colmap_sph.pipeline.workers import refusal_of
from colmap_sph.platforms.files import look_again
from colmap_sph.platforms.memory import give_back_freed_memory, keep_freed_memory, most_resident, resident
from colmap_sph.project.files import read_small, writing_only_if
from colmap_sph.project.state.background import vouching_in_background

# Of a worker's limit: Dask gives it no more work at 80 %, and ends it at 95 %.
_SAFE_SHARE = 0.7
_TOKEN_BYTES = 1000


class RunEndedError(OutputError):
    """The run that this worker works for has ended, or another has begun: its results are not wanted any more."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path} is not this run's any more: another has begun there, or it was removed.")

    def __reduce__(self) -> tuple[type[OutputError], tuple[str]]:
        """Where it arrives, its words are all that counts."""
        return OutputError, (str(self),)


@dataclass(frozen=True)
class WorkerFacts:
    """What a run has to know of a worker.

    Attributes
    ----------
    budget : int
        Bytes that it may use.
    in_use : int
        Bytes that it used before it began to work.
    threads : int
    refusal : str
        Why it cannot work for the run, as a sentence; empty where it can.
    sees_files : bool
        Whether the run's token is there for it.
    """

    budget: int
    in_use: int
    threads: int
    refusal: str
    sees_files: bool


class Workplace:
    """A worker process, for all runs that it ever works for.

    Parameters
    ----------
    budget : int
        Bytes that it may use.
    threads : int
        Groups that it makes side by side.
    """

    def __init__(self, budget: int, threads: int) -> None:
        self.budget = budget
        self.in_use = resident()
        self.gate = MemoryGate(
            budget, threads, in_use=self.in_use, source="70 % of the worker's memory limit, --memory-limit of Dask"
        )
        self._entry = threading.Lock()
        self._changed = threading.Condition()
        self._stage: tuple[str, int] | None = None
        self._held = ExitStack()
        self._users = 0
        self._looked_at: set[Path] = set()
        cv2.setNumThreads(1)  # the workers are the threads
        keep_freed_memory()

    def work(self, group: Group[Any], patience: float = PATIENCE) -> Answer:
        """Make a group; what of it is there already, as a worker that was lost has made it, is left alone.

        Raises
        ------
        ColmapSphError
            This worker cannot work for the run, the run has ended, or an error that no other item would be spared.
        """
        refuse_other_programs(group.run)
        if not sees_token(group.run, patience):
            raise InputError(unseen(_this_worker_does(), group.run.path.parent))
        # In a thread of its own, so that scratch memory and processes of a thread end with the group.
        with self._at_stage(group), ThreadPoolExecutor(1) as pool:
            return pool.submit(self._work, group, patience).result()

    def _work(self, group: Group[Any], patience: float) -> Answer:
        def check() -> None:
            if not sees_token(group.run, patience):
                raise RunEndedError(group.run.path)

        with _words_heard() as words, writing_only_if(check):
            try:
                with vouching_in_background():
                    outcomes = []
                    for piece in group.pieces:
                        check()
                        outcomes.append(self._made(group, piece, patience))
            finally:
                group.stage.end_thread()
        return Answer(outcomes, words, most_resident())

    def _made(self, group: Group[Any], piece: Piece[Any], patience: float) -> Outcome:
        found = group.stage.found(piece.task)
        if found is not None:
            return Outcome(found)
        folders = folders_of(piece.task)
        self._look_once(folders)
        try:
            with self.gate.reserve(piece.memory, piece.label):
                start = time.perf_counter()
                facts = made_with_patience(lambda: group.stage.make(piece.task), folders, patience)
                return Outcome(facts, taken=time.perf_counter() - start)
        except (OptionError, OutputError):
            raise
        except ColmapSphError as error:
            # Of a file that is there for the others, this machine would say that it is missing.
            blind = [folder for folder in folders if str(folder) in str(error) and not folder.is_dir()]
            return Outcome(None, unseen(_this_worker_does(), blind[0]) if blind else str(error))
        except (MemoryError, cv2.error) as error:
            told = refusal_of(error)
            if told is None:
                raise
            return Outcome(None, str(told))

    def _look_once(self, folders: set[Path]) -> None:
        """Once in a stage what is remembered of a folder is of the stage before."""
        look_again(folders - self._looked_at)
        self._looked_at |= folders

    @contextmanager
    def _at_stage(self, group: Group[Any]) -> Iterator[None]:
        """Keep what the group's stage keeps; wait in line where another stage, or another run, is worked at."""
        stage = (group.run.token, group.number)
        with self._entry, self._changed:
            self._changed.wait_for(lambda: self._users == 0 or self._stage == stage)
            if self._stage != stage:
                self._leave()
                self._held.enter_context(self.gate.keeping(group.kept.total(self.gate.threads)))
                self._held.enter_context(holding_caches(group.stage.caches, group.kept))
                self._stage = stage
            self._users += 1
        try:
            yield
        finally:
            with self._changed:
                self._users -= 1
                self._changed.notify_all()

    def _leave(self) -> None:
        self._held.close()
        give_back_freed_memory()
        self._looked_at = set()
        self._stage = None

    def rest(self, run: RunSeen) -> None:
        """Let go of what is kept for a run that has come to its end."""
        with self._changed:
            if self._users == 0 and self._stage is not None and self._stage[0] == run.token:
                self._leave()


def budget_of(limit: int | None, machine: int, neighbours: int) -> int:
    """Bytes that a worker may use.

    Parameters
    ----------
    limit : int or None
        Bytes that the engine allows it, if it has a limit.
    machine : int
        Bytes of the machine, or of what its processes may use.
    neighbours : int
        Workers on the machine, this one among them: limits that the engine has by default may add up to more than
        there is.
    """
    share = machine // max(neighbours, 1)
    return int(_SAFE_SHARE * min(limit or share, share))


# ---- what a run asks of a worker ---------------------------------------------------------------------------


def described(here: Workplace, run: RunSeen) -> WorkerFacts:
    """Say what a run has to know of this worker."""
    facts = (here.budget, here.in_use, here.gate.threads)
    return WorkerFacts(*facts, refusal=_refusal(run), sees_files=sees_token(run, 0.0))


def refuse_other_programs(run: RunSeen) -> None:
    """Raise `InputError` where this worker would make other results than the machine that the run is on."""
    refusal = _refusal(run)
    if refusal:
        raise InputError(refusal)


def _refusal(run: RunSeen) -> str:
    if _own_digests() == run.digests:
        return ""
    own = versions()
    others = [f"{name} {own[name]}, not {wanted}" for name, wanted in run.versions.items() if own[name] != wanted]
    what = ", ".join(others) or "the same version with another code or other kernels"
    return (
        f"The worker on {socket.gethostname()} has {what}; install the same on all machines, and start the "
        "workers again."
    )


@cache
def _own_digests() -> dict[str, str]:
    return program_digests()


def sees_token(run: RunSeen, patience: float) -> bool:
    """Whether the run is at work, as far as its folder says; a missing file is waited for."""
    deadline = time.monotonic() + patience
    while True:
        try:
            return read_small(run.path, _TOKEN_BYTES, follow=False).decode(errors="replace") == run.token
        except OSError:
            if time.monotonic() >= deadline:
                return False
        time.sleep(0.1)
        look_again([run.path.parent])


def unseen(who: str, folder: Path) -> str:
    """What to say where one worker or more do not see a run's files; `who` ends with "does" or "do"."""
    return (
        f"{who} not see {folder}; images and workspace must lie on a disk that all machines share, under the same "
        "path."
    )


def _this_worker_does() -> str:
    return f"The worker on {socket.gethostname()} does"


class _Words(logging.Handler):
    """Keeps warnings of the package that come from one thread."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.words: list[tuple[int, str]] = []
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            self.words.append((record.levelno, record.getMessage()))


@contextmanager
def _words_heard() -> Iterator[list[tuple[int, str]]]:
    package = logging.getLogger("colmap_sph")
    handler = _Words()
    package.addHandler(handler)
    try:
        yield handler.words
    finally:
        package.removeHandler(handler)
