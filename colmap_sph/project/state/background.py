"""A thread of its own that waits for the disk, so that no worker does."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import copy_context


class _Background:
    """A thread that waits for the disk, while any run wants it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._runs = 0
        self._waiting: list[Future[None]] = []

    def submit(self, function: Callable[..., None], *arguments: object) -> bool:
        """Have a function called later; False where no run wants the thread."""
        with self._lock:
            if self._pool is None:
                return False
            # Whoever may not write here any more may not vouch either, see `files.writing_only_if`.
            self._waiting.append(self._pool.submit(copy_context().run, function, *arguments))
            return True

    def open(self) -> None:
        """A run begins that wants it."""
        with self._lock:
            self._runs += 1
            self._pool = self._pool or ThreadPoolExecutor(1, thread_name_prefix="vouch")

    def close(self) -> list["Future[None]"]:
        """A run ends; returns all that is done now, of whichever run."""
        with self._lock:
            done = self._waiting
            self._waiting = []
            self._runs -= 1
            pool = self._pool
            if self._runs == 0:
                self._pool = None
        wait(done)
        if pool is not None and self._runs == 0:
            pool.shutdown()
        return done


_background = _Background()


def submit(function: Callable[..., None], *arguments: object) -> bool:
    """Have a function called later, by `vouching_in_background`; False where nobody wants that."""
    return _background.submit(function, *arguments)


@contextmanager
def vouching_in_background() -> Iterator[None]:
    """Let a thread of its own wait for the disk meanwhile, so that no worker does.

    Raises
    ------
    OutputError
        At the end, where a file or a record could not be written.
    """
    _background.open()
    try:
        yield
    finally:
        done = _background.close()
    for each in done:
        each.result()
