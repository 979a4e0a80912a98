"""Scene → what its photographs have in common: shared points and their parallax, as a graph of candidates.

Candidates share sparse points. Without tracks, or with few, the verified matches of COLMAP's database stand in for
these, and without matches the overlap of the viewing frusta.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Photograph, Scene
from colmap_sph.stereo.partners.frusta import likely_in_view, points_in_view
from colmap_sph.stereo.partners.observers import observers_of_points
from colmap_sph.stereo.partners.partner_choice import triangulation_angles, worth_of

if TYPE_CHECKING:
    from scipy.sparse import csr_array

logger = logging.getLogger(__name__)

CovisibilitySource = Literal["tracks", "database", "frusta"]
"""What tells which photographs see the same."""

# Points that tell a pair's angle and its worth.
_MAX_ANGLE_POINTS = 512
_MAX_WORTH_POINTS = 512
_ANGLE_PERCENTILE = 75
# Photographs that observe fewer points than this (in the median) share hardly any with others that show half of
# the same. Where views have not even so many points in their image, these do not tell who overlaps whom.
_ENOUGH_POINTS = 25
_FEW_POINTS = 8
# Sights of the points of a photograph, by itself and by others, that are counted: more only where there are so few
# photographs that those of all are no more than the latter.
_LEAST_SEEN = 1 << 19
_SEEN_IN_ALL = 1 << 31


class Covisibility:
    """Candidates of every photograph with the weight of each, angles and worth, which are computed when asked for.

    What it keeps grows with the number of observations, not with the square of that of photographs. Views that
    were cut from one photograph are one here. All others are photographs of their own.

    Parameters
    ----------
    photographs : sequence of Photograph
        V of them.
    source : "tracks", "database" or "frusta"
        What the weights rest on.
    points : (N, 3) float64 ndarray
        World frame: the scene's, or samples of the frusta.
    observed : list of (n,) int64 ndarray
        For every photograph the ascending rows of `points` that it observes or has in view.
    least : int
        What candidates share at least.
    matches : (V, V) sparse array of int, optional
        Verified matches, which are then what photographs share; None: the points.
    """

    def __init__(
        self,
        photographs: Sequence[Photograph],
        source: CovisibilitySource,
        points: NDArray[np.float64],
        observed: list[NDArray[np.int64]],
        least: int,
        matches: "csr_array | None" = None,
    ) -> None:
        self.photographs = photographs
        self.source = source
        self.centers = np.array([photograph.center for photograph in photographs])
        self._matches = matches
        self._least = least
        self._most_seen = max(_LEAST_SEEN, _SEEN_IN_ALL // max(len(photographs), 1))
        self._points = points
        self._observed = observed
        self._first, self._observers = observers_of_points(observed, len(points))
        self._place = np.full(len(observed), -1)
        self._entry = np.full(len(points), -1)

    def weights(self, i: int, others: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return what photograph `i` shares with each of (C,) others."""
        return np.asarray(self._shared(i)[others])

    def candidates(self, i: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the photographs that share something with `i`, most first, and how much it is."""
        shared = self._shared(i)
        views = np.flatnonzero(shared)
        views = views[np.argsort(-shared[views], kind="stable")]
        return views, np.asarray(shared[views])

    def _shared(self, i: int) -> NDArray[np.int64]:
        """What photograph `i` shares with each, 0 where that is too little.

        Where very many photographs have very many points in view, every n-th point stands for n.
        """
        if self._matches is not None:
            shared = self._matches[[i]].toarray()[0].astype(np.int64)
        else:
            rows = self._observed[i]
            step = -(-int((self._first[rows + 1] - self._first[rows]).sum()) // self._most_seen) or 1
            _, observers = self._observers_of(rows[::step])
            shared = step * np.bincount(observers, minlength=len(self._observed))
        shared[i] = 0
        shared[shared < self._least] = 0
        return np.asarray(shared, np.int64)

    def angles(self, i: int, others: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the parallax of photograph `i` with each of (C,) others, degrees; NaN without common points.

        It is the 75th percentile of the triangulation angles over an even part of the points that both see.
        """
        entry, place = self._seen_too(self._observed[i], others)
        by_view = np.argsort(place, kind="stable")  # within each view the points ascend
        rows, place = self._observed[i][entry[by_view]], place[by_view]
        counts = np.bincount(place, minlength=len(others))
        # Spread evenly over the points, whose order says nothing about where they are.
        within = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        kept = within % -(-np.maximum(counts, 1) // _MAX_ANGLE_POINTS)[place] == 0
        rows, place = rows[kept], place[kept]
        angles = triangulation_angles(self._points[rows], self.centers[i], self.centers[others][place])
        return _percentiles(angles, place, len(others))

    def seen_by(self, i: int) -> NDArray[np.float64]:
        """Return the (n, 3) points that photograph `i` observes or has in view."""
        return self._points[self._observed[i]]

    def worths(self, i: int, others: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return how well each of (C,) photographs would serve the points of `i`, or an even part of them."""
        rows = self._observed[i]
        rows = rows[:: -(-len(rows) // _MAX_WORTH_POINTS) or 1]
        believed: NDArray[Any]
        if self.source == "database":
            shared = self._shared(i)
            believed = (shared[others] / shared.max())[:, None]
        else:
            entry, place = self._seen_too(rows, others)
            believed = np.zeros((len(others), len(rows)), bool)
            believed[place, entry] = True
        candidates = [self.photographs[j] for j in others]
        return worth_of(self.photographs[i], candidates, self._points[rows], believed)

    def _seen_too(
        self, rows: NDArray[np.int64], others: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Find who else sees some points: entries in `rows`, ascending, and in `others`, one for each sight.

        By the observers of each point, or by the points of each other where these are fewer: for each of the
        others its entries ascend.
        """
        counts = np.array([len(self._observed[j]) for j in others], np.int64)
        if 0 < counts.sum() < (self._first[rows + 1] - self._first[rows]).sum():
            self._entry[rows] = np.arange(len(rows))
            entry = self._entry[np.concatenate([self._observed[j] for j in others])]
            place = np.repeat(np.arange(len(others)), counts)
            self._entry[rows] = -1
            return entry[entry >= 0], place[entry >= 0]
        self._place[others] = np.arange(len(others))
        entry, observers = self._observers_of(rows)
        place = self._place[observers]
        self._place[others] = -1
        return entry[place >= 0], place[place >= 0]

    def _observers_of(self, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Find who sees some points: entries in `rows`, ascending, and photographs, one for each sight."""
        counts = self._first[rows + 1] - self._first[rows]
        entry = np.repeat(np.arange(len(rows)), counts)
        behind = np.arange(len(entry)) - np.repeat(np.cumsum(counts) - counts, counts)
        return entry, self._observers[self._first[rows][entry] + behind]


def _percentiles(values: NDArray[np.float64], group: NDArray[np.int64], groups: int) -> NDArray[np.float64]:
    """The percentile of the values of each group, which lie together, as NumPy has it; NaN of an empty one."""
    values = values[np.lexsort((values, group))]
    counts = np.bincount(group, minlength=groups)
    result = np.full(groups, np.nan)
    some = np.flatnonzero(counts)
    first = (np.cumsum(counts) - counts)[some]
    place = (counts[some] - 1) * (_ANGLE_PERCENTILE / 100)
    below = np.floor(place).astype(np.int64)
    low, high = values[first + below], values[first + np.minimum(below + 1, counts[some] - 1)]
    share = place - below
    step = high - low
    result[some] = np.where(share >= 0.5, high - step * (1 - share), low + step * share)
    return result


def has_enough_tracks(scene: Scene) -> bool:
    """Whether photographs observe so many points that what two of them share tells how far they overlap."""
    counts = [sum(len(view.point_indices) for view in photograph.views) for photograph in scene.photographs]
    return bool(counts) and float(np.median(counts)) >= _ENOUGH_POINTS


def find_covisibility(
    scene: Scene, min_shared_points: int, matches: Mapping[tuple[str, str], int] | None
) -> Covisibility:
    """Find what photographs have in common: tracks, else verified matches, else what the frusta hold.

    Parameters
    ----------
    scene : Scene
    min_shared_points : int
        Least number of points, or matches, that two photographs must share to be candidates of each other.
    matches : mapping or None
        Names of two images → number of their verified matches; serves where the model has no or few tracks.

    Returns
    -------
    Covisibility
    """
    photographs = scene.photographs
    points, of_views, has_tracks = points_in_view(scene)
    if has_tracks and not has_enough_tracks(scene):
        has_tracks = False
        points, of_views = likely_in_view(scene, _FEW_POINTS)
    index_of = scene.index_of
    observed = [_together([of_views[index_of[view.name]] for view in each.views]) for each in photographs]
    if has_tracks:
        return Covisibility(photographs, "tracks", points, observed, min_shared_points)
    if matches is not None:
        counts = _match_counts(photographs, matches)
        if counts.nnz and counts.max() >= min_shared_points:
            return Covisibility(photographs, "database", points, observed, min_shared_points, counts)
        logger.warning("the database has no verified matches of the model's images")
    return Covisibility(photographs, "frusta", points, observed, 1)


def _together(observed: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """The ascending rows that any view of a photograph sees."""
    return observed[0] if len(observed) == 1 else np.unique(np.concatenate(observed))


def _match_counts(photographs: Sequence[Photograph], matches: Mapping[tuple[str, str], int]) -> "csr_array":
    """Numbers of verified matches between photographs, as a (V, V) matrix."""
    from scipy.sparse import csr_array  # which takes long to load

    index_of = {photograph.name: index for index, photograph in enumerate(photographs)}
    known = [
        (index_of[a], index_of[b], n)
        for (a, b), n in matches.items()
        if a in index_of and b in index_of and a != b
    ]
    first, second, counts = np.array(known, dtype=np.int64).reshape(-1, 3).T
    both = (np.tile(counts, 2), (np.concatenate([first, second]), np.concatenate([second, first])))
    return csr_array(both, shape=(len(photographs),) * 2)
