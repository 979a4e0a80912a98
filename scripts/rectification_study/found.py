"""What a pair finds of the surface that both of its images see, and how much of it is right, in their pixels.

Nothing here depends on how the pair was rectified, so that surfaces, samplings and programs compare.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View, pixel_transfer

Map = NDArray[np.float32]
Counts = dict[str, int]

COUNTED = ("seen", "found", "within_1_percent", "within_1_gsd", "within_1_pixel")
"""Pixels that both images see; of these, those with a depth; of these, those whose depth is right within 1 %,
within one GSD (depth / focal length), and whose place in the other image is within a pixel of the right one: the
disparity, in pixels of the other image."""
_SAME_SURFACE = 0.01


def seen_by_both(view: View, other: View, truth: Map, other_truth: Map) -> NDArray[np.bool_]:
    """Pixels of a view whose exact surface the other image sees.

    Parameters
    ----------
    view, other : View
    truth, other_truth : (H, W) float32 ndarray
        Exact z-depth at COLMAP's pixel origin; 0 = unknown, as it is at edges where it is made of that at centres.

    Returns
    -------
    (H, W) bool ndarray
        The surface's inverse depth lies, but for 1 %, between the least and the greatest of the four pixels of
        the other image around it. Pixels of unknown depth, and such around, do not count.
    """
    rows, columns = np.nonzero(truth > 0)
    x, y, depth = _places(view, other, columns, rows, truth[rows, columns])
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & (x >= 0) & (y >= 0) & (x < other.width - 1) & (y < other.height - 1)
    rows, columns = rows[inside], columns[inside]
    left, top = np.floor(x[inside]).astype(np.int64), np.floor(y[inside]).astype(np.int64)
    around = np.stack([other_truth[top + i, left + j] for i in (0, 1) for j in (0, 1)])
    nearest = np.where(around > 0, around, np.inf).min(axis=0)
    farthest = around.max(axis=0)
    same = (depth[inside] > nearest * (1 - _SAME_SURFACE)) & (depth[inside] < farthest * (1 + _SAME_SURFACE))
    seen = np.zeros(truth.shape, dtype=bool)
    seen[rows, columns] = same
    return seen


def count_found(view: View, other: View, depth: Map, truth: Map, seen: NDArray[np.bool_]) -> Counts:
    """Count what a pair finds for one of its images, see `COUNTED`.

    Parameters
    ----------
    view, other : View
    depth : (H, W) float32 ndarray
        The view's z-depth from the pair alone, at COLMAP's pixel origin; 0 = none.
    truth : (H, W) float32 ndarray
        Exact z-depth at the same places.
    seen : (H, W) bool ndarray
        See `seen_by_both`.

    Returns
    -------
    dict of int
    """
    rows, columns = np.nonzero(seen & (depth > 0))
    measured, exact = depth[rows, columns].astype(np.float64), truth[rows, columns].astype(np.float64)
    error = np.abs(measured / exact - 1)
    x, y, _ = _places(view, other, columns, rows, measured)
    x_exact, y_exact, _ = _places(view, other, columns, rows, exact)
    apart = np.hypot(x - x_exact, y - y_exact)
    numbers = (
        seen.sum(),
        len(rows),
        (error <= 0.01).sum(),
        (error * view.K[0, 0] <= 1).sum(),
        (apart <= 1).sum(),
    )
    return {name: int(number) for name, number in zip(COUNTED, numbers, strict=True)}


def count_pair(views: tuple[View, View], depths: tuple[Map, Map] | None, truths: tuple[Map, Map]) -> Counts:
    """Count what a pair finds for both of its images; nothing where it has no depths, as it was not rectified."""
    total = dict.fromkeys(COUNTED, 0)
    for one in (0, 1):
        view, other = views[one], views[1 - one]
        seen = seen_by_both(view, other, truths[one], truths[1 - one])
        depth = np.zeros_like(truths[one]) if depths is None else depths[one]
        counts = count_found(view, other, depth, truths[one], seen)
        total = {name: total[name] + counts[name] for name in COUNTED}
    return total


def summed(counts: Iterable[Mapping[str, int]]) -> Counts:
    """Sum over pairs."""
    every = list(counts)
    return {name: sum(one[name] for one in every) for name in COUNTED}


def shares(counts: Mapping[str, int]) -> dict[str, float]:
    """Found and right as shares of what both images see, and right as shares of what is found."""
    seen, found = max(counts["seen"], 1), max(counts["found"], 1)
    right = COUNTED[2:]
    result = {name: counts[name] / seen for name in COUNTED[1:]}
    return result | {f"{name}_of_found": counts[name] / found for name in right}


def share_cells(counts: Sequence[Mapping[str, Any]]) -> list[str]:
    """Cells of a table: found of seen; right within 1 %, 1 GSD and 1 pixel of found; sums of pairs."""
    share = shares(summed(counts))
    of_found = [share[f"{name}_of_found"] for name in COUNTED[2:]]
    return [f"{value:.3f}" for value in (share["found"], *of_found)]


def _places(
    view: View, other: View, columns: NDArray[np.int64], rows: NDArray[np.int64], depth: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Column, row and depth in the other image of pixels of a view at some depths."""
    transfer = pixel_transfer(view, other)
    pixels = np.stack([columns, rows, np.ones_like(columns)])
    x, y, z = transfer[:, :3] @ (pixels * depth) + transfer[:, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return x / z, y / z, z
