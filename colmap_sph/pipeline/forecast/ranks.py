"""Pairs in the order of their worth, matched rank by rank as long as there is time."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from colmap_sph.pipeline.stages.match import MatchStage, MatchTask
from colmap_sph.pipeline.stages.stage import Job
from colmap_sph.stereo.partners.pairing import Pair, as_pair
from colmap_sph.stereo.partners.pairs import PairSelection

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context


def ranks_of(selection: PairSelection) -> list[list[Pair]]:
    """Every pair once, by the place that one of its images has among the other's partners.

    Parameters
    ----------
    selection : PairSelection

    Returns
    -------
    list of list of (str, str)
        Those of the first n are the pairs that would be chosen with n partners.
    """
    rank_of: dict[Pair, int] = {}
    for reference, partners in selection.partners.items():
        for rank, partner in enumerate(partners):
            pair = as_pair(reference, partner.name)
            rank_of[pair] = min(rank, rank_of.get(pair, rank))
    ranks: list[list[Pair]] = [[] for _ in range(1 + max(rank_of.values(), default=-1))]
    for pair, rank in sorted(rank_of.items()):
        ranks[rank].append(pair)
    return ranks


@dataclass(frozen=True)
class Progressed:
    """How far a stage is: estimated processor seconds that are done and under way, and seconds since it began."""

    worked: float
    underway: float
    taken: float


class ProbeStage(MatchStage):
    """Matches a few pairs, to see how fast this machine is."""

    name = "time some pairs"

    def close(self, results: object) -> None:
        """Nothing: what failed, the next stage tells."""


class RankStage(MatchStage):
    """Matches pairs rank by rank.

    Parameters
    ----------
    context : Context
    ranks : sequence of sequences of pairs
    may_begin : callable
        Whether there is time for a rank, from how far the stage is. Asked once for each, in their order, until
        there is none.
    clock : callable
        Returns seconds.
    first : int
        How many ranks were matched before.
    """

    def __init__(
        self,
        context: "Context",
        ranks: Sequence[Sequence[Pair]],
        may_begin: Callable[[int, Progressed], bool],
        clock: Callable[[], float],
        first: int = 0,
    ) -> None:
        super().__init__(context, [pair for rank in ranks for pair in rank])
        self._rank_of = {pair: first + index for index, rank in enumerate(ranks) for pair in rank}
        self._may_begin = may_begin
        self._clock = clock
        self._lock = threading.Lock()
        self._is_over = False
        self._begun: list[float] = []
        self._started: float | None = None
        self.done = first
        """Ranks that were begun, those before this stage among them."""

    def is_wanted(self, item: Pair) -> bool:
        """See `Stage.is_wanted`."""
        rank = self._rank_of[item]
        with self._lock:
            now = self._clock()
            if self._started is None:
                self._started = now
            while self.done <= rank and not self._is_over:
                if self._may_begin(self.done, self._progressed(now - self._started)):
                    self.done += 1
                else:
                    self._is_over = True
            return rank < self.done

    def _progressed(self, taken: float) -> Progressed:
        """The other workers have done half of what they are at, on average."""
        others = self.context.options.num_threads - 1
        underway = 0.5 * sum(self._begun[-others:] if others else [])
        return Progressed(sum(self._begun) - underway, underway, taken)

    def job(self, item: Pair) -> Job[MatchTask]:
        """See `Stage.job`."""
        job = super().job(item)
        if job.done is None:
            with self._lock:
                self._begun.append(job.cost.seconds)
        return job


class MoreRanksStage(RankStage):
    """Matches further ranks, where there is time left."""

    name = "match more pairs"

    def close(self, results: object) -> None:
        """Nothing: they may all fail."""
