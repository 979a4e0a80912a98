"""A bounded cache of loaded arrays that worker threads share."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class LoadCache(Generic[T]):
    """Loads each key once and keeps the most recently used values within a number of bytes.

    Parameters
    ----------
    load : callable
        Key → value; runs outside the lock, at most once at a time per key.
    size : callable
        Value → bytes.
    capacity : int
        Bytes to keep; a single larger value is kept while nothing newer comes.
    """

    def __init__(self, load: Callable[[str], T], size: Callable[[T], int], capacity: int) -> None:
        self._load, self._size, self._capacity = load, size, capacity
        self._values: OrderedDict[str, T] = OrderedDict()
        self._loading: dict[str, threading.Lock] = {}
        self._lock = threading.Lock()
        self._bytes = 0

    def get(self, key: str) -> T:
        """The value of `key`, loaded if need be."""
        with self._lock:
            loading = self._loading.setdefault(key, threading.Lock())
        with loading:
            with self._lock:
                if key in self._values:
                    self._values.move_to_end(key)
                    return self._values[key]
            value = self._load(key)
            with self._lock:
                self._values[key] = value
                self._bytes += self._size(value)
                while self._bytes > self._capacity and len(self._values) > 1:
                    _, oldest = self._values.popitem(last=False)
                    self._bytes -= self._size(oldest)
            return value
