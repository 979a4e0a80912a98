"""The items of a stage → groups of neighbours that are to be made, found a few at a time."""

import math
from collections.abc import Callable, Generator, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Generic, TypeVar

from colmap_sph.errors import ColmapSphError, OptionError, OutputError
from colmap_sph.pipeline.stages.stage import Job, Stage

Item = TypeVar("Item", bound=Hashable)
Task = TypeVar("Task")

MOST_ITEMS = 64
"""Items of a group."""

# Of what is left each group takes this share of a thread's share: the last ones are small, so that all threads end
# at about the same time.
_SHARE = 1 / 3
# Items that each thread of the driver asks for at a time.
_ASKED = 8


@dataclass(frozen=True)
class Asked(Generic[Item, Task]):
    """An item, and its job; None where it is not wanted or cannot be done, and why."""

    item: Item
    job: Job[Task] | None
    failure: str = ""


def size_of_group(left: int, threads: int) -> int:
    """How many items to put into the next group, of those that are left.

    Examples
    --------
    >>> [size_of_group(left, threads=8) for left in (10_000, 1000, 100, 10, 1)]
    [64, 42, 5, 1, 1]
    """
    return min(max(math.ceil(_SHARE * left / max(threads, 1)), 1), MOST_ITEMS)


class Division(Generic[Item, Task]):
    """Asks a stage for its items, in their order, and groups what is to be made.

    Parameters
    ----------
    stage : Stage
    tell : callable
        Called with each item that need not be made or cannot be.
    """

    def __init__(self, stage: Stage[Item, Task], tell: Callable[[Asked[Item, Task]], None]) -> None:
        self._stage = stage
        self._tell = tell
        self._left = len(stage.items)
        self._waiting: list[Asked[Item, Task]] = []

    def groups(self, threads: Callable[[], int]) -> Generator[list[Asked[Item, Task]]]:
        """The groups one after the other; `threads` says how many of all workers there are now."""
        with ThreadPoolExecutor(self._stage.context.options.num_threads) as pool:
            for asked in self._asked(pool):
                self._left -= 1
                if asked.job is None or asked.job.done is not None:
                    self._tell(asked)
                else:
                    self._waiting.append(asked)
                if len(self._waiting) >= size_of_group(self._left + len(self._waiting), threads()):
                    yield self._taken()
        if self._waiting:
            yield self._taken()

    def _asked(self, pool: ThreadPoolExecutor) -> Iterator[Asked[Item, Task]]:
        step = _ASKED * self._stage.context.options.num_threads
        items = self._stage.items
        for first in range(0, len(items), step):
            yield from pool.map(self._ask, items[first : first + step])

    def _ask(self, item: Item) -> Asked[Item, Task]:
        if not self._stage.is_wanted(item):
            return Asked(item, None)
        try:
            return Asked(item, self._stage.job(item))
        except (OptionError, OutputError):
            raise
        except ColmapSphError as error:
            return Asked(item, None, str(error))

    def _taken(self) -> list[Asked[Item, Task]]:
        taken = self._waiting
        self._waiting = []
        return taken
