"""How many levels a pair's pyramid has, and how many offsets their pixels search (see `offsets`)."""

STEP = 32
"""The number of offsets that a pixel searches is a multiple of this."""
MAX_DEPTH = 1024
"""And no larger."""
SPARE = 1
"""Offsets searched beyond either end of a range, so that a match at its end has neighbours to be fitted to."""

# Images of a level have no side shorter than this, and large ones have two levels above them at least: noise and
# gaps shrink, while the whole range may be short.
_LEAST_SIDE = 32
_LARGE_SIDE = 256
_LEVELS_OF_LARGE = 2


def num_levels(count: int, size: int, most: int) -> int:
    """Levels above full resolution: until the range is short, but never images under 32 pixels.

    Parameters
    ----------
    count : int
        Offsets to search at full resolution.
    size : int
        Shortest side of the two images, pixels.
    most : int
        Offsets to search at the coarsest level, at most.

    Returns
    -------
    int
        0: full resolution alone.
    """
    levels = 0
    while _with_spare(count >> levels) > most and (size >> levels) >= 2 * _LEAST_SIDE:
        levels += 1
    return max(levels, _LEVELS_OF_LARGE if size >= _LARGE_SIDE else 0)


def range_depth(low: int, high: int) -> int:
    """Number of offsets that search from `low` to `high`, as many as can be had."""
    return min(-(-_with_spare(high - low) // STEP) * STEP, MAX_DEPTH)


def _with_spare(span: int) -> int:
    """Offsets from the first to the last of a range, both counted, and those beyond either end."""
    return span + 1 + 2 * SPARE
