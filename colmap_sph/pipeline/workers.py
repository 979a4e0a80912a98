"""Worker threads: one function over many items, where the failure of one item costs that item alone."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from typing import TypeVar

import cv2

from colmap_sph.errors import ColmapSphError, OptionError, OutOfMemoryError, OutputError
from colmap_sph.platforms.memory import keep_freed_memory

T = TypeVar("T")
R = TypeVar("R")

# Errors that no other item of a stage would be spared.
_FATAL = (OptionError, OutputError)
_NO_THREAD = (
    "The system refuses another thread; give fewer --threads, end other programs, or allow more threads (ulimit "
    "-u, or the container's limit of processes) or memory (ulimit -v)."
)


def for_all(
    work: Callable[[T], R],
    items: Sequence[T],
    *,
    threads: int,
    advance: Callable[[R | None], None],
    skip: Callable[[T, str], None],
) -> dict[T, R]:
    """`work` on all items in worker threads.

    Parameters
    ----------
    work : callable
        Item → result; called in a worker thread.
    items : sequence
        Hashable, each once.
    threads : int
    advance : callable
        Called once per item, in this thread, with its result, or None where there is none.
    skip : callable
        Called with an item that raised a `ColmapSphError` or found no memory, and the reason. Any other error,
        a wrong option and an output that cannot be written end the stage; of two of these the first item's is
        raised, whichever came first.

    Returns
    -------
    dict
        Item → result, in the items' order, without those skipped.
    """
    results: dict[T, R] = {}
    with ThreadPoolExecutor(threads) as pool:
        try:
            futures = _submit(pool, work, items)
            for future in as_completed(list(futures)):
                item = futures.pop(future)
                result = None
                try:
                    results[item] = result = future.result()
                except _FATAL as error:
                    pool.shutdown(wait=True, cancel_futures=True)
                    raise _first_told(futures, items, {item: error}) from None
                except ColmapSphError as error:
                    skip(item, str(error))
                except (MemoryError, cv2.error) as error:
                    told = refusal_of(error)
                    if told is None:
                        raise
                    skip(item, str(told))
                # Nothing may keep a future: with its exception it keeps all arrays of the item that failed.
                del future
                advance(result)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return {item: results[item] for item in items if item in results}


def _first_told(futures: dict[Future[R], T], items: Sequence[T], told: dict[T, BaseException]) -> BaseException:
    """Of what ends a stage the error of the first item: items begin in their order, so it is always the same."""
    for future, item in futures.items():
        error = None if future.cancelled() else future.exception()
        if isinstance(error, _FATAL):
            told[item] = error
    return next(told[item] for item in items if item in told)


def refusal_of(error: BaseException) -> OutOfMemoryError | None:
    """What a user is told of memory or a thread that was refused, by Python or by OpenCV; None of other errors."""
    if isinstance(error, RuntimeError):
        # Python's own words, and those of C++'s libraries: no memory for its stack, or a limit on threads
        is_thread = "start new thread" in str(error) or "temporarily unavailable" in str(error)
        return OutOfMemoryError(_NO_THREAD) if is_thread else None
    if isinstance(error, MemoryError) or (isinstance(error, cv2.error) and error.code == cv2.Error.StsNoMem):
        return OutOfMemoryError()
    return None


@contextmanager
def room_for_workers() -> Iterator[None]:
    """Our workers are the threads; OpenCV's own would fight them for the cores. They keep the memory they free."""
    keep_freed_memory()
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _submit(pool: ThreadPoolExecutor, work: Callable[[T], R], items: Sequence[T]) -> dict[Future[R], T]:
    try:
        return {pool.submit(work, item): item for item in items}
    except RuntimeError as error:
        told = refusal_of(error)
        if told is None:
            raise
        raise told from error
