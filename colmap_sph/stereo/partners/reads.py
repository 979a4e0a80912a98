"""Orders of work on views that look at others → how much each has to load, and the one that loads least.

A cache of maps keeps what is needed next. Then how often maps must be loaded again depends on the order of
the work alone, and can be told before anything is loaded.
"""

import heapq
from collections.abc import Iterable, Mapping, Sequence

_NEVER = 1 << 62


def loads_in_order(
    order: Sequence[str],
    partners: Mapping[str, Sequence[str]],
    sizes: Mapping[str, float],
    capacity: float,
    limit: float = float("inf"),
) -> float:
    """Bytes to load in an order of work, by a cache that lets go first what is needed last.

    Parameters
    ----------
    order : sequence of str
        Views to work on.
    partners : mapping
        For each the others that it looks at.
    sizes : mapping of str to float
        Bytes of each view.
    capacity : float
        Bytes that the cache holds, but for the last one, which it always does.
    limit : float
        Once there are more, the rest does not count.

    Examples
    --------
    Three views in a row, of which the middle one looks at both, and room for two:

    >>> partners = {"a": ["b"], "b": ["a", "c"], "c": ["b"]}
    >>> sizes = dict.fromkeys("abc", 1.0)
    >>> [loads_in_order(order, partners, sizes, 2.0) for order in ("abc", "acb")]
    [3.0, 4.0]
    """
    asked = [name for item in order for name in (item, *partners.get(item, ()))]
    needed = _next_places(asked)
    kept: dict[str, int] = {}
    last: list[tuple[int, str]] = []
    held = 0.0
    loaded = 0.0
    for name, when in zip(asked, needed, strict=True):
        if name not in kept:
            loaded += sizes[name]
            held += sizes[name]
            if loaded > limit:
                break
        kept[name] = when
        heapq.heappush(last, (-when, name))
        while held > capacity and len(kept) > 1:
            held -= sizes[_evict(kept, last, but=name)]
    return loaded


def _next_places(asked: Sequence[str]) -> list[int]:
    """Where each of the names is asked for next."""
    next_of: dict[str, int] = {}
    needed = [_NEVER] * len(asked)
    for place in range(len(asked) - 1, -1, -1):
        needed[place] = next_of.get(asked[place], _NEVER)
        next_of[asked[place]] = place
    return needed


def _evict(kept: dict[str, int], last: list[tuple[int, str]], *, but: str) -> str:
    """Let go of what is needed last, but for one name; return which it was."""
    aside = []
    while True:
        when, name = heapq.heappop(last)
        if kept.get(name) != -when:
            continue  # was asked for again since, or is gone
        if name != but:
            break
        aside.append((when, name))
    for entry in aside:
        heapq.heappush(last, entry)
    del kept[name]
    return name


def best_order(
    orders: Iterable[Sequence[str]],
    partners: Mapping[str, Sequence[str]],
    sizes: Mapping[str, float],
    capacity: float,
) -> Sequence[str]:
    """The order in which least is loaded, of some with the same views; the first of equals."""
    least = float("inf")
    best: Sequence[str] = ()
    for order in orders:
        loaded = loads_in_order(order, partners, sizes, capacity, limit=least)
        if not best or loaded < least:
            least = loaded
            best = order
    return best
