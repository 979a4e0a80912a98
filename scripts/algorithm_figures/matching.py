"""Figures of the matching of one rectified pair."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from algorithm_figures.demo import Demo, MatchedPair
from algorithm_figures.drawing import save, show
from colmap_sph import _native
from colmap_sph.stereo.kernels import backend

NEAR, WIDE = ("N_0_1.jpg", "N_0_2.jpg"), ("N_0_2.jpg", "R_1.jpg")


@dataclass(frozen=True, eq=False)
class Level:
    """What the matcher's kernels were given and found at one level of the pyramid.

    Attributes
    ----------
    prediction : offset that each pixel is expected to have, 1/256 pixel of the level
    margin : columns of the warped right image before the first pixel's expected one
    warped : grey values of the warped right image
    left, right : census words, those of the right image warped
    base : first offset that each pixel searches in the warped image, pixels
    surface : the same as aggregation sees it
    image, p1, p2, max_slant : what aggregation takes
    depth : offsets searched per pixel
    offset : what came out, in the warped image, 1/256 pixel
    """

    prediction: NDArray[np.int32]
    margin: int
    warped: NDArray[np.float32]
    left: NDArray[np.uint64]
    right: NDArray[np.uint64]
    base: NDArray[np.int32]
    surface: NDArray[np.int32]
    image: NDArray[np.uint8]
    p1: int
    p2: NDArray[np.uint8]
    max_slant: int
    depth: int
    offset: NDArray[np.int32]

    def disparity(self, row: int, column: int, offset: NDArray[Any]) -> NDArray[np.float64]:
        """Disparities, pixels, of a pixel's offsets in the warped image, pixels."""
        residual = offset - self.margin
        predicted = np.interp(column + residual, np.arange(self.prediction.shape[1]), self.prediction[row])
        return np.asarray(-residual - predicted / 256)

    def searched(self, row: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least and largest disparity, pixels, that each pixel of a row searches."""
        ends = np.array([self.depth - 1, 0])
        reach = [self.disparity(row, column, base + ends) for column, base in enumerate(self.base[row])]
        return np.min(reach, axis=1), np.max(reach, axis=1)


@contextmanager
def recorded() -> Iterator[list[Level]]:
    """Record every level that is matched meanwhile, the coarsest first."""
    levels: list[Level] = []
    predicted: list[tuple[NDArray[np.int32], int, NDArray[np.float32]]] = []
    match, warp = _native.match, _native.warp

    def warp_and_record(*arguments: Any) -> None:
        warp(*arguments)
        predicted.append((arguments[2].copy(), arguments[3], arguments[4].copy()))

    def match_and_record(*arguments: Any) -> None:
        match(*arguments)
        _, left, right, _, _, base, surface, image, p1, p2, max_slant, *_, scratch, offset = arguments
        images = left.copy(), right.copy(), base.copy(), surface.copy(), image.copy()
        # A level whose images are not stretched against each other is not warped.
        how = (np.zeros(base.shape, np.int32), 0, np.empty((0, 0), np.float32))
        if predicted and predicted[-1][0].shape == base.shape:
            how = predicted[-1]
        levels.append(Level(*how, *images, p1, p2.copy(), max_slant, scratch.shape[-1], offset.copy()))

    with mock.patch.multiple(_native, match=match_and_record, warp=warp_and_record):
        yield levels


def matched(demo: Demo, names: tuple[str, str]) -> tuple[MatchedPair, list[Level]]:
    """A pair, and how it was matched."""
    pair = demo.rectified(*names)
    with recorded() as levels:
        assert pair.disparity.size
    return pair, levels


def _costs(level: Level) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Raw and aggregated costs (H, W, depth)."""
    cost = np.empty((*level.base.shape, level.depth), np.uint8)
    aggregated = np.empty_like(cost)
    _native.matching_cost(backend(), level.left, level.right, level.base, cost)
    arguments = (level.surface, level.image, level.p1, level.p2, level.max_slant)
    _native.aggregation(backend(), cost, *arguments, np.empty_like(cost), aggregated)
    return cost, aggregated


def _telling_pixel(cost: NDArray[np.uint8], wrong: NDArray[np.float64]) -> tuple[int, int]:
    """A pixel that is right although other disparities cost less: (row, column)."""
    best = cost.min(axis=2).astype(int)
    at = np.clip(np.rint(wrong).astype(int), 0, cost.shape[2] - 1)
    excess = np.take_along_axis(cost, at[..., None], axis=2)[..., 0] - best
    rivals = (cost <= best[..., None] + 2).sum(axis=2)
    score = np.where((at > 6) & (at < cost.shape[2] - 7), 10 * excess + rivals, -1)
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    return int(row), int(column)


def matching(demo: Demo, path: Path) -> None:
    """Left image, disparity and its error; the costs of one pixel."""
    pair, levels = matched(demo, NEAR)
    finest = levels[-1]
    disparity = pair.disparity
    exact = demo.exact_disparity(pair)
    error = np.abs(disparity - exact)
    figure = plt.figure(figsize=(9.6, 5.4), layout="constrained")
    above, below = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=(1.1, 1))))
    panels = above.subplots(1, 3)
    grey = np.where(pair.left_image.valid > 0, pair.left_image.image, 255)
    show(panels[0], grey, f"{NEAR[0]}, rectified with {NEAR[1]}", cmap="gray", vmin=0, vmax=255)
    drawn = show(panels[1], disparity, "disparity, white = none", cmap="turbo")
    above.colorbar(drawn, ax=panels[1], shrink=0.7, label="[pixels]")
    drawn = show(panels[2], error, "difference from exact disparity", cmap="magma_r", vmin=0, vmax=2)
    above.colorbar(drawn, ax=panels[2], shrink=0.7, label="[pixels]", extend="max")

    cost, aggregated = _costs(finest)
    slot = -exact - finest.prediction / 256 + finest.margin - finest.base
    good = (error < 0.1) & np.isfinite(exact)
    good[:, : good.shape[1] // 4] = good[:, -good.shape[1] // 4 :] = False
    row, column = _telling_pixel(cost, np.where(good, slot, -1))
    for panel in panels:
        panel.plot(
            column, row, "o", markersize=9, markerfacecolor="none", markeredgecolor="tab:red", markeredgewidth=2
        )
    searched = finest.disparity(row, column, finest.base[row, column] + np.arange(finest.depth))
    truth, found = exact[row, column], disparity[row, column]
    panels = below.subplots(1, 3)
    for axes, values, title in (
        (panels[0], cost[row, column], "raw costs of the marked pixel"),
        (panels[1], aggregated[row, column], "after aggregation along 8 paths"),
    ):
        axes.plot(searched, values, ".-", color="0.35", linewidth=0.8)
        axes.plot(searched[values.argmin()], values.min(), "o", color="tab:red", label="least")
        axes.axvline(truth, color="tab:green", linewidth=1, label="exact")
        axes.set(xlabel="disparity [pixels]", ylabel="cost [bits]")
        axes.set_title(title)
    panels[1].set_ylabel("half of the sum [bits]")
    panels[0].legend(loc="upper left", bbox_to_anchor=(0, 1.02), handlelength=1)
    panels[0].set_ylim(0, 80)
    _draw_fit(panels[2], finest, row, column, truth, found)
    save(figure, path)


def _draw_fit(axes: Any, level: Level, row: int, column: int, truth: float, found: float) -> None:
    """The V of raw costs, summed over 5 x 5 pixels around each column of the warped image beside the plane."""
    whole = int(np.rint(level.offset[row, column] / 256))
    shifts = np.arange(-2, 3)
    sums = []
    for shift in shifts:
        total = 0
        for y in range(row - 2, row + 3):
            for x in range(column - 2, column + 3):
                offset = level.offset[y, x]
                # Along the surface: each pixel from its own whole offset.
                own = round(offset / 256) if offset > -(1 << 24) else whole
                own = own if abs(own - whole) <= 2 else whole
                total += (int(level.left[y, x]) ^ int(level.right[y, x + own + shift])).bit_count()
        sums.append(total)
    axes.plot(level.disparity(row, column, whole + shifts), sums, ".-", color="0.35", linewidth=0.8)
    axes.axvline(truth, color="tab:green", linewidth=1, label=f"exact {truth:.2f}")
    axes.axvline(found, color="tab:red", linewidth=1, linestyle="--", label=f"fitted {found:.2f}")
    axes.set(xlabel="disparity [pixels]", ylabel="sum of 25 raw costs [bits]")
    axes.set_title("raw costs of 5 x 5 pixels on the plane")
    axes.legend(loc="lower left")
    axes.set_ylim(0, 1.1 * max(sums))


def search_ranges(demo: Demo, path: Path) -> None:
    """What one row searches at each level of the pyramid."""
    pair, levels = matched(demo, WIDE)
    exact = demo.exact_disparity(pair)
    row = int(0.34 * pair.geometry.height)
    figure = plt.figure(figsize=(9.6, 4.8), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(1, 4.2))
    strip, axes = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    width = pair.geometry.left_width
    part = slice(row - 40, row + 40)
    grey = np.where(pair.left_image.valid[part] > 0, pair.left_image.image[part], 255)
    title = f"{WIDE[0]}, rectified with {WIDE[1]}: 80 rows around row {row} (red)"
    show(strip, grey, title, cmap="gray", aspect="auto")
    strip.axhline(40, color="tab:red", linewidth=1.5)
    colours = ("#dbe9f6", "#a5cde3", "#5ba3cf", "#2171b5", "#08306b")
    for number, level in enumerate(levels):
        step = 2 ** (len(levels) - 1 - number)
        low, high = level.searched(row // step)
        axes.fill_between(
            (np.arange(len(low)) + 0.5) * step,
            low * step,
            high * step,
            step="mid",
            color=colours[number * (len(colours) - 1) // max(len(levels) - 1, 1)] if number else colours[0],
            alpha=0.75,
            linewidth=0,
            label=f"level {len(levels) - 1 - number}: {level.depth} disparities of {step} pixel{'s' * (step > 1)}",
        )
    axes.plot(np.arange(width), exact[row], color="#ffd21f", linewidth=2.2, label="exact")
    axes.plot(np.arange(width), pair.disparity[row], ".", color="tab:red", markersize=2.5, label="found")
    axes.set(xlabel="column of the left rectified image", ylabel="disparity [pixels]", xlim=(0, width))
    axes.set_ylim(-300, 700)
    step = 2 ** (len(levels) - 1)
    low, high = levels[0].searched(row // step)
    axes.annotate(
        f"level {len(levels) - 1} reaches from {low.min() * step:.0f} to {high.max() * step:.0f}", (12, 650)
    )
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    strip.set_xlim(0, width)
    save(figure, path)


def warping(demo: Demo, path: Path) -> None:
    """A part of the left image, what the right one shows of it, and that as it is warped for the finest level."""
    pair, levels = matched(demo, WIDE)
    finest = levels[-1]
    rows = _around(0.73 * pair.geometry.height, 80)
    middle = 0.46 * pair.geometry.left_width
    columns = _around(middle, 120)
    expected = finest.prediction[rows, columns] / 256
    seen = _around(middle + float(expected.mean()), 120)
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 2.45), layout="constrained")
    for panel, picture, title in (
        (axes[0], pair.left_image.image[rows, columns], f"left: {WIDE[0]}"),
        (axes[1], pair.right_image.image[rows, seen], f"right: {WIDE[1]}"),
        (
            axes[2],
            finest.warped[rows, columns.start + finest.margin : columns.stop + finest.margin],
            "right, warped",
        ),
    ):
        show(panel, picture, title, cmap="gray", vmin=0, vmax=255)
    save(figure, path)


def _around(middle: float, reach: int) -> slice:
    return slice(round(middle) - reach, round(middle) + reach)
