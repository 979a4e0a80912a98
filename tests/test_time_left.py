"""The time left of a run, against simulated runs whose time is known."""

import heapq
import random
from itertools import pairwise
from typing import Any

import pytest

from colmap_sph.pipeline.forecast.time_left import TimeLeft
from colmap_sph.pipeline.report import StageEstimate

STAGES = {"match": (200, 2.0), "vote": (33, 0.4), "confirm": (33, 1.5), "fuse": (33, 0.5)}
"""Items, and estimated processor seconds of each."""


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def simulated(
    workers: int, factors: dict[str, float], done: dict[str, int] | None = None, seed: int = 1
) -> tuple[list[tuple[float, Any]], float]:
    """(time, time left as told) at every step of a run, and when it ended.

    An item takes as long as estimated, times the stage's factor, and up to half more or less. The first `done` of
    a stage are there.
    """
    done = done or {}
    rng = random.Random(seed)
    clock = Clock()
    left = TimeLeft(workers, clock)
    told = []
    known = done.get("match", 0)
    left.foresee(
        [
            StageEstimate(name, items, each * (items - (known if name == "match" else 0)), each)
            for name, (items, each) in STAGES.items()
        ]
    )
    for name, (items, each) in STAGES.items():
        left.start(name, items)
        for _ in range(done.get(name, 0)):
            clock.now += 0.001
            left.advance(0.0)
            told.append((clock.now, left.seconds()))
        to_do = items - done.get(name, 0)
        ends = [clock.now] * workers
        finished = []
        for _ in range(to_do):
            end = heapq.heappop(ends) + each * factors.get(name, 1.0) * rng.uniform(0.5, 1.5)
            heapq.heappush(ends, end)
            finished.append(end)
        for end in sorted(finished):
            clock.now = end
            left.advance(each)
            told.append((clock.now, left.seconds()))
    return told, clock.now


@pytest.mark.parametrize("workers", [1, 2, 16])
@pytest.mark.parametrize("speed", [0.4, 1.0, 5.0])
def test_it_comes_true(workers: int, speed: float) -> None:
    """Whatever the machine's speed: within 25 % of the whole after a tenth, and 15 % after the half."""
    told, end = simulated(workers, dict.fromkeys(STAGES, speed))
    errors = [(time / end, abs(time + left - end) / end) for time, left in told]
    assert max(error for share, error in errors if share > 0.1) < 0.25
    assert max(error for share, error in errors if share > 0.5) < 0.15
    assert told[-1][1] == 0


def test_a_stage_that_was_estimated_wrongly() -> None:
    """The last two stages take twice as long as thought: told no later than when they are under way."""
    told, end = simulated(4, {"confirm": 2.0, "fuse": 2.0})
    assert all(abs(time + left - end) < 0.3 * end for time, left in told if time > 0.1 * end)


def test_before_anything_is_measured_the_estimate_counts() -> None:
    clock = Clock()
    left = TimeLeft(2, clock)
    assert left.seconds() is None
    left.start("undistort", 10)
    left.advance()
    assert left.seconds() is None
    left.foresee([StageEstimate("match", 10, 30.0, 3.0), StageEstimate("fuse", 10, 10.0, 1.0)])
    assert left.seconds() == pytest.approx(20.0)
    left.start("match", 10)
    assert left.seconds() == pytest.approx(20.0)
    clock.now += 2.0  # no step is done yet: the time passes
    assert left.seconds() == pytest.approx(18.0)


def test_a_run_goes_on() -> None:
    """Half of the pairs are there: known beforehand. Votes are there, too: noticed when they are come to."""
    told, end = simulated(2, {}, {"match": 100, "vote": 20})
    assert all(abs(time + left - end) < 0.15 * end for time, left in told)


def test_nothing_is_to_do() -> None:
    told, _ = simulated(2, {}, {name: items for name, (items, _) in STAGES.items()})
    assert told[-1][1] == 0
    assert all(later[1] <= earlier[1] for earlier, later in pairwise(told))


def test_estimates_that_are_replaced_keep_the_speed() -> None:
    clock = Clock()
    left = TimeLeft(1, clock)
    left.foresee([StageEstimate("match to polish", 100, 100.0, 1.0)])
    left.start("match to polish", 100)
    for _ in range(100):
        clock.now += 4.0
        left.advance(1.0)
    left.foresee([StageEstimate("match", 100, 100.0, 1.0)])
    assert left.seconds() == pytest.approx(400.0, rel=0.2)
