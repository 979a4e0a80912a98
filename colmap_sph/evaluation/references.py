"""What a cloud is measured against: a cloud, a mesh, or exact depth maps, behind one interface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import InputError, NoResultError
from colmap_sph.evaluation.geometry_io import Mesh, PointCloud
from colmap_sph.evaluation.mesh_surface import MeshSurface
from colmap_sph.evaluation.neighbours import PointIndex, Points, thin
from colmap_sph.evaluation.options import EvaluationOptions
from colmap_sph.evaluation.visible_surface import DepthView, count_views, observed, visible_surface


class Reference(Protocol):
    """A reference that is ready to be measured against, as often as wanted."""

    name: str
    points: Points
    """(M, 3) the samples that a complete cloud comes close to."""
    crs: str | None
    z_is_up: bool
    movable: bool
    """Whether a cloud may be registered to it."""

    def distances(self, points: Points, *, threads: int, bound: float) -> npt.NDArray[np.float64]:
        """Distance of each point to the reference.

        Parameters
        ----------
        points : (n, 3) float64 ndarray
            In the reference's frame, metres.
        threads : int
        bound : float
            Metres.

        Returns
        -------
        (n,) float64 ndarray
            Metres; infinite beyond `bound`.
        """
        ...

    def can_judge(self, points: Points) -> npt.NDArray[np.bool_]:
        """Which of (N, 3) points the reference knows anything about, apart from cropping."""
        ...


class CloudReference:
    """A reference cloud: nearest neighbours."""

    movable = True

    def __init__(self, cloud: PointCloud, options: EvaluationOptions) -> None:
        self.name = cloud.name
        self.crs = cloud.crs
        self.z_is_up = cloud.z_is_up
        self.points = cloud.points - np.asarray(options.reference_shift)
        self._index = PointIndex(self.points)

    def distances(self, points: Points, *, threads: int, bound: float) -> npt.NDArray[np.float64]:
        """As `Reference.distances`."""
        return self._index.distances(points, threads=threads, bound=bound)

    def can_judge(self, points: Points) -> npt.NDArray[np.bool_]:
        """As `Reference.can_judge`."""
        return np.ones(len(points), bool)


class MeshReference:
    """A reference mesh: distances to its triangles; samples of its surface for completeness."""

    movable = True

    def __init__(self, mesh: Mesh, options: EvaluationOptions) -> None:
        self.name = mesh.name
        self.crs: str | None = None
        self.z_is_up = False
        shifted = Mesh(mesh.name, mesh.vertices - np.asarray(options.reference_shift), mesh.faces)
        self._surface = MeshSurface(shifted, options.sample_spacing)
        self.points = self._surface.samples

    def distances(self, points: Points, *, threads: int, bound: float) -> npt.NDArray[np.float64]:
        """As `Reference.distances`."""
        return self._surface.distances(points, threads=threads, bound=bound)

    def can_judge(self, points: Points) -> npt.NDArray[np.bool_]:
        """As `Reference.can_judge`."""
        return np.ones(len(points), bool)


class DepthReference:
    """Exact depth maps. Completeness: surface that `min_view_count` views see, one sample per voxel of the
    smallest τ so that area counts and not pixels. Accuracy: all surface that any view sees."""

    movable = False

    def __init__(self, views: Sequence[DepthView], options: EvaluationOptions) -> None:
        if not views:
            raise InputError("no image with exact depth was given")
        if any(options.reference_shift):
            views = [_shifted(view, np.asarray(options.reference_shift)) for view in views]
        self.name = f"exact depth of {len(views)} images"
        self.crs: str | None = None
        self.z_is_up = False
        self._views = views
        surface = visible_surface(views, options.sample_spacing)
        candidates = surface[thin(surface, options.taus[0])]
        seen_enough = candidates[count_views(candidates, views) >= options.min_view_count]
        if not len(seen_enough):
            raise NoResultError(
                f"no surface is seen by {options.min_view_count} images with exact depth: lower min_view_count"
            )
        self.points = seen_enough
        self._index = PointIndex(surface)

    def distances(self, points: Points, *, threads: int, bound: float) -> npt.NDArray[np.float64]:
        """As `Reference.distances`."""
        return self._index.distances(points, threads=threads, bound=bound)

    def can_judge(self, points: Points) -> npt.NDArray[np.bool_]:
        """As `Reference.can_judge`."""
        return observed(points, self._views)


def make_reference(
    truth: PointCloud | Mesh | Sequence[DepthView], options: EvaluationOptions | None = None
) -> Reference:
    """Prepare a reference once for any number of clouds.

    Parameters
    ----------
    truth : PointCloud, Mesh or sequence of DepthView
    options : EvaluationOptions, optional

    Raises
    ------
    InputError, NoResultError, OptionError
    """
    options = options or EvaluationOptions()
    options.check()
    if isinstance(truth, PointCloud):
        return CloudReference(truth, options)
    if isinstance(truth, Mesh):
        return MeshReference(truth, options)
    return DepthReference(truth, options)


def _shifted(view: DepthView, shift: npt.NDArray[np.float64]) -> DepthView:
    return DepthView(view.name, view.K, view.R, view.t + view.R @ shift, view.read_depth)
