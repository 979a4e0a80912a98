"""Figures of a view's depth: the vote of its pairs, and what its neighbours confirm."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Patch
from numpy.typing import NDArray

from algorithm_figures.demo import Demo
from algorithm_figures.drawing import faded, masked, save, show
from colmap_sph.stereo.confirm import ConfirmOptions, confirm_depth
from colmap_sph.stereo.search.seeds import finer_first, shared_points
from colmap_sph.stereo.vote import VoteOptions, depth_candidates, right_disparity

NAME = "F_1.jpg"

Float = NDArray[np.float32]


def _candidates(demo: Demo, name: str, options: VoteOptions) -> tuple[list[str], Float, Float]:
    """Partners in the order in which they vote, and depth and sigma (n, H, W) of their pairs."""
    view = demo.scene.view(name)
    others = []
    depths, sigmas = [], []
    for first, second in demo.selection.unique_pairs():
        if name not in (first, second):
            continue
        views = demo.scene.view(first), demo.scene.view(second)
        finer, coarser = finer_first(shared_points(demo.scene, *views), *views)
        pair = demo.rectified(finer.name, coarser.name).as_voter
        is_left = finer.name == name
        disparity = pair.disparity if is_left else right_disparity(pair, options.max_disparity_step)
        depth, sigma = depth_candidates(view, disparity, pair.geometry, "left" if is_left else "right", options)
        others.append(coarser.name if is_left else finer.name)
        depths.append(depth)
        sigmas.append(sigma)
    return others, np.stack(depths), np.stack(sigmas)


def _agree(depth: Float, sigma: Float, tolerance: float) -> NDArray[np.bool_]:
    """(n, n): which candidates of a pixel agree."""
    return np.asarray(np.abs(depth[:, None] - depth) <= tolerance * np.hypot(sigma[:, None], sigma))


def _draw_ray(axes: Any, names: list[str], depth: Float, sigma: Float, voted: float, exact: float) -> None:
    """The candidates along one ray, the cluster among them, and what came of it."""
    there = depth > 0
    names, depth, sigma = [n for n, t in zip(names, there, strict=True) if t], depth[there], sigma[there]
    order = np.argsort(depth)
    agreement = _agree(depth, sigma, VoteOptions().tolerance)
    counts = agreement.sum(axis=1)
    centre = np.lexsort((sigma, -counts))[0]
    for place, k in enumerate(order):
        colour = "tab:blue" if agreement[centre, k] else "0.6"
        axes.errorbar(depth[k], place, xerr=3 * sigma[k], fmt="o", color=colour, markersize=4, capsize=2)
        if k == centre:
            axes.plot(depth[k], place, "o", markersize=9, markerfacecolor="none", markeredgecolor="tab:blue")
    axes.axvline(exact, color="tab:green", linewidth=1.2)
    axes.axvline(voted, color="tab:red", linewidth=1.2, linestyle="--")
    axes.set_yticks(range(len(order)), [names[k].removesuffix(".jpg") for k in order])
    axes.set_ylim(-0.8, len(order) - 0.2)


def _telling_pixels(
    depths: Float, sigmas: Float, exact: Float, support: NDArray[np.uint8]
) -> list[tuple[int, int]]:
    """A pixel where most candidates agree, and one where a cluster outvotes more that agree less."""
    wrong = (depths > 0) & (np.abs(depths - exact) > 6 * sigmas)
    outliers = wrong.sum(axis=0)
    tolerance = VoteOptions().tolerance
    agreeing = [
        ((depths > 0) & (np.abs(depths - depth) <= tolerance * np.hypot(sigmas, sigma))).sum(axis=0)
        for depth, sigma in zip(depths, sigmas, strict=True)
    ]
    rivals = np.where(wrong, np.stack(agreeing), 0).max(axis=0)
    inliers = ((depths > 0) & (np.abs(depths - exact) <= 3 * sigmas)).sum(axis=0)
    spread = np.where(depths > 0, np.abs(depths - exact) / np.maximum(exact, 1), 0).max(axis=0)
    inner = np.zeros(exact.shape, bool)
    inner[40:-40, 40:-40] = True
    calm = inner & (support == inliers) & (outliers == 0)
    torn = inner & (support == inliers) & (inliers >= 3) & (rivals < inliers) & (spread < 0.25)
    scores = np.where(calm, inliers, 0), np.where(torn, 100 * outliers + inliers, 0)
    places = (np.unravel_index(int(np.argmax(score)), score.shape) for score in scores)
    return [(int(row), int(column)) for row, column in places]


def vote(demo: Demo, path: Path) -> None:
    """Candidates along two rays, and how many pairs agree everywhere."""
    names, depths, sigmas = _candidates(demo, NAME, VoteOptions())
    voted = demo.voted(NAME)
    exact, _ = demo.truth(NAME)
    pixels = _telling_pixels(depths, sigmas, exact, voted.support)
    figure = plt.figure(figsize=(9.6, 6.6), layout="constrained")
    above, below = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=(1, 1.05))))
    panels = above.subplots(1, 2)
    support = masked(voted.support, voted.depth > 0)
    bounds = np.arange(1, voted.support.max() + 2)
    colours = plt.get_cmap("viridis", len(bounds) - 1)
    drawn = show(
        panels[0], support, f"pairs that agree, {NAME}", cmap=colours, norm=BoundaryNorm(bounds - 0.5, colours.N)
    )
    above.colorbar(drawn, ax=panels[0], shrink=0.8, ticks=bounds[:-1:2])
    gsd = exact / demo.scene.view(NAME).K[0, 0]
    error = np.abs(voted.depth - exact) / np.maximum(gsd, 1e-9)
    drawn = show(
        panels[1],
        masked(error, (voted.depth > 0) & (exact > 0)),
        "difference of the voted depth from the exact one",
        cmap="magma_r",
        vmin=0,
        vmax=4,
    )
    above.colorbar(drawn, ax=panels[1], shrink=0.8, extend="max", label="[pixels on the ground]")
    for axes, letter, (row, column) in zip(below.subplots(1, 2), "AB", pixels, strict=True):
        for panel in panels:
            panel.plot(
                column, row, "o", markersize=8, markerfacecolor="none", markeredgecolor="red", markeredgewidth=2
            )
            panel.annotate(letter, (column + 12, row - 10), color="red", weight="bold", fontsize=12)
        ray = (depths[:, row, column], sigmas[:, row, column])
        _draw_ray(axes, names, *ray, float(voted.depth[row, column]), float(exact[row, column]))
        axes.set_title(f"candidates along the ray of pixel {letter}")
        axes.set_xlabel("depth [m], bars: 3 standard deviations")
        axes.plot([], [], "o", color="tab:blue", label="cluster")
        axes.plot([], [], "o", markersize=9, color="tab:blue", markerfacecolor="none", label="its centre")
        axes.plot([], [], "o", color="0.6", label="outvoted")
        axes.plot([], [], "--", color="tab:red", label="voted")
        axes.plot([], [], "-", color="tab:green", label="exact")
    below.axes[1].legend(loc="upper left")
    save(figure, path)


_REASONS = {
    "confirmed": "#d9e6d3",
    "too few partners agree": "#4477aa",
    "too many look through it": "#cc3311",
    "few agree, little surface around": "#ee9933",
    "no photometric depth": "#ffffff",
}


def _why_dropped(demo: Demo, name: str) -> NDArray[np.uint8]:
    """Index into `_REASONS` of each pixel: the first gate that stops it."""
    view = demo.scene.view(name)
    estimate = demo.voted(name)
    partners = demo.matched_with(name)
    others = [(demo.scene.view(partner), demo.voted(partner)) for partner in partners]
    usual = ConfirmOptions()
    gates = [
        replace(usual, max_contradiction=1e9, min_surface=0.0),
        replace(usual, min_surface=0.0),
        usual,
    ]
    reason = np.zeros(estimate.depth.shape, np.uint8)
    for number, gate in enumerate(gates, start=1):
        kept = confirm_depth(view, estimate, others, gate).depth > 0
        reason[(reason == 0) & ~kept] = number
    reason[estimate.depth == 0] = 4
    return reason


def confirmation(demo: Demo, path: Path) -> None:
    """What the neighbours confirm of a voted depth map, what they drop, and whether that was wrong."""
    voted = demo.voted(NAME)
    exact, _ = demo.truth(NAME)
    reason = _why_dropped(demo, NAME)
    gsd = exact / demo.scene.view(NAME).K[0, 0]
    wrong = (np.abs(voted.depth - exact) > 2 * gsd) & (exact > 0) & (voted.depth > 0)
    figure, panels = plt.subplots(2, 2, figsize=(9.6, 7.2), layout="constrained")
    low, high = np.percentile(exact[exact > 0], (1, 99))
    for axes, kept, title in (
        (panels[0, 0], voted.depth > 0, "voted (photometric) depth"),
        (panels[0, 1], reason == 0, "confirmed (geometric) depth"),
    ):
        drawn = show(
            axes, masked(voted.depth, kept), f"{title}: {kept.mean():.1%}", cmap="viridis_r", vmin=low, vmax=high
        )
    figure.colorbar(drawn, ax=panels[0], shrink=0.8, label="depth [m]")
    show(
        panels[1, 0],
        reason,
        "why a depth was dropped",
        cmap=ListedColormap(list(_REASONS.values())),
        vmin=0,
        vmax=4,
    )
    handles = []
    for number, (words, colour) in enumerate(_REASONS.items()):
        here = reason == number
        share = f", {wrong[here].mean():.0%} wrong" if number < 4 and here.any() else ""
        label = f"{words}: {here.mean():.1%}{share}"
        handles.append(Patch(facecolor=colour, edgecolor="0.5", linewidth=0.5, label=label))
    picture = faded(demo.picture(NAME), 0.6)
    picture[wrong & (reason > 0)] = (70, 140, 60)
    picture[wrong & (reason == 0)] = (220, 20, 20)
    show(panels[1, 1], picture, "depths that are wrong by more than 2 pixels on the ground")
    marks = [Patch(color="#468c3c", label="dropped"), Patch(color="#dc1414", label="confirmed all the same")]
    panels[1, 0].legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.02), fontsize=8)
    panels[1, 1].legend(handles=marks, loc="upper center", bbox_to_anchor=(0.5, -0.02), fontsize=8, ncols=2)
    save(figure, path)
