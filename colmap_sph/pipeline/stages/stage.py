"""What a stage of a run is: its items, and for each of them a job that can be asked, planned, or done.

A stage knows for every item the key of its result, whether that is there, what it would cost, and a task: a record
of paths, cameras and options that can be pickled. `Stage.make` turns a task into files, and is a plain function of
that task. So the same job runs in a thread, in a process or on another machine, and a dry run asks the same stages
that a run executes.
"""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.pipeline.stages.facts import Facts

if TYPE_CHECKING:  # what the code of a stage's results depends on is in its key, see `program`; these have no part
    from colmap_sph.pipeline.context import Context
    from colmap_sph.pipeline.memory import MemoryGate

Item = TypeVar("Item", bound=Hashable)
Task = TypeVar("Task")


@dataclass(frozen=True)
class Cost:
    """What making one result takes.

    Attributes
    ----------
    seconds : float
        Of one processor core; an estimate.
    memory : float
        Largest bytes of arrays at a time, beside what the stage keeps; reserved before the work begins.
    disk : float
        Bytes of the files; an estimate.
    scratch : float
        Bytes that it would fill of a worker's scratch memory, where that were unlimited.
    """

    seconds: float
    memory: float
    disk: float
    scratch: float = 0.0

    def beside(self, other: "Cost") -> "Cost":
        """Of making both, one after the other."""
        return Cost(
            self.seconds + other.seconds,
            max(self.memory, other.memory),
            self.disk + other.disk,
            max(self.scratch, other.scratch),
        )


@dataclass(frozen=True)
class Job(Generic[Task]):
    """What there is to know about one item.

    Attributes
    ----------
    key : str
        Digest of all that its result depends on.
    done : Facts or None
        What is known of the result where it is there under this key; None where it must be made.
    cost : Cost
        Of making it; where it is done it may be left out.
    task : Task
        What `Stage.make` needs; can be pickled.
    """

    key: str
    done: Facts | None
    cost: Cost
    task: Task


@dataclass(frozen=True)
class Result:
    """Outcome of one item.

    Attributes
    ----------
    key : str
        See `Job`.
    made : bool
        Whether this run made it.
    facts : Facts
        What is known of it.
    seconds : float
        Processor seconds that making it was to cost.
    taken : float
        Seconds that it took the worker.
    """

    key: str
    made: bool
    facts: Facts
    seconds: float = 0.0
    taken: float = 0.0


class Stage(ABC, Generic[Item, Task]):
    """One stage of one run.

    Parameters
    ----------
    context : Context
    items : sequence
        What it works on, each once: hashable.
    """

    name: ClassVar[str]
    whole: ClassVar[bool] = False
    """Whether one item is all there is: its failure ends the run, and the budget does not bound its memory."""
    caches: ClassVar[tuple[LoadCache[Any], ...]] = ()
    """What `make` loads, it keeps there for the items that follow, in each process."""

    def __init__(self, context: "Context", items: Sequence[Item]) -> None:
        self.context = context
        self.items = items

    @property
    def steps(self) -> int:
        """How many steps of progress it has: the last of each item is told where this is done."""
        return len(self.items)

    @abstractmethod
    def job(self, item: Item) -> Job[Task]:
        """Ask for an item; `ColmapSphError` where it cannot be done."""

    @staticmethod
    @abstractmethod
    def make(task: Task) -> Facts:
        """Make one result: a plain function of its task, for any thread, process or machine."""

    @staticmethod
    def found(task: Task) -> Facts | None:
        """What is known of a task's result where it is there: what a machine that was lost had made already."""
        return None

    @staticmethod
    def end_thread() -> None:
        """Give back what `make` keeps for the calling thread, which ends."""

    def is_wanted(self, item: Item) -> bool:
        """Whether there is still time for an item; asked by the worker that is to begin it, in their order."""
        return True

    def is_missing(self, item: Item) -> bool:
        """Whether the result of an item is surely not there, as can be told at a glance."""
        return False

    def label(self, item: Item) -> str:
        """What an item is called in messages: itself, where it is a name."""
        return str(item)

    def skip(self, item: Item, reason: str) -> None:
        """Report that an item failed."""
        self.context.skip_view(self.label(item), reason)

    def kept_memory(self, gate: "MemoryGate") -> "Kept":
        """What the stage keeps in memory from item to item, of what the gate has free."""
        return Kept()

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Make the folders that results go to; those for the time of the stage are there until this ends."""
        yield

    @contextmanager
    def holding(self, kept: "Kept") -> Iterator[None]:
        """Hold what the stage keeps in memory, while items are made."""
        with holding_caches(self.caches, kept):
            yield

    def close(self, results: Mapping[Item, Result]) -> None:
        """Report the results, and raise `NoResultError` where there is nothing to go on with."""

    def tell_problems(self) -> None:
        """Raise for what is wrong with the items that failed, once all are known; also in a dry run."""

    def count(self, results: Mapping[Item, Result]) -> tuple[int, int]:
        """How many results this run made, and how many were there."""
        made = sum(result.made for result in results.values())
        return made, len(results) - made


@dataclass(frozen=True)
class Kept:
    """Memory that a stage keeps from item to item.

    Attributes
    ----------
    scratch : int
        Bytes of each worker.
    cache : int
        Most bytes of each of the stage's caches.
    caches : int
        Number of caches.
    filled : float
        Bytes with which the caches would be full of all that there is to load; they never hold more.
    """

    scratch: int = 0
    cache: int = 0
    caches: int = 0
    filled: float = 0.0

    def total(self, threads: int) -> int:
        """Bytes to keep free for all of it."""
        return threads * self.scratch + self.caches * self.cache


@contextmanager
def holding_caches(caches: Sequence[LoadCache[Any]], kept: Kept) -> Iterator[None]:
    """Let the caches of a stage keep as much as is kept for each."""
    with ExitStack() as held:
        for cache in caches:
            held.enter_context(cache.holding(kept.cache))
        yield


def keys_of(results: Mapping[Item, Result]) -> dict[Item, str]:
    """Key of each result, by item."""
    return {item: result.key for item, result in results.items()}
