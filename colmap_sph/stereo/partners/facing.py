"""Photographs that were cut into several views → which views of one may see what a view of another sees.

The views that were cut from a panorama look everywhere. A view is compared with those of a partner that have some
of what lies along its rays in their image, at the distances at which its photograph sees sparse points.
"""

import itertools
from collections.abc import Iterable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.frusta import points_in_view, seen_by

# Rays of a view along each side, and percentiles of the distances of its photograph's points: all that it may see.
_RAYS = 8
_PERCENTILES = (2, 15, 40, 65, 90, 99)
# Points of a photograph that tell its distances.
_MOST_POINTS = 2000


class Facing:
    """Tells which views of other photographs face what a view sees; may be used by several threads.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def views(self, name: str, others: Iterable[str]) -> list[list[str]]:
        """Return the views of each of some photographs that may see what a view sees.

        Parameters
        ----------
        name : str
            The view that looks.
        others : iterable of str
            A view of each photograph to look at.

        Returns
        -------
        list of list of str
            Of each, the names of its views that have something of what the view may see in their image. A
            photograph that was not cut up has one view, which is not asked; the view's own has none.
        """
        samples: NDArray[np.float64] | None = None
        found = []
        for photograph in map(self._scene.photograph, others):
            views = photograph.views
            if photograph is self._scene.photograph(name):
                views = ()
            elif len(views) > 1:
                samples = self._samples(name) if samples is None else samples
                if len(samples):
                    are_facing = np.asarray(seen_by(views, samples).any(axis=1))
                    views = tuple(itertools.compress(views, are_facing))
            found.append([view.name for view in views])
        return found

    def _samples(self, name: str) -> NDArray[np.float64]:
        """(n, 3) places along the rays of a view, world frame; none where its distances are not known."""
        distances = self._distances[self._scene.photograph(name).name]
        view = self._scene.view(name)
        rays = _rays_of(view)
        return np.asarray(view.center + (distances[:, None, None] * rays).reshape(-1, 3))

    @cached_property
    def _distances(self) -> dict[str, NDArray[np.float64]]:
        """Distances at which each photograph sees something."""
        points, observed, _ = points_in_view(self._scene)
        distances = {}
        for photograph in self._scene.photographs:
            rows = np.concatenate([observed[self._scene.index_of[view.name]] for view in photograph.views])
            rows = rows[:: -(-len(rows) // _MOST_POINTS) or 1]
            away = np.linalg.norm(points[rows] - photograph.center, axis=1)
            distances[photograph.name] = np.percentile(away, _PERCENTILES) if len(away) else np.empty(0)
        return distances


def _rays_of(view: View) -> NDArray[np.float64]:
    """(n, 3) unit rays of an even grid over a view's image, world frame."""
    steps = (np.arange(_RAYS) + 0.5) / _RAYS
    x, y = np.meshgrid(steps * view.width, steps * view.height)
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1) @ view.inverse_K.T @ view.R
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
