"""Threads that have nothing else to do → parts of one piece of work, done at once.

Few large images keep few threads busy. What their work can be divided into, idle threads take over.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

_changed = threading.Condition()
_idle = 0


@contextmanager
def lending(threads: int) -> Iterator[None]:
    """Let so many more threads help while they have nothing else to do, see `busy`."""
    _change(threads)
    try:
        yield
    finally:
        _change(-threads)


@contextmanager
def busy() -> Iterator[None]:
    """One of the threads has its own work; where all help others it begins when the first of them is done.

    So never more work at a time than there are threads, whose memory is planned.
    """
    with _changed:
        _changed.wait_for(_take)
    try:
        yield
    finally:
        _change(1)


def at_once(*parts: Callable[[], T]) -> list[T]:
    """Results of parts that do not depend on each other: made by this thread, and by those that are idle."""
    left = deque(enumerate(parts))
    results: dict[int, T] = {}
    errors: list[BaseException] = []

    def work() -> None:
        while not errors:
            try:
                number, part = left.popleft()
            except IndexError:
                return
            try:
                results[number] = part()
            except BaseException as error:
                errors.append(error)

    helpers = _helpers(work, len(parts) - 1)
    work()
    for helper in helpers:
        helper.join()
    try:
        if errors:
            raise errors[0]
    finally:
        errors.clear()  # or this frame and their tracebacks keep each other, and all arrays of the parts
    return [results[number] for number in range(len(parts))]


def _helpers(work: Callable[[], None], most: int) -> list[threading.Thread]:
    helpers: list[threading.Thread] = []
    while len(helpers) < most and _take():
        helper = threading.Thread(target=_help, args=(work,))
        try:
            helper.start()
        except RuntimeError:  # no memory for its stack, or a limit on threads
            _change(1)
            break
        helpers.append(helper)
    return helpers


def _help(work: Callable[[], None]) -> None:
    try:
        work()
    finally:
        _change(1)


def _take() -> bool:
    global _idle
    with _changed:
        if _idle < 1:
            return False
        _idle -= 1
        return True


def _change(threads: int) -> None:
    global _idle
    with _changed:
        _idle += threads
        _changed.notify_all()
