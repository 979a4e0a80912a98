"""Views that stand side by side → stations, each of which counts once.

Two frames of a hovering drone see the same from the same place: they are matched with the same images, make the
same mistakes, and confirm each other. To a third view they are one witness, not two. So views are of one *station*
where their baseline subtends, at what that third view sees, less than the angle under which a pair is worth
matching, and where they look the same way: cameras of a rig that look apart have different pictures of what they
share.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.frusta import points_in_view

# Points that tell the angles of a view; so large a share of them must see two views as one (the angle of a pair is
# the 75th percentile, too).
_MAX_POINTS = 64
_MOST = 0.75
# Views look the same way where their axes are less than 30 degrees apart.
_SAME_WAY = 0.866

OWN_STATION = 0
"""Number of the station of the view that looks."""


class StationCounter:
    """Numbers the stations of views, one after the other, as one view sees them.

    Parameters
    ----------
    points : (n, 3) float64 ndarray
        What the view sees, world frame.
    view : View
        The view itself: the first of station `OWN_STATION`.
    least_angle : float
        Degrees; views nearer to each other than this are of one station.
    """

    def __init__(self, points: NDArray[np.float64], view: View, least_angle: float) -> None:
        self._points = points[:: -(-len(points) // _MAX_POINTS) or 1]
        self._cosine = float(np.cos(np.radians(least_angle)))
        self._firsts = self._rays(view)[None]
        self._axes = [view.viewing_direction]

    def number(self, view: View) -> int:
        """Return the station of a view: the first one whose first view is near enough, or a new one."""
        rays = self._rays(view)
        count = len(self._axes)
        cosines = np.einsum("kpi,pi->kp", self._firsts[:count], rays)
        is_near = np.count_nonzero(cosines > self._cosine, axis=1) >= max(_MOST * len(rays), 1)
        is_one = is_near & (np.array(self._axes) @ view.viewing_direction > _SAME_WAY)
        if is_one.any():
            return int(np.argmax(is_one))
        if count == len(self._firsts):
            self._firsts = np.concatenate([self._firsts, np.empty_like(self._firsts)])
        self._firsts[count] = rays
        self._axes.append(view.viewing_direction)
        return count

    def is_new(self, view: View) -> bool:
        """Whether a view stands where none stood before; from then on one does."""
        before = len(self._axes)
        return self.number(view) == before

    def _rays(self, view: View) -> NDArray[np.float64]:
        rays = self._points - view.center
        with np.errstate(invalid="ignore", divide="ignore"):  # a point at the centre is near to nothing
            return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


class Stations:
    """Tells which views count as one, for each view of a scene; may be used by several threads.

    Parameters
    ----------
    scene : Scene
    least_angle : float
        Degrees; views nearer to each other than this are of one station.
    """

    def __init__(self, scene: Scene, least_angle: float) -> None:
        self._scene = scene
        self._least_angle = least_angle

    @cached_property
    def _points_in_view(self) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]]:
        points, observed, _ = points_in_view(self._scene)
        return points, observed

    def numbers(self, name: str, others: Sequence[str]) -> list[int]:
        """Number the stations of views as one view sees them.

        Parameters
        ----------
        name : str
            The view that looks.
        others : sequence of str
            Views that overlap it. The first of a station stands for it.

        Returns
        -------
        list of int
            For each of them its station, from 1 in the order of their first views; `OWN_STATION` for those that
            stand where the view itself does. Where all do, each is a station of its own: there is nothing better.
        """
        index = self._scene.index_of[name]
        points, observed = self._points_in_view
        stations = StationCounter(points[observed[index]], self._scene.views[index], self._least_angle)
        found = [stations.number(self._scene.view(other)) for other in others]
        return found if any(found) else list(range(1, 1 + len(found)))

    def elsewhere(self, name: str, others: Sequence[str]) -> tuple[list[str], list[int]]:
        """Those of the others that stand elsewhere, and their stations' numbers, which ascend; see `numbers`."""
        names, numbers = by_station(others, self.numbers(name, others))
        own = numbers.count(OWN_STATION)
        return names[own:], numbers[own:]


def by_station(names: Sequence[str], numbers: Sequence[int]) -> tuple[list[str], list[int]]:
    """Names and numbers sorted by station; within one they keep their order."""
    order = sorted(range(len(names)), key=numbers.__getitem__)
    return [names[k] for k in order], [numbers[k] for k in order]
