"""Figures of what comes before matching: the sparse model, partners, rectification."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from algorithm_figures.demo import Demo, MatchedPair
from algorithm_figures.drawing import LINES, faded, save, show
from colmap_sph.scene import View
from colmap_sph.stereo.partners.partner_choice import worth_of
from colmap_sph.stereo.rectification import RectificationOptions
from colmap_sph.stereo.rectified_pair import Side, pixel_from_rectified_ray

Float = NDArray[np.float64]


def pixels_of(view: View, points: Float) -> tuple[Float, Float]:
    """Pixels (n, 2) and depths (n,) of world points."""
    camera = points @ view.R.T + view.t
    pixel = camera @ view.K.T
    return pixel[:, :2] / pixel[:, 2:], camera[:, 2]


def from_above(demo: Demo, places: Float) -> Float:
    """x and y (n, 2) of places in the scene's frame, in that of the block."""
    return np.asarray(places + demo.scene.anchor)[..., :2]


def _draw_cameras(axes: Any, demo: Demo, marked: dict[str, str]) -> None:
    for view in demo.scene.views:
        colour = marked.get(view.name, "0.6")
        place = from_above(demo, view.center)
        ahead = view.viewing_direction[:2]
        axes.plot(*place, "s", color=colour, markersize=6)
        if np.linalg.norm(ahead) > 0.1:
            axes.annotate(
                "", place + 22 * ahead, place, arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 1}
            )


def sparse_model(demo: Demo, path: Path) -> None:
    """What the method starts from."""
    view = demo.scene.view("F_1.jpg")
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.6), layout="constrained")
    points = demo.scene.points[view.point_indices]
    pixels, depths = pixels_of(view, points)
    show(left, faded(demo.picture(view.name), 0.55), f"{view.name} and the sparse points that it observes")
    drawn = left.scatter(*pixels.T, c=depths, s=3, cmap="viridis_r", linewidths=0)
    figure.colorbar(drawn, ax=left, shrink=0.8, label="depth [m]")
    right.scatter(*from_above(demo, demo.scene.points[::3]).T, s=1, color="0.75", linewidths=0)
    _draw_cameras(right, demo, {view.name: "tab:red"})
    right.annotate(view.name, np.add(from_above(demo, view.center), (-12, -17)), color="tab:red")
    right.set_ylim(-125, 110)
    right.set_aspect("equal")
    right.set(xlabel="x [m]", ylabel="y [m]")
    right.set_title("the block from above: cameras, where they look, sparse points")
    save(figure, path)


def _need(demo: Demo, view: View, partners: list[str]) -> Float:
    """What is left of the worth of a view's points, as `partner_choice.choose` counts it."""
    points = demo.scene.points[view.point_indices]
    need = np.ones(len(view.point_indices))
    for name in partners:
        partner = demo.scene.view(name)
        observed = np.isin(view.point_indices, partner.point_indices)
        need *= 1 - 0.8 * worth_of(view, [partner], points, observed[None])[0]
    return need


def partners(demo: Demo, path: Path) -> None:
    """The choice of partners, and what it is for."""
    name = "N_0_0.jpg"
    view = demo.scene.view(name)
    chosen = demo.selection.partners[name]
    shared = {
        other.name: len(np.intersect1d(view.point_indices, other.point_indices))
        for other in demo.scene.views
        if other.name != name
    }
    most_shared = sorted(shared, key=lambda other: -shared[other])
    figure = plt.figure(figsize=(9.6, 6.0), layout="constrained")
    above, below = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=(1.15, 1))))
    plan, worth = above.subplots(1, 2)
    panels = below.subplots(1, 3)
    _draw_cameras(plan, demo, {name: "tab:red"} | {partner.name: "tab:blue" for partner in chosen})
    for number, partner in enumerate(chosen, start=1):
        place = from_above(demo, demo.scene.view(partner.name).center)
        plan.annotate(str(number), np.add(place, (3, 4)), color="tab:blue", weight="bold")
    plan.annotate(name, np.add(from_above(demo, view.center), (-58, -4)), color="tab:red")
    plan.set_aspect("equal")
    plan.set(xlabel="x [m]", ylabel="y [m]")
    plan.set_title(f"partners of {name} in the order of their choice")
    worth.plot([0, 6, 40, 70], [0, 1, 1, 0], color="black")
    for number, partner in enumerate(chosen, start=1):
        height = float(np.interp(partner.angle, (0, 6, 40, 70), (0, 1, 1, 0)))
        worth.plot(partner.angle, height, "o", color="tab:blue", markersize=4)
        offset = 0.05 + 0.07 * sum(abs(other.angle - partner.angle) < 1.5 for other in chosen[: number - 1])
        worth.annotate(str(number), (partner.angle, height + offset), color="tab:blue", ha="center")
    worth.set(xlabel="parallax angle [degrees]", ylabel="worth of a point", xlim=(0, 75), ylim=(0, 1.4))
    worth.set_title("what a parallax angle is worth")
    picture = faded(demo.picture(name), 0.5)
    pixels, _ = pixels_of(view, demo.scene.points[view.point_indices])
    names = [partner.name for partner in chosen]
    steps = (
        (names[:1], "after the first partner"),
        (names[:3], "after three"),
        (most_shared[:3], "after the three that share most points"),
    )
    for axes, (some, title) in zip(panels, steps, strict=True):
        need = _need(demo, view, some)
        show(axes, picture, f"{title}:\nmean need {need.mean():.2f}")
        drawn = axes.scatter(*pixels.T, c=need, s=5, cmap="plasma", vmin=0, vmax=1, linewidths=0)
    below.colorbar(drawn, ax=list(panels), shrink=0.8, label="need that is left", aspect=12)
    save(figure, path)


def _row_line(view: View, pair: MatchedPair, row: float) -> Float:
    """Pixels of a view along one epipolar plane; NaN outside the image."""
    geometry = pair.geometry
    across = (row + geometry.row_origin) / geometry.rows_per_radian
    along = np.linspace(-1.45, 1.45, 4000)
    rays = np.stack([np.sin(along), np.cos(along) * np.sin(across), np.cos(along) * np.cos(across)], axis=1)
    pixel = rays @ pixel_from_rectified_ray(view, geometry).T
    line = pixel[:, :2] / pixel[:, 2:]
    outside = (pixel[:, 2] <= 0) | (line < 0).any(axis=1) | (line > [view.width, view.height]).any(axis=1)
    line[outside] = np.nan
    return line


def _sphere_sketch(axes: Any) -> None:
    """The two centres, one epipolar plane, and the sphere around the baseline."""
    λ, θ = np.meshgrid(np.radians(np.linspace(-42, 42, 9)), np.radians(np.linspace(-62, 62, 60)))
    x, y, z = np.sin(θ), np.cos(θ) * np.sin(λ), np.cos(θ) * np.cos(λ)
    for k in range(λ.shape[1]):
        axes.plot(x[:, k], y[:, k], z[:, k], color=LINES[0] if k == 6 else "0.75", linewidth=2 if k == 6 else 0.8)
    for step in np.radians(np.linspace(-60, 60, 7)):
        arc = np.radians(np.linspace(-42, 42, 30))
        ring = np.full(30, np.sin(step)), np.cos(step) * np.sin(arc), np.cos(step) * np.cos(arc)
        axes.plot(*ring, color="0.75", linewidth=0.8)
    axes.plot([-1.3, 1.9], [0, 0], [0, 0], color="black", linewidth=1.2)
    tilt = np.radians(21)
    point = np.array([0.55, 1.5 * np.sin(tilt), 1.5 * np.cos(tilt)])
    right = np.array([0.9, 0, 0])
    for start, name in ((np.zeros(3), "left centre"), (right, "right centre")):
        axes.plot(*zip(start, point, strict=True), color=LINES[0], linewidth=1.2)
        axes.scatter(*start, color="black", s=18)
        axes.text(start[0] - 0.25, start[1] - 0.1, start[2] - 0.28, name, fontsize=8)
    axes.scatter(*point, color=LINES[0], s=18)
    axes.text(*np.add(point, (0, 0, 0.12)), "point", fontsize=8)
    axes.text(-1.55, 0.1, 0.95, "a row (λ)", fontsize=8, color=LINES[0])
    axes.text(0.95, -0.7, 0.62, "a column (θ)", fontsize=8, color="0.4")
    axes.text(1.35, 0, -0.3, "baseline", fontsize=8)
    axes.view_init(elev=28, azim=-66)
    axes.set_box_aspect((3.2, 1.6, 1.9), zoom=1.55)
    axes.set_axis_off()


def rectification(demo: Demo, path: Path) -> None:
    """A pair, its epipolar lines, and its rectified images."""
    pair = demo.rectified("N_0_2.jpg", "R_1.jpg")
    rows = np.linspace(0.14, 0.86, len(LINES)) * pair.geometry.height
    figure = plt.figure(figsize=(9.2, 6.3), layout="constrained")
    grid = figure.add_gridspec(2, 12, height_ratios=(1, 1.25))
    _sphere_sketch(figure.add_subplot(grid[0, 8:], projection="3d"))
    figure.axes[0].set_title("one epipolar plane on the sphere")
    for k, view in enumerate((pair.left, pair.right)):
        axes = figure.add_subplot(grid[0, 4 * k : 4 * k + 4])
        show(axes, demo.picture(view.name), f"{view.name} ({'left' if k == 0 else 'right'})")
        for row, colour in zip(rows, LINES, strict=True):
            axes.plot(*_row_line(view, pair, row).T, color=colour, linewidth=1.4)
    sides: tuple[Side, Side] = ("left", "right")
    for k, (side, image) in enumerate(zip(sides, (pair.left_image, pair.right_image), strict=True)):
        axes = figure.add_subplot(grid[1, 6 * k : 6 * k + 6])
        grey = np.where(image.valid > 0, image.image, 255)
        show(
            axes,
            grey,
            f"{side}, rectified: {grey.shape[1]} x {grey.shape[0]} pixels",
            cmap="gray",
            vmin=0,
            vmax=255,
        )
        for row, colour in zip(rows, LINES, strict=True):
            axes.axhline(row, color=colour, linewidth=1.2)
    save(figure, path)


def plane(demo: Demo, path: Path) -> None:
    """The same pairs on the sphere and on the plane, in the same scale."""
    figure, axes = plt.subplots(2, 1, figsize=(9.6, 5.2), layout="constrained", height_ratios=(1.1, 1))
    for panel, names in zip(axes, (("N_0_2.jpg", "N_0_3.jpg"), ("F_1.jpg", "L_0.jpg")), strict=True):
        start = 0.0
        texts = []
        for model in ("spherical", "frame"):
            pair = demo.rectified(*names, RectificationOptions(model, columns="angles"))
            pixels = 0
            for image in (pair.left_image, pair.right_image):
                height, width = image.image.shape
                shown = np.where(image.valid > 0, image.image, 235)
                panel.imshow(shown, extent=(start, start + width, -height, 0), cmap="gray", vmin=0, vmax=255)
                panel.add_patch(
                    Rectangle((start, -height), width, height, fill=False, linewidth=1.2, edgecolor="tab:blue")
                    if model == "spherical"
                    else Rectangle((start, -height), width, height, fill=False, linewidth=1.2, edgecolor="tab:red")
                )
                start, pixels = start + width + 20, pixels + height * width
            start += 60
            texts.append(f"{'sphere' if model == 'spherical' else 'plane'} {pixels / 1e6:.2f} megapixels")
        panel.autoscale()
        panel.set_aspect("equal")
        panel.set_axis_off()
        panel.set_title(f"{names[0]} and {names[1]}: " + ", ".join(texts))
    save(figure, path)
