"""Worker threads: order, failures of single items, and the errors that end a stage."""

import threading
import time
import weakref

import cv2
import numpy as np
import pytest

from colmap_sph.errors import InputError, OptionError, OutOfMemoryError, OutputError, RectificationError
from colmap_sph.pipeline.report import Silent
from colmap_sph.pipeline.workers import for_all


class Count(Silent):
    done = 0

    def advance(self, seconds: float = 0.0) -> None:
        self.done += 1


def run(work, items, threads=3):
    """(results, skipped, number of steps told)."""
    skipped: dict = {}
    progress = Count()
    results = for_all(work, items, threads=threads, advance=lambda _: progress.advance(), skip=skipped.__setitem__)
    return results, skipped, progress.done


def test_results_come_in_the_order_of_the_items() -> None:
    def slow_first(item: int) -> int:
        time.sleep(0.02 * (5 - item))
        return item**2

    results, skipped, steps = run(slow_first, range(5))
    assert list(results.items()) == [(i, i**2) for i in range(5)]
    assert (skipped, steps) == ({}, 5)


@pytest.mark.parametrize("error", [InputError("bad"), RectificationError("bad"), MemoryError(), None])
def test_one_failure_costs_one_item(error: Exception | None) -> None:
    def work(item: int) -> int:
        if item == 2:
            if error is not None:
                raise error
            # OpenCV's own word for memory that is refused
            cv2.resize(np.zeros((2, 2), np.uint8), (2**31 - 1, 2**31 - 1))
        return item

    results, skipped, steps = run(work, range(4))
    assert list(results) == [0, 1, 3]
    assert list(skipped) == [2]
    assert (
        skipped[2] == str(error) if isinstance(error, (InputError, RectificationError)) else "memory" in skipped[2]
    )
    assert steps == 4


@pytest.mark.parametrize("error", [OptionError, OutputError, ZeroDivisionError, KeyboardInterrupt])
def test_other_errors_end_the_stage(error: type[BaseException]) -> None:
    """Items that have not begun are not begun any more."""
    begun = []

    def work(item: int) -> None:
        begun.append(item)
        if item == 0:
            raise error("end")
        time.sleep(0.02)

    with pytest.raises(error, match="end"):
        run(work, range(100), threads=2)
    assert len(begun) < 20


def test_of_two_errors_that_of_the_first_item_is_told() -> None:
    """Not that of the faster one; and not that of one that has not begun."""

    def work(item: int) -> None:
        time.sleep((0.0, 0.2, 0.0, 0.4)[item])
        if item:
            raise OutputError(f"no room for {item}")

    with pytest.raises(OutputError, match="no room for 1"):
        run(work, range(4), threads=2)


def test_a_failed_item_keeps_no_memory() -> None:
    """The traceback of its error would keep all arrays of the work."""
    arrays: list[weakref.ref] = []

    def work(item: int) -> int:
        array = np.zeros(10)
        arrays.append(weakref.ref(array))
        if item < 2:
            raise InputError("bad")
        time.sleep(0.05)
        return sum(reference() is not None for reference in arrays)

    results, _, _ = run(work, range(3), threads=1)
    assert results[2] == 1


def test_threads_that_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(OutOfMemoryError, match="refuses another thread; give fewer --threads"):
        run(abs, range(3))
