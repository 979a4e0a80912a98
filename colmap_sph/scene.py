"""The words that all rooms share: a frozen `Scene` of pinhole `View`s and sparse points, and a cloud's points.

The method works on these records and never touches pycolmap's own objects, so that a scene can also be made up by
a test or a renderer. Frames are COLMAP's: x right, y down, z forward, ``x_cam = R x_world + t``;
the first pixel's centre is at (0.5, 0.5).
"""

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError

SourceImages = list[str] | int | Literal["__all__"]
"""Partners that a user asks for: names, all, or the program's choice, of which COLMAP reads a number."""

POINT = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
"""A point of a cloud: world frame, model units; unit normal; red, green, blue."""

Polygons = tuple[tuple[NDArray[np.float64], ...], ...]
"""Of each polygon its outline and its holes: (n, 2) corners each, of which the last is joined to the first."""


@dataclass(frozen=True, eq=False)
class Region:
    """What of a scene is asked for: a box, or vertical prisms in one.

    Attributes
    ----------
    box : (2, 3) float64 ndarray
        Least and largest x, y and z, model units; may be infinite.
    polygons : tuple of tuple of (n, 2) float64 ndarray
        In x and y. A point lies inside where it lies in one of them; all of the box counts where there are none.
    axes : (3, 3) float64 ndarray, optional
        Along whose rows, a rotation, x, y and z of box and polygons are counted; None: as in the world frame.
    """

    box: NDArray[np.float64]
    polygons: Polygons = ()
    axes: NDArray[np.float64] | None = None

    def moved(self, shift: NDArray[np.float64]) -> "Region":
        """The region elsewhere, by a shift in the world frame."""
        along = self.along(shift)
        polygons = tuple(tuple(ring + along[:2] for ring in rings) for rings in self.polygons)
        return Region(self.box + along, polygons, self.axes)

    def along(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(…, 3) points of the world frame as box and polygons count them."""
        return points if self.axes is None else points @ self.axes.T


@dataclass(frozen=True, eq=False)
class View:
    """One registered, undistorted image: its pinhole camera, pose and sparse observations.

    Attributes
    ----------
    image_id : int
        COLMAP's image id.
    name : str
        Path relative to the image folder; may contain folders.
    width, height : int
        Size in pixels.
    K : (3, 3) float64 ndarray
        Calibration matrix in pixels; the first pixel's centre is (0.5, 0.5).
    R, t : (3, 3) and (3,) float64 ndarray
        World to camera: ``x_cam = R x_world + t``; `t` in model units.
    point_indices : (n,) int64 ndarray
        Rows of `Scene.points` which this view observes, ascending, each once.
    reprojection_error : float
        Median distance in pixels between where the view observes sparse points, as the model says, and where they
        project; NaN where that is not known.
    unexplained_error : float
        The same once the observations are scaled and shifted to fit: what is left of it if they were made in an
        image of another size, or in one that was cropped since.
    focal_factors : (float, float), optional
        By what `fx` and `fy` would have to be multiplied for the points to project near to where the view observes
        them; None where they do as it is, or no factors make them.
    full_size : (int, int), optional
        Width and height of its image's file, where the view is smaller: the image is reduced when it is read.
    original : str
        Name of the photograph that it was cut from together with other views, which have the same centre; empty
        where it is a photograph of its own.
    """

    image_id: int
    name: str
    width: int
    height: int
    K: NDArray[np.float64]
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    point_indices: NDArray[np.int64]
    reprojection_error: float = math.nan
    unexplained_error: float = math.nan
    focal_factors: tuple[float, float] | None = None
    full_size: tuple[int, int] | None = None
    original: str = ""

    @property
    def photograph(self) -> str:
        """The photograph that it shows: views of one see the scene from one place, and agree for nothing."""
        return self.original or self.name

    @property
    def views(self) -> tuple["View", ...]:
        """Itself: a photograph that was not cut up is its only view."""
        return (self,)

    @property
    def num_pixels(self) -> int:
        """Pixels of the image."""
        return self.width * self.height

    @property
    def file_size(self) -> tuple[int, int]:
        """Width and height that the image's file must have."""
        return self.full_size or (self.width, self.height)

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) projection centre in the world frame."""
        return np.asarray(-self.R.T @ self.t)

    @cached_property
    def inverse_K(self) -> NDArray[np.float64]:
        """(3, 3): from pixels to rays in the camera frame whose z is 1."""
        return np.asarray(np.linalg.inv(self.K))

    @property
    def viewing_direction(self) -> NDArray[np.float64]:
        """(3,) unit vector of the optical axis in the world frame."""
        return np.asarray(self.R[2])

    @property
    def cam_from_world(self) -> NDArray[np.float64]:
        """(3, 4) matrix ``[R | t]``."""
        return np.hstack([self.R, self.t[:, None]])

    def without_points(self) -> "View":
        """The view as if it observed no sparse point: all that a worker needs of it."""
        return replace(self, point_indices=self.point_indices[:0])

    def resized(self, width: int, height: int) -> "View":
        """The view with as many pixels: its image is reduced, or enlarged, when it is read.

        Examples
        --------
        >>> K = np.array([[100.0, 0, 320], [0, 100, 240], [0, 0, 1]])
        >>> view = View(1, "a.jpg", 640, 480, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))
        >>> half = view.resized(320, 240)
        >>> half.K[:2].tolist(), half.file_size
        ([[50.0, 0.0, 160.0], [0.0, 50.0, 120.0]], (640, 480))
        """
        if (width, height) == (self.width, self.height):
            return self
        scale = np.array([width / self.width, height / self.height, 1.0])
        factor = float(scale[:2].mean())
        full_size = None if (width, height) == self.file_size else self.file_size
        return replace(
            self,
            width=width,
            height=height,
            K=self.K * scale[:, None],
            reprojection_error=self.reprojection_error * factor,
            unexplained_error=self.unexplained_error * factor,
            full_size=full_size,
        )

    def no_larger_than(self, max_size: int) -> "View":
        """The view reduced, as COLMAP does it, so that no side has more pixels; -1 or 0: as it is."""
        factor = max_size / max(self.width, self.height)
        if max_size <= 0 or factor >= 1:
            return self
        return self.resized(max(round(self.width * factor), 1), max(round(self.height * factor), 1))

    def may_be_reduced_to(self, width: int, height: int) -> bool:
        """Whether so many pixels are as many as its own, or fewer with its proportions, but for rounding."""
        factor = max(width / self.width, height / self.height)
        fits = abs(self.width * factor - width) <= 1 and abs(self.height * factor - height) <= 1
        return min(width, height) >= 1 and factor <= 1 and fits

    def cropped(self, left: int, top: int, right: int, bottom: int) -> "View":
        """The same camera with columns `left` to `right` and rows `top` to `bottom` alone, these excluded."""
        K = self.K.copy()
        K[:2, 2] -= left, top
        return replace(self, K=K, width=right - left, height=bottom - top, full_size=None)

    def project(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project points into the image, wherever its borders are.

        Parameters
        ----------
        points : (n, 3) float64 ndarray
            World frame, model units.

        Returns
        -------
        pixels : (n, 2) float64 ndarray
            Image coordinates x and y; the image reaches from 0 to its width and height, and its first pixel's
            centre is (0.5, 0.5). Not finite for points in the plane of the camera's centre.
        depth : (n,) float64 ndarray
            z in the camera frame, model units; not positive for points that are not in front of the camera.

        Examples
        --------
        A point 2 units to the right, at a distance of 10, with a focal length of 100 pixels: 20 pixels right.

        >>> import numpy as np
        >>> K = np.array([[100.0, 0, 320], [0, 100, 240], [0, 0, 1]])
        >>> view = View(1, "a.jpg", 640, 480, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))
        >>> pixels, depth = view.project(np.array([[2.0, 0, 10]]))
        >>> pixels.tolist(), depth.tolist()
        ([[340.0, 240.0]], [10.0])
        """
        camera = points @ self.R.T + self.t
        homogeneous = camera @ self.K.T
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return homogeneous[:, :2] / homogeneous[:, 2:], camera[:, 2]


@dataclass(frozen=True, eq=False)
class Photograph:
    """One photograph: a view, or several that were cut from it and have one centre.

    Attributes
    ----------
    name : str
        See `View.photograph`.
    views : tuple of View
        In the order of the scene.
    """

    name: str
    views: tuple[View, ...]

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) projection centre in the world frame."""
        return self.views[0].center

    @property
    def viewing_direction(self) -> NDArray[np.float64]:
        """(3,) unit vector, world frame: the mean of its views' axes; zero where it looks all around."""
        if len(self.views) == 1:
            return self.views[0].viewing_direction
        mean = np.mean([view.viewing_direction for view in self.views], axis=0)
        length = float(np.linalg.norm(mean))
        return np.asarray(mean / length if length > _LEAST_MEAN_AXIS else np.zeros(3))

    @cached_property
    def point_indices(self) -> NDArray[np.int64]:
        """(n,) rows of `Scene.points` which any of its views observes, ascending, each once."""
        if len(self.views) == 1:
            return self.views[0].point_indices
        return np.unique(np.concatenate([view.point_indices for view in self.views]))

    @property
    def num_pixels(self) -> int:
        """Pixels of all its images together."""
        return sum(view.num_pixels for view in self.views)

    @property
    def lead(self) -> View:
        """The first of its views: by its name pairs of photographs are called."""
        return self.views[0]


# Axes whose mean is shorter than this look all around: five of the six of a cube have a mean of 0.2.
_LEAST_MEAN_AXIS = 0.3


def pixel_transfer(source: View, target: View) -> NDArray[np.float64]:
    """Return the (3, 4) matrix [A | a] from pixels of one view to those of another.

    The pixel (col, row) with z-depth z in `source` lies at the homogeneous pixel A (col, row, 1) z + a in
    `target`, whose third coordinate is its z-depth there. Both are integer pixels as the depth maps count them.
    """
    rotation = target.R @ source.R.T
    transfer = np.empty((3, 4))
    transfer[:, :3] = target.K @ rotation @ source.inverse_K
    transfer[:, 3] = target.K @ (target.t - rotation @ source.t)
    return transfer


def in_bands(shape: Sequence[int], most: int) -> Iterator[slice]:
    """Rows of an image (height, width, ...), from the top, in bands of at most `most` pixels, or one row."""
    height, width = shape[:2]
    step = max(most // width, 1)
    return (slice(first, min(first + step, height)) for first in range(0, height, step))


def observed_by(
    first: View | Photograph, second: View | Photograph
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sparse points that one of two views observes, and those that both do: rows of `Scene.points`, ascending.

    Examples
    --------
    >>> views = [View(k, "", 1, 1, np.eye(3), np.eye(3), np.zeros(3), np.array(rows)) for k, rows in enumerate(
    ...     ([1, 2, 5], [2, 3, 5]))]
    >>> [rows.tolist() for rows in observed_by(*views)]
    [[1, 2, 3, 5], [2, 5]]
    """
    rows = np.concatenate([first.point_indices, second.point_indices])
    rows.sort(kind="stable")  # two ascending runs are merged
    is_repeated = rows[1:] == rows[:-1]
    return np.concatenate([rows[:1], rows[1:][~is_repeated]]), rows[1:][is_repeated]


@dataclass(frozen=True, eq=False)
class Scene:
    """Views, sorted by name, and the sparse points they observe.

    Attributes
    ----------
    views : tuple of View
        Sorted by name.
    points : (N, 3) float64 ndarray
        Sparse points in the world frame, in model units.
    origin : (3,) float64 ndarray
        What the cloud's coordinates are relative to: zero, but for a model in map coordinates a point near it.
    anchor : (3,) float64 ndarray
        Where the scene's own origin lies, relative to `origin`: zero as read; see `anchor.anchored`.
    image_ids : tuple of int
        COLMAP's ids of all registered images of the model, in its order, the unusable ones among them.
    """

    views: tuple[View, ...]
    points: NDArray[np.float64]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    anchor: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    image_ids: tuple[int, ...] = ()

    @cached_property
    def index_of(self) -> dict[str, int]:
        """Position in `views` of each image name."""
        return {view.name: index for index, view in enumerate(self.views)}

    @cached_property
    def photographs(self) -> tuple[Photograph, ...]:
        """All photographs, in the order of their first views; where none was cut up, these are the views."""
        views: dict[str, list[View]] = {}
        for view in self.views:
            views.setdefault(view.photograph, []).append(view)
        return tuple(Photograph(name, tuple(cut)) for name, cut in views.items())

    @cached_property
    def _photograph_of(self) -> dict[str, Photograph]:
        return {view.name: photograph for photograph in self.photographs for view in photograph.views}

    def photograph(self, name: str) -> Photograph:
        """Return the photograph that shows in the view of image `name`, which there must be."""
        return self._photograph_of[name]

    @property
    def has_tracks(self) -> bool:
        """Whether any view observes a sparse point."""
        return any(len(view.point_indices) for view in self.views)

    def only(self, names: Collection[str]) -> "Scene":
        """The scene with the views of these images alone: itself, with what is known of it, where that is all."""
        views = tuple(view for view in self.views if view.name in names)
        return self if len(views) == len(self.views) else replace(self, views=views)

    def no_larger_than(self, max_size: int) -> "Scene":
        """The scene with views that have at most as many pixels on a side; -1: as they are."""
        return replace(self, views=tuple(view.no_larger_than(max_size) for view in self.views))

    def view(self, name: str) -> View:
        """Return the view of image `name`; `InputError` where the scene has none."""
        if name not in self.index_of:
            raise InputError(f"The model has no registered image named {name!r}; use a name from its list.")
        return self.views[self.index_of[name]]


NO_SCENE = Scene((), np.zeros((0, 3)))
"""What is known of a scene before its model is read."""
