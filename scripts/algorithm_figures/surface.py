"""Figures of planes and points: normals, refinement, fusion."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch
from numpy.typing import NDArray

from algorithm_figures.demo import Demo
from algorithm_figures.drawing import faded, masked, save, show
from colmap_sph.scene import POINT
from colmap_sph.stereo.confirm import ConfirmOptions, confirm_depth
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.fusion import FusionOptions, ViewMaps, fuse_view
from colmap_sph.stereo.normals import NormalOptions, fit_normals
from colmap_sph.stereo.partners.pairs import overlapping_views
from colmap_sph.stereo.refinement import RefinementOptions, refine_maps

NAME = "F_1.jpg"

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]


def _confirmed(demo: Demo, name: str) -> DepthEstimate:
    partners = demo.matched_with(name)
    others = [(demo.scene.view(partner), demo.voted(partner)) for partner in partners]
    return confirm_depth(demo.scene.view(name), demo.voted(name), others, ConfirmOptions())


def _refined(demo: Demo, name: str, estimate: DepthEstimate, planes: Maps) -> Maps:
    view = demo.scene.view(name)
    grey = cv2.IMREAD_GRAYSCALE
    images = {
        other.name: np.asarray(cv2.imread(str(demo.workspace.image_path(other.name)), grey), np.uint8)
        for other in demo.scene.views
    }
    partners = demo.matched_with(name)
    sources = [(demo.scene.view(partner), images[partner]) for partner in partners]
    normals, depth = (plane.copy() for plane in planes)
    return refine_maps(view, images[name], estimate, normals, depth, sources, RefinementOptions())


def _normal_picture(normals: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Red right, green up, blue towards the camera; white where there is none."""
    picture: NDArray[np.uint8] = np.clip(127.5 + 127.5 * normals * (1, -1, -1), 0, 255).astype(np.uint8)
    picture[~normals.any(axis=-1)] = 255
    return picture


def _angular_error(normals: NDArray[np.float32], exact: NDArray[np.float32]) -> NDArray[np.float64]:
    own, other = normals.astype(float), exact.astype(float)
    sine = np.linalg.norm(np.cross(own, other), axis=-1)
    return np.asarray(np.degrees(np.arctan2(sine, (own * other).sum(axis=-1))))


def _weights(estimate: DepthEstimate, row: int, column: int, options: NormalOptions) -> NDArray[np.float64]:
    """Weights of a pixel's window in the last of the three rounds of `fit_normals`, worked out anew."""
    reach = np.arange(-options.radius, options.radius + 1)
    window = estimate.depth[row + reach[:, None], column + reach].astype(float)
    centre = float(estimate.depth[row, column])
    there = window > 0
    relative = centre / np.where(there, window, np.inf) - 1
    noise = options.tolerance * estimate.sigma[row, column] / centre
    falloff = (1 - (reach / (options.radius + 1)) ** 2) ** 2
    near = np.outer(falloff, falloff) * there
    y, x = np.meshgrid(reach, reach, indexing="ij")
    terms = np.stack([np.ones_like(x), x, y]).reshape(3, -1)
    plane = np.zeros(3)
    weights = near
    for widening in (1 + options.radius, 2, 1):
        residual = relative - (plane @ terms).reshape(relative.shape)
        weights = near / (1 + (residual / (noise * widening)) ** 2) ** 2
        plane = np.linalg.solve((terms * weights.ravel()) @ terms.T, (terms * weights.ravel()) @ relative.ravel())
    return np.asarray(weights)


# A column down a roof and a wall to the ground, and a pixel at the eaves, where roof and wall meet.
_COLUMN = 190
_ROWS = slice(292, 352)
_EAVES = 314


def _draw_profile(
    axes: Any, estimate: DepthEstimate, fitted: NDArray[np.float32], exact: NDArray[np.float32]
) -> None:
    """Inverse depth along a part of one column."""
    rows = np.arange(_ROWS.start, _ROWS.stop)
    raw, sigma, planes = (values[_ROWS, _COLUMN] for values in (estimate.depth, estimate.sigma, fitted))
    there, kept = raw > 0, planes > 0
    axes.plot(rows, 1000 / exact[_ROWS, _COLUMN], color="tab:green", linewidth=1, label="exact")
    bars = 1000 * sigma[there] / raw[there] ** 2
    style = {"fmt": ".", "color": "0.6", "markersize": 6, "linewidth": 0.8}
    axes.errorbar(rows[there], 1000 / raw[there], yerr=bars, label="confirmed, ± σ", **style)
    axes.plot(rows[kept], 1000 / planes[kept], ".", color="tab:red", markersize=3, label="on its plane")
    axes.axvline(_EAVES, color="tab:blue", linewidth=0.8, linestyle=":")
    axes.set(xlabel="row", ylabel="1000 / depth [1/m]")
    axes.set_title(f"inverse depth along the red line (column {_COLUMN})")
    axes.legend(loc="lower left")


def normals(demo: Demo, path: Path) -> None:
    """Planes fitted to a confirmed depth map."""
    view = demo.scene.view(NAME)
    exact, exact_normals = demo.truth(NAME)
    estimate = _confirmed(demo, NAME)
    planes, fitted = fit_normals(view, estimate, NormalOptions())
    figure, panels = plt.subplots(2, 2, figsize=(9.6, 6.8), layout="constrained", height_ratios=(1.1, 1))
    show(panels[0, 0], _normal_picture(planes), "normals of the fitted planes, white = none")
    error = _angular_error(planes, exact_normals)
    there = (fitted > 0) & (exact > 0)
    title = f"angle to the exact normals, median {np.median(error[there]):.1f}°"
    drawn = show(panels[0, 1], masked(error, there), title, cmap="magma_r", vmin=0, vmax=20)
    figure.colorbar(drawn, ax=panels[0, 1], shrink=0.8, extend="max", label="[degrees]")
    for axes in panels[0]:
        axes.plot([_COLUMN, _COLUMN], [_ROWS.start, _ROWS.stop], color="red", linewidth=1.5)
    _draw_profile(panels[1, 0], estimate, fitted, exact)
    radius = NormalOptions().radius
    part = (_COLUMN - 16.5, _COLUMN + 16.5, _EAVES + 12.5, _EAVES - 12.5)
    crop = demo.picture(NAME)[_EAVES - 12 : _EAVES + 13, _COLUMN - 16 : _COLUMN + 17]
    panels[1, 1].imshow(faded(crop, 0.8), extent=part)
    box = (_COLUMN - radius - 0.5, _COLUMN + radius + 0.5, _EAVES + radius + 0.5, _EAVES - radius - 0.5)
    weights = _weights(estimate, _EAVES, _COLUMN, NormalOptions())
    drawn = panels[1, 1].imshow(weights, extent=box, cmap="Blues", vmin=0)
    panels[1, 1].plot(_COLUMN, _EAVES, "+", color="tab:red", markersize=10)
    panels[1, 1].set(xlim=part[:2], ylim=part[2:], xlabel="column", ylabel="row")
    panels[1, 1].set_title("weights of the window of a pixel at the eaves")
    figure.colorbar(drawn, ax=panels[1, 1], shrink=0.8, label="weight")
    save(figure, path)


def refinement(demo: Demo, path: Path) -> None:
    """Normals and depth before and after the refinement on all images."""
    view = demo.scene.view(NAME)
    exact, exact_normals = demo.truth(NAME)
    estimate = _confirmed(demo, NAME)
    before = fit_normals(view, estimate, NormalOptions())
    after = _refined(demo, NAME, estimate, before)
    there = (before[1] > 0) & (after[1] > 0) & (exact > 0)
    gsd = exact / view.K[0, 0]
    figure = plt.figure(figsize=(9.6, 6.2), layout="constrained")
    above, below = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=(1.15, 1))))
    top = above.subplots(1, 2)
    angles, shifts = [], []
    part = np.s_[150:390, 130:450]
    for axes, (planes, depth), title in zip(top, (before, after), ("before", "after"), strict=True):
        angle = _angular_error(planes, exact_normals)
        angles.append(angle[there])
        shifts.append((np.abs(depth - exact) / gsd)[there])
        words = f"{title}: angle to the exact normals (a part of {NAME})"
        drawn = show(axes, masked(angle, there)[part], words, cmap="magma_r", vmin=0, vmax=15)
    above.colorbar(drawn, ax=list(top), shrink=0.85, extend="max", label="[degrees]")
    left, right = below.subplots(1, 2)
    for axes, values, most, label, median_of in (
        (left, angles, 20, "angle to the exact normal [degrees]", "{:.1f}°"),
        (right, shifts, 1.0, "difference from exact depth [pixels on the ground]", "{:.3f} pixels"),
    ):
        for numbers, title, colour in zip(values, ("before", "after"), ("0.55", "tab:red"), strict=True):
            words = f"{title}: median {median_of.format(np.median(numbers))}"
            axes.plot(*_cumulative(numbers, most), color=colour, label=words)
        axes.set(xlabel=label, ylabel="share of the pixels below", xlim=(0, most), ylim=(0, 1))
        axes.grid(color="0.9")
        axes.legend(loc="lower right")
    save(figure, path)


def _cumulative(values: NDArray[np.float64], most: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    places = np.linspace(0, most, 200)
    return places, np.searchsorted(np.sort(values), places) / len(values)


def _view_maps(demo: Demo, name: str) -> ViewMaps:
    index = {image_id: number for number, image_id in enumerate(demo.scene.image_ids)}
    view = demo.scene.view(name)
    depth, planes = demo.maps(name, "geometric")
    image = np.ascontiguousarray(demo.picture(name)[..., ::-1])
    return ViewMaps(view, index[view.image_id], depth, np.ascontiguousarray(planes.transpose(2, 0, 1)), image)


def _pixels_of_points(demo: Demo, name: str, options: FusionOptions) -> NDArray[np.bool_]:
    """Which pixels of a view become points."""
    view = demo.scene.view(name)
    others = overlapping_views(demo.scene, 50)[name]
    partners = (_view_maps(demo, other) for other in others)
    made = np.zeros((view.height, view.width), bool)
    for points, _ in fuse_view(_view_maps(demo, name), partners, options):
        camera = points["xyz"].astype(float) @ view.R.T + view.t
        pixel = camera @ view.K.T
        columns, rows = np.rint(pixel[:, :2] / pixel[:, 2:]).astype(int).T
        made[rows, columns] = True
    return made


def _sources_of_points(demo: Demo) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """The points of the demo's cloud, and for each the place among the images of the one that made it."""
    path = demo.workspace.fused_path
    content = path.read_bytes()
    start = content.index(b"end_header\n") + len(b"end_header\n")
    points = np.frombuffer(content, POINT, offset=start)
    words = np.fromfile(path.with_name("fused.ply.vis"), "<u4")[2:]
    return points, np.fromiter(_first_images(words, len(points)), np.int64, len(points))


def _first_images(words: NDArray[np.uint32], count: int) -> Iterator[int]:
    """A point's own image is the first that its entry names, behind their number."""
    position = 0
    plain = words.tolist()
    for _ in range(count):
        yield plain[position + 1]
        position += 1 + plain[position]


_FATES = {
    "became a point": "#7fbf7b",
    "a finer pixel covers it": "#fdb863",
    "no other image agrees": "#d7301f",
    "no depth": "#ffffff",
}


def fusion(demo: Demo, path: Path) -> None:
    """Which pixels of one image become points, and which image made each point of the cloud."""
    depth, _ = demo.maps(NAME, "geometric")
    points = _pixels_of_points(demo, NAME, FusionOptions())
    uncovered = _pixels_of_points(demo, NAME, FusionOptions(min_num_pixels=1))
    fate = np.full(depth.shape, 1, np.uint8)
    fate[points], fate[uncovered & ~points], fate[depth == 0] = 0, 2, 3
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 5.4), layout="constrained", width_ratios=(1.15, 1))
    shade = demo.picture(NAME).mean(axis=-1, keepdims=True) / 255
    colours = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in _FATES.values()])
    show(
        left,
        (colours[fate] * np.where(fate[..., None] == 3, 1, 0.55 + 0.45 * shade)).astype(np.uint8),
        f"the pixels of {NAME}",
    )
    marks = [
        Patch(facecolor=colour, edgecolor="0.5", label=f"{words}: {(fate == number).mean():.1%}")
        for number, (words, colour) in enumerate(_FATES.items())
    ]
    left.legend(handles=marks, loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=2, fontsize=8)
    cloud, source = _sources_of_points(demo)
    _draw_sources(right, demo, cloud, source)
    save(figure, path)


def _draw_sources(axes: Any, demo: Demo, cloud: NDArray[np.void], source: NDArray[np.int64]) -> None:
    """The cloud from above, the highest points on top, in the colour of the camera that made each."""
    kinds = {"N": "vertical", "F": "looks north", "B": "looks south", "L": "looks west", "R": "looks east"}
    palette = ("#9e9e9e", "#1b9e77", "#d95f02", "#7570b3", "#e7298a")
    name_of = {view.image_id: view.name for view in demo.scene.views}
    kind_of = np.array([list(kinds).index(name_of[image_id][0]) for image_id in demo.scene.image_ids])
    kind = kind_of[source]
    cells = 420
    extent = 60.0
    column, row = np.floor((cloud["xyz"][:, :2] / extent + 1) / 2 * cells).astype(int).T
    inside = (column >= 0) & (column < cells) & (row >= 0) & (row < cells)
    order = np.flatnonzero(inside)[np.argsort(cloud["xyz"][inside, 2], kind="stable")]
    picture = np.full((cells, cells), -1)
    picture[row[order], column[order]] = kind[order]
    box = (-extent, extent, -extent, extent)
    cmap = ListedColormap(list(palette))
    axes.imshow(masked(picture, picture >= 0), cmap=cmap, vmin=0, vmax=4, origin="lower", extent=box)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_title("the cloud from above: which camera made each point")
    marks = [
        Patch(color=colour, label=f"{words}: {(kind == number).mean():.0%}")
        for number, (words, colour) in enumerate(zip(kinds.values(), palette, strict=True))
    ]
    axes.figure.legend(handles=marks, loc="outside lower right", ncols=3, fontsize=8)
