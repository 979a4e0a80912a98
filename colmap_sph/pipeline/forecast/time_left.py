"""What stages are expected to take, and how long they have taken so far → the time left of a whole run."""

import time
from collections.abc import Callable, Sequence

from colmap_sph.pipeline.report import Silent, StageEstimate

_TRUST = 0.01
"""Share of the whole work by which the first guess of the speed still counts, once some has been measured."""


class TimeLeft(Silent):
    """The time left of a run; hears what the pipeline tells, as a `Progress` does.

    Work is counted in the processor seconds that its jobs were estimated at. What such a second takes on this
    machine is measured as the run goes: at first it is taken for one second, divided by the workers.

    Parameters
    ----------
    workers : int
        Items that are worked at side by side.
    clock : callable
        Returns seconds.
    """

    def __init__(self, workers: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._workers = workers
        self._clock = clock
        self._is_foreseen = False
        self._ahead: dict[str, StageEstimate] = {}
        self._whole = 0.0
        # Of all stages before: their work that was made, and the time it took.
        self._worked = 0.0
        self._taken = 0.0
        # Of the stage that is worked at.
        self._stage: StageEstimate | None = None
        self._started = self._told = self._clock()
        self._steps = 0
        self._made_steps = 0
        self._made = 0.0

    def engage(self, threads: int, words: str) -> None:
        """See `Progress`."""
        self._workers = max(threads, 1)

    def foresee(self, stages: Sequence[StageEstimate]) -> None:
        """See `Progress`."""
        self._is_foreseen = True
        self._ahead = {stage.name: stage for stage in stages}
        self._whole = self._worked + sum(stage.seconds for stage in stages)

    def start(self, stage: str, total: int) -> None:
        """See `Progress`."""
        if self._made:
            self._worked += self._made
            self._taken += self._told - self._started
        estimate = self._ahead.pop(stage, None)
        self._stage = estimate and StageEstimate(
            stage, total, estimate.seconds * total / max(estimate.items, 1), estimate.item_seconds
        )
        self._started = self._told = self._clock()
        self._steps = 0
        self._made_steps = 0
        self._made = 0.0

    def advance(self, seconds: float = 0.0) -> None:
        """See `Progress`."""
        self._told = self._clock()
        self._steps += 1
        self._made_steps += seconds > 0
        self._made += seconds

    def seconds(self) -> float | None:
        """Seconds that the run will still take; None where nothing is known of what is to come."""
        if not self._is_foreseen:
            return None
        ahead = sum(stage.seconds for stage in self._ahead.values())
        if self._stage is None:
            return ahead * self._speed(0.0)
        mean = self._made / self._made_steps if self._made_steps else self._stage.item_seconds
        steps = self._steps_to_make()
        # When a step is told, the other workers have done half of theirs, on average.
        underway = 0.5 * min(self._workers - 1, steps) * mean if self._made_steps else 0.0
        speed = self._speed(underway)
        since = self._clock() - self._told
        return max((steps * mean - underway) * speed - since, 0.0) + ahead * speed

    def _steps_to_make(self) -> float:
        """Steps of this stage which are not there yet, and will be made."""
        assert self._stage is not None
        left = max(self._stage.items - self._steps, 0)
        to_make = self._stage.seconds / self._stage.item_seconds if self._stage.item_seconds else 0.0
        share = to_make / max(self._stage.items, 1)
        return min(max(to_make - self._made_steps, share * left), left)

    def _speed(self, underway: float) -> float:
        """Seconds that a second of estimated work takes."""
        first_guess = 1 / self._workers
        trust = max(_TRUST * self._whole, 1e-9)
        worked = self._worked + (self._made + underway if self._stage is not None else 0.0)
        taken = self._taken + (self._told - self._started if self._stage is not None and self._made else 0.0)
        return (taken + trust * first_guess) / (worked + trust)
