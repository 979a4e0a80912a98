"""Idle threads help."""

import gc
import threading
import weakref
from functools import partial

import numpy as np
import pytest

from colmap_sph.stereo.search.idle import at_once, busy, lending


def test_parts_are_done_in_their_order_where_no_thread_is_idle():
    done = []

    def square(part):
        done.append(part)
        return part**2

    assert at_once(*(partial(square, part) for part in range(5))) == [0, 1, 4, 9, 16]
    assert done == [0, 1, 2, 3, 4]


def test_parts_are_done_at_once_by_threads_that_are_idle():
    """Three wait for each other; a thread that has its own work is not asked."""
    meeting = threading.Barrier(3, timeout=20)

    def part():
        meeting.wait()
        return threading.get_ident()

    with lending(3), busy():
        assert len(set(at_once(part, part, part))) == 3
        with busy(), busy():
            assert set(at_once(*[threading.get_ident] * 8)) == {threading.get_ident()}
        assert len(set(at_once(part, part, part))) == 3  # who has helped is idle again


def test_the_error_of_a_part_is_raised():
    """By whatever thread it was found, when none works any more."""

    def wrong():
        raise MemoryError("of a part")

    for order in ((wrong, int), (int, wrong), (wrong, wrong)):
        for threads in (0, 2):
            with lending(threads), pytest.raises(MemoryError, match="of a part"):
                at_once(*order)


def test_the_error_of_a_part_keeps_no_memory():
    """Its traceback knows all arrays of the part: they go with the error, not when garbage is looked for."""
    arrays = []

    def wrong():
        array = np.zeros(10)
        arrays.append(weakref.ref(array))
        raise MemoryError("of a part")

    gc.disable()
    try:
        for threads in (0, 2):
            with lending(threads), pytest.raises(MemoryError):
                at_once(wrong, int, wrong)
            assert arrays and all(array() is None for array in arrays)
    finally:
        gc.enable()


def test_who_begins_its_own_work_waits_for_who_helps():
    """Two threads are two at a time, also where one gets work of its own while it helps the other."""
    begun, end, own = threading.Barrier(3, timeout=20), threading.Event(), threading.Event()

    def part():
        begun.wait()
        assert end.wait(20)

    def helped():
        with busy():
            at_once(part, part)

    def has_work():
        with busy():
            own.set()

    with lending(2):
        first = threading.Thread(target=helped)
        first.start()
        begun.wait()
        second = threading.Thread(target=has_work)
        second.start()
        assert not own.wait(0.2)
        end.set()
        assert own.wait(20)
        first.join()
        second.join()
