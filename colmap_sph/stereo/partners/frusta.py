"""What views would see: sample points stand in for a model's tracks where it has none.

Where the model has points (without tracks), these are projected into the views. Where it has none, the depth
of the scene is unknown, and all that poses tell is how far views that look the same way are apart.
Photographers choose that distance so that images overlap: for overlaps of 60 to 90 % the scene lies 2 to 10
of these distances away. So every view's frustum is sampled at a few multiples of that distance,
and whoever sees most of each other's samples overlaps most. Occlusion is not considered.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Photograph, Scene, View

# Depths of the samples in units of the distance to the neighbours, and samples per side of an image.
_DEPTHS = (2.0, 4.0, 8.0)
_SAMPLES_PER_SIDE = 6
# A neighbour looks less than 45° away; the distance is the median over the nearest few.
_COS_SAME_WAY = 0.707
_NUM_NEIGHBOURS = 4
_NUM_NEAREST = 64
# Samples that a view is tested against come from so many views that look nearest to where it looks.
_NUM_TESTED = 256
_MAX_POINTS = 20_000
# Points that a view has in sight, where all see much of the scene: more only where all views together have no more
# than the latter. So many views tell how many each has.
_LEAST_IN_VIEW = 512
_IN_VIEW_OF_ALL = 1 << 24
_NUM_ASKED = 64
# Points that lie beside each other are asked together first, so many at most.
_BLOCK_POINTS = 64

Sights = tuple[NDArray[np.float64], list[NDArray[np.int64]]]
"""(N, 3) points, world frame, and for every view the ascending rows of those that it has in view."""


def _once(find: Callable[[Scene], Sights]) -> Callable[[Scene], Sights]:
    """The same function, which remembers what it found as long as the scene is there; nobody may change it."""
    known: WeakKeyDictionary[Scene, Sights] = WeakKeyDictionary()

    @wraps(find)
    def found(scene: Scene) -> Sights:
        sights = known.get(scene)
        if sights is None:
            sights = known[scene] = find(scene)
        return sights

    return found


def points_in_view(scene: Scene) -> tuple[NDArray[np.float64], list[NDArray[np.int64]], bool]:
    """Find what each view sees: the points that it observes, or where none observes any, what its frustum holds.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    points : (N, 3) float64 ndarray
        World frame: the scene's, or samples of the frusta.
    observed : list of (n,) int64 ndarray
        For every view the ascending rows of `points` that it observes or has in view.
    has_tracks : bool
        Whether the views observe them.
    """
    finite = np.asarray(np.isfinite(scene.points).all(axis=1))
    posed = [bool(np.isfinite(view.cam_from_world).all()) for view in scene.views]
    all_finite = bool(finite.all())
    observed = [
        (view.point_indices if all_finite else view.point_indices[finite[view.point_indices]])
        if good
        else np.empty(0, np.int64)
        for view, good in zip(scene.views, posed, strict=True)
    ]
    if any(len(indices) for indices in observed):
        return scene.points, observed, True
    return *likely_in_view(scene), False


def likely_in_view(scene: Scene, fewest: int = 0) -> Sights:
    """What each view's frustum holds of the scene's points or, where there are none, of samples of the frusta.

    Parameters
    ----------
    scene : Scene
    fewest : int
        Where views (the median) hold fewer points than so many, samples serve, too.

    Returns
    -------
    points, observed
        As of `points_in_view`.
    """
    points, in_view = observe_points(scene)
    if len(points) and (not fewest or np.median([len(rows) for rows in in_view]) >= fewest):
        return points, in_view
    return observe_frusta(scene)


@_once
def observe_points(scene: Scene) -> Sights:
    """Project a scene's finite points into all views.

    Of many points every n-th is used, in such a way that all views use the same: the more seldom, the more points
    all views together have in sight.

    Returns
    -------
    points, observed
        As of `points_in_view`.
    """
    points = scene.points[np.isfinite(scene.points).all(axis=1)]
    step = -(-len(points) // _MAX_POINTS) or 1
    views = scene.views
    most = max(_LEAST_IN_VIEW, _IN_VIEW_OF_ALL // max(len(views), 1))
    if len(points) // step > most:
        asked = views[:: -(-len(views) // _NUM_ASKED)]
        seen = np.mean([np.count_nonzero(sees(view, points[::step])) for view in asked])
        step *= -(-int(seen) // most) or 1
    rows = np.arange(0, len(points), step, dtype=np.int64)
    used = points[rows]
    blocks = _Blocks(used)
    near = (blocks.near(view) for view in views)
    return points, [rows[few[sees(view, used[few])]] for view, few in zip(views, near, strict=True)]


class _Blocks:
    """Points in blocks of such that lie beside each other: few blocks are near what a view has in sight.

    Parameters
    ----------
    points : (N, 3) float64 ndarray
        Finite.
    """

    def __init__(self, points: NDArray[np.float64]) -> None:
        self._rows = list(_halved(points, np.arange(len(points))))
        ends = np.array([(points[rows].min(axis=0), points[rows].max(axis=0)) for rows in self._rows])
        low, high = np.moveaxis(ends.reshape(-1, 2, 3), 1, 0)
        self._middles = (low + high) / 2
        # Half their diagonals, and some more for what is lost in rounding.
        self._radii = 0.501 * np.linalg.norm(high - low, axis=1) + 1e-9 * np.abs(points).max(initial=0.0)

    def near(self, view: View) -> NDArray[np.int64]:
        """Ascending rows of all points that a view has in sight, and some more."""
        across, down, depth = view.K @ view.cam_from_world
        inside = np.array([depth, across, down, view.width * depth - across, view.height * depth - down])
        with np.errstate(invalid="ignore", over="ignore"):  # of impossible poses
            reach = np.linalg.norm(inside[:, :3], axis=1)[:, None] * self._radii
            near = (inside[:, :3] @ self._middles.T + inside[:, 3:] >= -reach).all(axis=0)
        found = [self._rows[block] for block in np.flatnonzero(near)]
        return np.sort(np.concatenate([*found, np.empty(0, np.int64)]))


def _halved(points: NDArray[np.float64], rows: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Halves of rows of points across where these reach farthest, again and again, until few are left."""
    if len(rows) <= _BLOCK_POINTS:
        yield from [rows] if len(rows) else []
        return
    along = points[rows, int(np.ptp(points[rows], axis=0).argmax())]
    order = rows[np.argpartition(along, len(rows) // 2)]
    yield from _halved(points, order[: len(rows) // 2])
    yield from _halved(points, order[len(rows) // 2 :])


@_once
def observe_frusta(scene: Scene) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]]:
    """Sample the viewing frusta.

    Returns
    -------
    points : (N, 3) float64 ndarray
        Samples of all frusta in the world frame.
    observed : list of (n,) int64 ndarray
        For every view the ascending rows of `points` inside its frustum; empty for a pose that is not finite.
    """
    count = _SAMPLES_PER_SIDE**2
    posed = [i for i, view in enumerate(scene.views) if np.isfinite(view.cam_from_world).all()]
    observed: list[list[NDArray[np.int64]]] = [[] for _ in scene.views]
    if len(posed) < 2:
        return np.empty((0, 3)), [np.empty(0, np.int64) for _ in scene.views]
    views = [scene.views[i] for i in posed]
    centers = np.array([view.center for view in views])
    directions = np.array([view.viewing_direction for view in views])
    distances = _neighbour_distances(centers, directions)
    points: list[NDArray[np.float64]] = []
    for depth in _DEPTHS:
        first = len(points) * count
        samples = [_sample(view, depth * d) for view, d in zip(views, distances, strict=True)]
        block = np.array(samples)
        points = points + samples
        targets = centers + depth * distances[:, None] * directions
        nearest = _nearest(targets, _NUM_TESTED)[1]
        for k, i in enumerate(posed):
            tested = np.sort(nearest[k])
            rows = (tested[:, None] * count + np.arange(count)).ravel()
            observed[i].append(first + rows[sees(views[k], block[tested].reshape(-1, 3))])
    return np.concatenate(points), [np.concatenate([*rows, np.empty(0, np.int64)]) for rows in observed]


def _neighbour_distances(centers: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return every view's typical distance to its neighbours that look the same way, as a (V,) array."""
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    distances, nearest = _nearest(centers, _NUM_NEAREST)
    same_way = np.einsum("ij,ikj->ik", directions, directions[nearest]) > _COS_SAME_WAY
    # Cameras of one rig, or images of one tripod, have no distance that tells anything.
    apart = distances > 1e-3 * extent
    typical = np.full(len(centers), np.nan)
    for i in range(len(centers)):
        for usable in (apart[i] & same_way[i], apart[i]):
            if usable.any():
                typical[i] = np.median(distances[i][usable][:_NUM_NEIGHBOURS])
                break
    return np.asarray(np.nan_to_num(typical, nan=max(extent, 1.0)), dtype=np.float64)


def _nearest(points: NDArray[np.float64], most: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Distances and rows of up to so many points nearest to each of (n, 3) points, itself first."""
    from scipy.spatial import cKDTree  # which takes long to load, and models with tracks do not need it

    distances, rows = cKDTree(points).query(points, k=min(most, len(points)))
    return distances, rows


def _sample(view: View, depth: float) -> NDArray[np.float64]:
    """Return an even grid of the view's pixels at one depth as (n, 3) points in the world frame."""
    steps = (np.arange(_SAMPLES_PER_SIDE) + 0.5) / _SAMPLES_PER_SIDE
    u, v = np.meshgrid(steps * view.width, steps * view.height)
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    rays = pixels @ view.inverse_K.T
    return np.asarray((depth * rays - view.t) @ view.R)


def seen_by(views: Sequence[View], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(V, N) bool: which of (N, 3) points each view has in its image, as `sees` has it."""
    rotations = np.array([view.R.T for view in views])
    calibrations = np.array([view.K.T for view in views])
    camera = points @ rotations + np.array([view.t for view in views])[:, None]
    x, y, w = np.moveaxis(camera @ calibrations, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        x, y = x / w, y / w
    widths, heights = np.array([(view.width, view.height) for view in views]).T[..., None]
    return np.asarray((camera[..., 2] > 0) & (x > 0) & (y > 0) & (x < widths) & (y < heights))


def any_sees(photograph: View | Photograph, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of (N, 3) points lie in any view of a photograph, see `sees`."""
    return np.asarray(np.any([sees(view, points) for view in photograph.views], axis=0))


def sees(view: View, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of (N, 3) points lie before the camera and inside its image; occlusion is not considered.

    The image ends at the outer edges of its pixels: a point is seen wherever in a pixel it lies.
    """
    pixels, depth = view.project(points)
    x, y = pixels.T
    return np.asarray((depth > 0) & (x > 0) & (y > 0) & (x < view.width) & (y < view.height))
