"""Photographs that were taken side by side → stations, each of which counts once.

Two frames of a hovering drone see the same from the same place: they are matched with the same images, make the
same mistakes, and confirm each other. To a third view they are one witness, not two. So views are of one *station*
where their baseline subtends, at what that third view sees, less than the angle under which a pair is worth
matching, and where they look the same way: cameras of a rig that look apart have different pictures of what they
share. Views that were cut from one photograph are one witness wherever they look.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Scene
from colmap_sph.stereo.partners.frusta import points_in_view

# Points that tell the angles of a view; so large a share of them must see two views as one (the angle of a pair is
# the 75th percentile, too).
_MAX_POINTS = 64
_MOST = 0.75
# Views that are numbered together.
_AT_A_TIME = 64
# Views look the same way where their axes are less than 30 degrees apart.
_SAME_WAY = 0.866

OWN_STATION = 0
"""Number of the station of the view that looks."""


class Standing(Protocol):
    """A view or a photograph: it stands somewhere, and looks somewhere; all around where its direction is zero."""

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) projection centre, world frame."""

    @property
    def viewing_direction(self) -> NDArray[np.float64]:
        """(3,) unit vector, world frame, or zero."""


class StationCounter:
    """Numbers the stations of views or photographs, one after the other, as one of them sees them.

    Parameters
    ----------
    points : (n, 3) float64 ndarray
        What the view sees, world frame.
    view : View or Photograph
        The one that looks: the first of station `OWN_STATION`.
    least_angle : float
        Degrees; views nearer to each other than this are of one station.
    """

    def __init__(self, points: NDArray[np.float64], view: Standing, least_angle: float) -> None:
        self._points = points[:: -(-len(points) // _MAX_POINTS) or 1]
        self._cosine = float(np.cos(np.radians(least_angle)))
        self._firsts = self._rays([view])
        self._axes = view.viewing_direction[None]

    def numbers(self, views: Sequence[Standing]) -> list[int]:
        """Return the station of each view: the first one whose first view is near enough, or a new one."""
        numbers: list[int] = []
        for first in range(0, len(views), _AT_A_TIME):
            numbers += self._numbers(views[first : first + _AT_A_TIME])
        return numbers

    def are_new(self, views: Sequence[Standing]) -> list[bool]:
        """Whether each view stands where none stood before, the one after the other."""
        known = len(self._axes)
        is_new = []
        for number in self.numbers(views):
            is_new.append(number == known)
            known = max(known, number + 1)
        return is_new

    def _numbers(self, views: Sequence[Standing]) -> list[int]:
        rays = self._rays(views)
        axes = np.array([view.viewing_direction for view in views])
        stands_at = self._are_one(rays, axes, self._firsts, self._axes)
        among = self._are_one(rays, axes, rays, axes)
        numbers: list[int] = []
        new: list[int] = []
        for k in range(len(views)):
            places = np.flatnonzero(stands_at[k])
            found = int(places[0]) if len(places) else -1
            if found < 0:
                found = next((len(self._axes) + n for n, first in enumerate(new) if among[k, first]), -1)
            if found < 0:
                found = len(self._axes) + len(new)
                new.append(k)
            numbers.append(found)
        self._firsts = np.concatenate([self._firsts, rays[new]])
        self._axes = np.concatenate([self._axes, axes[new]])
        return numbers

    def _are_one(
        self,
        rays: NDArray[np.float64],
        axes: NDArray[np.float64],
        others: NDArray[np.float64],
        other_axes: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """(V, W) bool: which of two lots of views stand side by side and look the same way."""
        cosines = np.einsum("vpi,wpi->vwp", rays, others)
        is_near = np.count_nonzero(cosines > self._cosine, axis=2) >= max(_MOST * rays.shape[1], 1)
        look_alike = axes @ other_axes.T > _SAME_WAY
        look_alike |= np.logical_or.outer(~axes.any(axis=1), ~other_axes.any(axis=1))
        return np.asarray(is_near & look_alike)

    def _rays(self, views: Sequence[Standing]) -> NDArray[np.float64]:
        """(V, P, 3) unit vectors from the views to the points."""
        rays = self._points - np.array([view.center for view in views])[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):  # a point at the centre is near to nothing
            return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


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
            Views that overlap it. The first photograph of a station stands for it.

        Returns
        -------
        list of int
            For each of them its station, from 1 in the order of their first views; `OWN_STATION` for those that
            stand where the view itself does. Where all do, each photograph is a station of its own: there is
            nothing better. Views of one photograph always have one number, and those of the view's own are of
            its station.
        """
        scene = self._scene
        points, observed = self._points_in_view
        own = scene.photograph(name)
        shown = [scene.photograph(other) for other in others]
        photographs = [photograph for photograph in dict.fromkeys(shown) if photograph is not own]
        stations = StationCounter(points[observed[scene.index_of[name]]], own, self._least_angle)
        found = stations.numbers(photographs)
        numbers = found if any(found) else range(1, 1 + len(found))
        number_of = dict(zip(photographs, numbers, strict=True))
        return [number_of.get(photograph, OWN_STATION) for photograph in shown]

    def elsewhere(self, name: str, others: Sequence[str]) -> tuple[list[str], list[int]]:
        """Those of the others that stand elsewhere, and their stations' numbers, which ascend; see `numbers`."""
        names, numbers = by_station(others, self.numbers(name, others))
        own = numbers.count(OWN_STATION)
        return names[own:], numbers[own:]


def by_station(names: Sequence[str], numbers: Sequence[int]) -> tuple[list[str], list[int]]:
    """Names and numbers sorted by station; within one they keep their order."""
    order = sorted(range(len(names)), key=numbers.__getitem__)
    return [names[k] for k in order], [numbers[k] for k in order]
