"""Scene → the box that a surveyor would draw around its core, without the background far behind.

How well the images place a point is what tells the two apart: the horizon of a block, or what is far behind an
object or a façade, is seen by few images, coarsely, and under small angles. All three enter the standard deviation
of a point for a pixel of noise, which grows with the square of the distance.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, percent
from colmap_sph.scene import Region, Scene, View
from colmap_sph.stereo.partners.frusta import sees
from colmap_sph.stereo.region.inside import is_inside
from colmap_sph.stereo.region.vertical import east_north_up, upwards

# Points and views that are looked at, times each other, at most; and points at least and at most.
_MOST_SIGHTS = 40_000_000
_SOME_POINTS = (2_000, 20_000)
# With fewer points than this there is nothing to draw a box around.
_FEWEST_POINTS = 50
# Of an image that precision is typical which the better quarter of what it looks at has; of all images, that which
# the better three quarters of them have: where some come close to a detail, the others count. A few times worse
# still belongs to the core: that is twice the distance.
_TYPICAL = 0.25
_OF_IMAGES = 0.75
_WORSE = 4.0
# An image is looked at in so many rows and columns of parts.
_PARTS = 16
# The core stands out where it is the larger part of what images look at, or where less than this lies around its
# limit, within a factor; and where few images look elsewhere, with less than that of what they look at in the box.
_LEAST_SHARE = 0.5
_MOST_AROUND = 0.05
_AROUND = 2.0
_MOST_ELSEWHERE = 0.1
_ELSEWHERE = 0.1
# Where all rays to a point are nearly one line, so much less is known along it than across: it has no distance.
_NO_DISTANCE = 1e-9
# The box reaches from the one to the other percentile of the core's points, and beyond by this share of its
# longest side.
_PERCENTILES = (0.5, 99.5)
_BEYOND = 0.1
# A turned box is drawn where it is smaller than one along the model's axes by this factor.
_WORTH_TURNING = 0.8


def core_of(scene: Scene) -> Region:
    """Draw a box around what the images of a scene look at, and place well.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    Region
        A box in the scene's frame, which may be turned.

    Raises
    ------
    InputError
        There is no such box: no points, cameras in one place, or nothing that stands out.
    """
    sights = _sights(scene)
    looks = list(_looks(scene, sights))
    seen = np.unique(np.concatenate([look.rows for look in looks])) if looks else np.empty(0, np.int64)
    if len(seen) < _FEWEST_POINTS:
        raise InputError(
            f"--region auto needs sparse points that images see, and the model has {len(seen)}; triangulate more "
            "(colmap point_triangulator), or give a box as --region."
        )
    deviations = precision(scene.views, sights.points, sights.in_view)
    typical = np.sort([_quantile(deviations[look.rows], look.weights, _TYPICAL) for look in looks])
    limit = _WORSE * float(typical[int(_OF_IMAGES * (len(looks) - 1))])
    if not np.isfinite(limit):
        raise InputError(
            "--region auto finds no distances, as the cameras stand in one place; give a box as --region, or none."
        )
    region = _box_around(scene, sights.points[seen][deviations[seen] <= limit])
    if not np.ptp(region.box, axis=0).any():
        raise InputError("--region auto finds all sparse points in one place; give a box as --region, or none.")
    is_around = (deviations > limit / _AROUND) & (deviations < limit * _AROUND)
    _check_that_it_stands_out(looks, is_inside(region, sights.points), is_around)
    return region


def _check_that_it_stands_out(
    looks: "Sequence[_Look]", inside: NDArray[np.bool_], is_around: NDArray[np.bool_]
) -> None:
    """Refuse a box that cuts through what images look at, or that many do not look at."""
    shares = np.array([look.share(inside) for look in looks])
    around = np.mean([look.share(is_around) for look in looks])
    if shares.mean() < _LEAST_SHARE and around > _MOST_AROUND:
        raise InputError(
            f"--region auto finds nothing that stands out: what images place best is {percent(shares.mean(), 0)} "
            "of what they look at, and goes over into the rest; give a box as --region, or none."
        )
    elsewhere = float(np.mean(shares < _ELSEWHERE))
    if elsewhere > _MOST_ELSEWHERE:
        raise InputError(
            f"--region auto finds no common core: {percent(elsewhere, 0)} of the images look elsewhere than the "
            "others; give a box as --region, or none."
        )


@dataclass(frozen=True, eq=False)
class _Sights:
    """An even part of a scene's points, (n, 3), and which of its views have them in the image, (views, n)."""

    rows: NDArray[np.int64]
    points: NDArray[np.float64]
    in_view: NDArray[np.bool_]


def _sights(scene: Scene) -> _Sights:
    rows = np.flatnonzero(np.isfinite(scene.points).all(axis=1))
    wanted = int(np.clip(_MOST_SIGHTS / max(len(scene.views), 1), *_SOME_POINTS))
    rows = rows[:: max(-(-len(rows) // wanted), 1)]
    points = scene.points[rows]
    in_view = np.array([sees(view, points) for view in scene.views]).reshape(len(scene.views), len(points))
    return _Sights(rows, points, in_view)


def precision(
    views: Sequence[View], points: NDArray[np.float64], in_view: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Find how well views place points.

    Parameters
    ----------
    views : sequence of View
    points : (n, 3) float64 ndarray
    in_view : (views, n) bool ndarray
        Which views see which.

    Returns
    -------
    (n,) float64 ndarray
        Standard deviation along the direction in which a point is placed worst, model units, where each view
        measures it with a pixel's; infinite where all rays are nearly one line.
    """
    known = np.zeros((len(points), 3, 3))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for view, rows in zip(views, in_view, strict=True):
            rays = points[rows] - view.center
            distances = np.linalg.norm(rays, axis=1)[:, None, None]
            rays = rays[:, :, None] / distances
            known[rows] += (np.eye(3) - rays * rays.transpose(0, 2, 1)) * (view.K[0, 0] / distances) ** 2
    known[~np.isfinite(known).all(axis=(1, 2))] = 0  # in a camera's centre
    least, _, most = np.linalg.eigvalsh(known).T
    is_known = least > _NO_DISTANCE * most
    return np.where(is_known, 1 / np.sqrt(np.where(is_known, least, 1)), np.inf)


@dataclass(frozen=True, eq=False)
class _Look:
    """What an image looks at: rows of `_Sights.points`, and the weight of each; they sum up to 1."""

    rows: NDArray[np.int64]
    weights: NDArray[np.float64]

    def share(self, chosen: NDArray[np.bool_]) -> float:
        """Of what it looks at, how much some points are."""
        return float(self.weights[chosen[self.rows]].sum())


def _looks(scene: Scene, sights: _Sights) -> Iterator[_Look]:
    """What each image looks at that sees any point: its middle most, and its corners not at all.

    A part of an image counts as much as another, however many points it has.
    """
    position = np.full(len(scene.points), -1)
    position[sights.rows] = np.arange(len(sights.rows))
    for view, in_view in zip(scene.views, sights.in_view, strict=True):
        rows = np.flatnonzero(in_view)
        if scene.has_tracks:  # what is hidden is not looked at
            rows = np.intersect1d(rows, position[view.point_indices])
        pixels, _ = view.project(sights.points[rows])
        size = np.array([view.width, view.height])
        column, row = (pixels / size * _PARTS).astype(int).T
        part = row * _PARTS + column
        from_middle = np.linalg.norm((pixels - size / 2) / np.linalg.norm(size / 2), axis=1)
        weights = (1 - from_middle) ** 2 / np.bincount(part, minlength=1)[part]
        if weights.any():
            yield _Look(rows, weights / weights.sum())


def _quantile(values: NDArray[np.float64], weights: NDArray[np.float64], share: float) -> float:
    """The value that so large a share of the weights lies at or below."""
    order = np.argsort(values)
    summed = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(summed, share * summed[-1])])


def _box_around(scene: Scene, core: NDArray[np.float64]) -> Region:
    """A box along the model's axes; or where that is much larger, an upright one."""
    up = upwards(scene.views, core)
    if scene.origin.any():
        up = east_north_up(scene.origin, up)[2]
    axes = _upright_axes(core, up)
    plain = _reach(core)
    turned = _reach(core @ axes.T)
    if np.ptp(turned, axis=0).prod() > _WORTH_TURNING * np.ptp(plain, axis=0).prod():
        return Region(plain)
    return Region(turned, axes=axes)


def _upright_axes(core: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rotation, whose rows are the sides of the smallest upright box around points, the last of them up."""
    across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across /= np.linalg.norm(across)
    away = np.cross(up, across)
    angles = np.radians(np.arange(90))[:, None]
    first = np.cos(angles) * across + np.sin(angles) * away
    second = np.cos(angles) * away - np.sin(angles) * across
    areas = [np.ptp(_reach(core @ np.array(pair).T), axis=0).prod() for pair in zip(first, second, strict=True)]
    best = int(np.argmin(areas))
    return np.array([first[best], second[best], up])


def _reach(along: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, d) least and largest coordinates of a box around (n, d) points along its sides."""
    box = np.percentile(along, _PERCENTILES, axis=0)
    beyond = _BEYOND * float(np.ptp(box, axis=0).max())
    return np.stack([box[0] - beyond, box[1] + beyond])
