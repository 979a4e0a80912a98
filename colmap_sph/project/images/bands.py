"""The size of an image → its rows in bands, so that what is worked out of each takes little memory at a time."""

from collections.abc import Iterator


def in_bands(height: int, width: int, most: int) -> Iterator[slice]:
    """Rows of an image, from the top, in bands of at most `most` pixels, or one row."""
    step = max(most // width, 1)
    return (slice(first, min(first + step, height)) for first in range(0, height, step))
