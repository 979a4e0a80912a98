"""Pairs of images, by name: who is whose partner."""

from collections.abc import Iterable

Pair = tuple[str, str]
"""Names of two images, sorted."""


def as_pair(first: str, second: str) -> Pair:
    """The pair of two images."""
    return (first, second) if first < second else (second, first)


def partners_of(pairs: Iterable[Pair]) -> dict[str, list[str]]:
    """Partners of each image, sorted."""
    partners: dict[str, list[str]] = {}
    for left, right in pairs:
        partners.setdefault(left, []).append(right)
        partners.setdefault(right, []).append(left)
    return {name: sorted(others) for name, others in partners.items()}
