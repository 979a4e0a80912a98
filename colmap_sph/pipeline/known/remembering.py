"""A stage that remembers which of its results were up to date, see `table`."""

import os
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

from colmap_sph.pipeline.known.table import KnownResult, ResultTable, stamp_of_files
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.stage import Cost, Item, Job, Result, Stage, Task
from colmap_sph.project.workspace import KnownFile

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

NO_COST = Cost(0.0, 0.0, 0.0)


class RememberingStage(Stage[Item, Task]):
    """A stage whose `job` looks up what is known, and asks only for the rest."""

    remembered_as: ClassVar[KnownFile | None] = None
    """Of what it remembers results, see `Workspace.known_path`; None: it does not."""

    def __init__(self, context: "Context", items: Sequence[Item]) -> None:
        super().__init__(context, items)
        self._stamps: dict[Item, str] = {}

    @abstractmethod
    def input_key(self) -> str:
        """Digest of all from which `ask` finds out what the key of an item is."""

    @abstractmethod
    def files(self, item: Item) -> list[str]:
        """Paths of the files of a result, what vouches for them among these."""

    @abstractmethod
    def ask(self, item: Item) -> Job[Task]:
        """What `job` returns for an item of which nothing is known."""

    @abstractmethod
    def is_there(self, item: Item, key: str) -> bool:
        """Whether the files of a result are those that were made under a key."""

    @cached_property
    def _table(self) -> ResultTable | None:
        if self.remembered_as is None or self.context.keys.fresh:
            return None
        return ResultTable(self.context.workspace.known_path(self.remembered_as), self.input_key())

    def job(self, item: Item) -> Job[Task]:
        """See `Stage.job`."""
        if self._table is None:
            return self.ask(item)
        known = self._table.find(_name(item), self.files(item))
        if known is not None:
            return done(known.key, known.facts)
        stamp = stamp_of_files(self.files(item))  # before they are looked at
        job = self.ask(item)
        if job.done is not None:
            self._stamps[item] = stamp
        return job

    def is_missing(self, item: Item) -> bool:
        """See `Stage.is_missing`."""
        return self.context.keys.fresh or not os.path.exists(self.files(item)[0])  # noqa: PTH110 - of very many

    def remember(self, results: Mapping[Item, Result]) -> None:
        """Write down which results are up to date now; for `close`."""
        if self._table is None:
            return
        known = {}
        for item, result in results.items():
            if not result.made:
                stamp = self._stamps.get(item, "")  # none of those that are in the table
            else:
                stamp = stamp_of_files(self.files(item))
                if not self.is_there(item, result.key):
                    continue  # someone has put something else there meanwhile, or it is not complete
            if stamp:
                known[_name(item)] = KnownResult(result.key, stamp, result.facts)
        self._table.add(known)


def _name(item: Any) -> str:
    return item if isinstance(item, str) else "\0".join(item)


def done(key: str, facts: Facts) -> Job[Any]:
    """The job of a result that is there, of which nothing else will be asked."""
    return Job(key, facts, NO_COST, None)
