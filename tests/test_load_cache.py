"""The cache that workers share: each value loaded once, no more kept than allowed."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Protocol

import pytest

from colmap_sph.pipeline.load_cache import LoadCache, file_stamp


class Loader:
    """Values of a given size, and a record of the keys asked for."""

    def __init__(self, size: int = 10) -> None:
        self.size = size
        self.loaded: list[str] = []

    def __call__(self, key: str) -> bytes:
        self.loaded.append(key)
        return key.encode() * self.size


class CacheOf(Protocol):
    def __call__(self, load: Callable[[str], bytes], capacity: int) -> Callable[[str], bytes]: ...


@pytest.fixture
def cache_of() -> Iterator[CacheOf]:
    """A cache's `get` that loads by a function of the key; capacity is held while the test runs."""
    with ExitStack() as held:

        def make(load: Callable[[str], bytes], capacity: int) -> Callable[[str], bytes]:
            cache: LoadCache[bytes] = LoadCache(len)
            held.enter_context(cache.holding(capacity))
            return lambda key: cache.get(key, lambda: load(key))

        yield make


def test_a_kept_value_is_loaded_once(cache_of: CacheOf) -> None:
    load = Loader()
    cache = cache_of(load, 100)
    first = cache("a")
    assert cache("a") is first
    assert cache("b") == b"b" * 10
    assert load.loaded == ["a", "b"]


def test_the_least_recently_used_goes_first(cache_of: CacheOf) -> None:
    load = Loader()
    cache = cache_of(load, 30)
    for key in "abcadabc":
        # a b c; a again; d pushes out b; a; b pushes out c; c pushes out d
        assert cache(key) == key.encode() * 10
    assert load.loaded == [*"abcd", *"bc"]


def test_capacity_counts_what_is_kept_alone(cache_of: CacheOf) -> None:
    """After many evictions and returns as much fits as at the start."""
    load = Loader()
    cache = cache_of(load, 30)
    for _ in range(20):
        for key in "abcdefg":
            cache(key)
    load.loaded.clear()
    for key in "efgefg":
        cache(key)
    assert load.loaded == []


def test_a_value_larger_than_the_capacity_is_not_kept(cache_of: CacheOf) -> None:
    """Nor does it push out what is: a stage has reserved no more than the capacity for all that it keeps."""
    load = Loader(10)
    large = Loader(31)
    cache = cache_of(lambda key: (large if key.isupper() else load)(key), 30)
    for key in "abcAAabcB":
        assert cache(key) == key.encode() * (31 if key.isupper() else 10)
    assert load.loaded == [*"abc"]
    assert large.loaded == [*"AAB"]


def test_a_failure_is_not_kept(cache_of: CacheOf) -> None:
    answers: Iterator[OSError | bytes] = iter([OSError("disk"), b"value"])

    def load(key: str) -> bytes:
        answer = next(answers)
        if isinstance(answer, OSError):
            raise answer
        return answer

    cache = cache_of(load, 30)
    with pytest.raises(OSError, match="disk"):
        cache("a")
    assert cache("a") == b"value"


def test_threads_that_want_one_value_load_it_once(cache_of: CacheOf) -> None:
    barrier = threading.Barrier(8)
    go = threading.Event()
    loaded = []

    def load(key: str) -> bytes:
        go.wait(5)
        loaded.append(key)
        return b"value"

    cache = cache_of(load, 100)

    def work(_: int) -> bytes:
        barrier.wait(5)
        return cache("a")

    with ThreadPoolExecutor(8) as pool:
        futures = [pool.submit(work, number) for number in range(8)]
        go.set()
        values = [future.result(5) for future in futures]
    assert loaded == ["a"]
    assert all(value is values[0] for value in values)


def test_different_values_load_at_the_same_time(cache_of: CacheOf) -> None:
    both = threading.Barrier(2)

    def load(key: str) -> bytes:
        both.wait(5)  # breaks, and raises, unless both loads run at once
        return key.encode()

    cache = cache_of(load, 100)
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(cache, "ab")) == [b"a", b"b"]


def test_many_threads_in_a_small_cache(cache_of: CacheOf) -> None:
    load = Loader()
    cache = cache_of(load, 25)
    keys = [chr(ord("a") + number % 7) for number in range(700)]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(cache, keys)) == [key.encode() * 10 for key in keys]


def test_nothing_is_kept_from_one_stage_to_the_next() -> None:
    load = Loader()
    cache: LoadCache[bytes] = LoadCache(len)
    for _ in range(2):
        with cache.holding(30):
            for key in "abcabc":
                cache.get(key, partial(load, key))
    assert load.loaded == [*"abc", *"abc"]


def test_a_file_made_anew_is_another(tmp_path: Path) -> None:
    path = tmp_path / "file"
    stamps = [file_stamp(path)]
    for content in ("a", "ab"):
        path.write_text(content)
        stamps.append(file_stamp(path))
    assert len(set(stamps)) == 3
    assert file_stamp(path) == stamps[-1]


def test_outside_of_a_stage_nothing_is_kept() -> None:
    load = Loader()
    cache: LoadCache[bytes] = LoadCache(len)
    for key in "aab":
        cache.get(key, partial(load, key))
    assert load.loaded == [*"aab"]


def test_two_holders_at_once() -> None:
    """The first to end takes back what it gave, and no more."""
    load = Loader()
    cache: LoadCache[bytes] = LoadCache(len)
    with cache.holding(20):
        with cache.holding(10):
            for key in "abcabc":
                cache.get(key, partial(load, key))
            assert load.loaded == [*"abc"]
        for key in "bcbc":
            cache.get(key, partial(load, key))
        assert load.loaded == [*"abc"]
        cache.get("a", partial(load, "a"))
    assert load.loaded == [*"abca"]


def test_a_file_that_cannot_be_asked_has_a_key(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Whoever loads it says what is wrong."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(Path, "stat", refuse)
    assert file_stamp(tmp_path / "a") != file_stamp(tmp_path / "b")
