"""Pairs of images, by name: who is whose partner."""

from collections.abc import Iterable

Pair = tuple[str, str]
"""Names of two images, sorted."""


def partners_of(pairs: Iterable[Pair]) -> dict[str, list[str]]:
    """Partners of each image, sorted."""
    partners: dict[str, list[str]] = {}
    for left, right in pairs:
        partners.setdefault(left, []).append(right)
        partners.setdefault(right, []).append(left)
    return {name: sorted(others) for name, others in partners.items()}


def pairs_by_image(pairs: Iterable[Pair]) -> dict[str, list[Pair]]:
    """Pairs of each image, sorted by the partner's name."""
    by_image: dict[str, list[Pair]] = {}
    for pair in pairs:
        for name in pair:
            by_image.setdefault(name, []).append(pair)
    return {name: sorted(own, key=lambda pair: [n for n in pair if n != name]) for name, own in by_image.items()}
