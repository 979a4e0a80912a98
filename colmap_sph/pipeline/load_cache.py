"""A bounded cache of loaded arrays that the worker threads of a process share."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Generic, TypeVar

T = TypeVar("T")


class LoadCache(Generic[T]):
    """Loads each key once and keeps values while bytes are held for them.

    Those go first that will be needed last, as far as that is known, and of these the least recently used.

    Parameters
    ----------
    size : callable
        Value → bytes.
    """

    def __init__(self, size: Callable[[T], int]) -> None:
        self._size = size
        self._capacity = 0
        self._values: OrderedDict[str, T] = OrderedDict()
        self._needed: dict[str, float] = {}
        self._loading: dict[str, threading.Lock] = {}
        self._lock = threading.Lock()
        self._bytes = 0

    @contextmanager
    def holding(self, capacity: int) -> Iterator[None]:
        """Keep up to so many bytes more for a while; a value larger than all that is not kept."""
        with self._lock:
            self._capacity += capacity
        try:
            yield
        finally:
            with self._lock:
                self._capacity -= capacity
                self._evict()

    def get(self, key: str, load: Callable[[], T], needed: float = 0.0) -> T:
        """The value of `key`, loaded if need be: outside the lock, at most once at a time per key.

        Parameters
        ----------
        key : str
        load : callable
        needed : float
            When it will be needed next, on any scale that all callers share; infinite: never.
        """
        with self._lock:
            loading = self._loading.setdefault(key, threading.Lock())
        with loading:
            with self._lock:
                if key in self._values:
                    self._values.move_to_end(key)
                    self._needed[key] = needed
                    return self._values[key]
            value = load()
            size = self._size(value)
            with self._lock:
                if size <= self._capacity:
                    self._values[key] = value
                    self._needed[key] = needed
                    self._bytes += size
                self._evict()
            return value

    def _evict(self) -> None:
        while self._bytes > self._capacity:
            last = max(islice(self._values, max(len(self._values) - 1, 1)), key=self._needed.__getitem__)
            self._bytes -= self._size(self._values.pop(last))
            del self._needed[last]
        if not self._values:
            self._loading.clear()


def file_stamp(path: Path) -> str:
    """A file's key in a cache: its path, size and time, so that a file made anew is loaded anew."""
    try:
        status = path.stat()
    except OSError:
        return str(path)
    return f"{path} {status.st_size} {status.st_mtime_ns}"
