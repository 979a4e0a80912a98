"""COLMAP sparse model → frozen `Scene` of pinhole `View`s and sparse points; those whose images are good."""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError, counted
from colmap_sph.project.cameras import is_pinhole
from colmap_sph.project.given.binary_arrays import Observations, read_observations, read_points
from colmap_sph.project.given.poses import check_points_in_front
from colmap_sph.project.map_coordinates import check_size, is_plausible, local_origin
from colmap_sph.project.sparse_model import is_text, load_model, model_files
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.table import read_cuts
from colmap_sph.scene import Scene, View

logger = logging.getLogger(__name__)

Moved = Callable[[pycolmap.Image, NDArray[np.float64]], NDArray[np.float64]]
"""An image of a model and (n, 2) image coordinates in it → where these are in a view of it."""

# A table has so many times as many places as there are points, at most.
_MOST_GAPS = 8
# Other focal lengths explain where points are observed where they leave less than this share of what is left once
# all are shifted alike, as a crop or a turned camera does.
_EXPLAINED = 0.25


def read_scene(sparse_dir: Path) -> Scene:
    """Read an undistorted COLMAP model, such as the ``sparse`` folder of a dense workspace.

    Views whose pose or calibration is impossible (not finite, say), and such points, are left out with a warning.
    A model in map coordinates is moved near its origin, see `Scene.origin`.

    Parameters
    ----------
    sparse_dir : Path
        Folder with a binary or text model; all cameras without distortion, of whatever camera model.

    Returns
    -------
    Scene
        Views sorted by name, float64 throughout.

    Raises
    ------
    InputError
        No readable model in the folder, one in an impossible unit, no usable image, a distorted camera, damaged
        `wide_images.json`, or points behind the images that observe them.
    """
    files = model_files(sparse_dir)
    model = load_model(sparse_dir)
    sparse = _of_library(model) if is_text(files) else _of_files(files)
    return _scene(model, sparse_dir, sparse, read_cuts(sparse_dir))


def scene_of_model(
    model: pycolmap.Reconstruction,
    sparse_dir: Path,
    cuts: Mapping[str, Cut] | None = None,
    moved: Moved | None = None,
) -> Scene:
    """Return the scene of a model read from `sparse_dir`, and maybe changed since; see `read_scene`.

    `cuts` says from which image views were cut, by their names, and `moved` where they observe the points, where
    that is not where the model says.
    """
    return _scene(model, sparse_dir, _of_library(model, moved), cuts or {})


@dataclass(frozen=True, eq=False)
class _Sparse:
    """Ascending ids of the points of a model and their coordinates; what is observed, by image id."""

    ids: NDArray[np.int64]
    points: NDArray[np.float64]
    observations: Iterable[tuple[int, Observations]]


def _of_files(files: Sequence[Path]) -> _Sparse:
    """Of a binary model that has been read."""
    path_of = {path.name: path for path in files}
    return _Sparse(*read_points(path_of["points3D.bin"]), read_observations(path_of["images.bin"]))


def _of_library(model: pycolmap.Reconstruction, moved: Moved | None = None) -> _Sparse:
    xyz_of = {point_id: point.xyz for point_id, point in model.points3D.items()}
    ids = sorted(xyz_of)
    points = np.array([xyz_of[i] for i in ids], dtype=np.float64).reshape(-1, 3)
    observations = ((image_id, _observations(model.image(image_id), moved)) for image_id in model.reg_image_ids())
    return _Sparse(np.array(ids, np.int64), points, observations)


def _observations(image: pycolmap.Image, moved: Moved | None) -> Observations:
    points2D = [image.points2D[i] for i in image.get_observation_point2D_idxs()]
    xy = np.array([point.xy for point in points2D], np.float64).reshape(-1, 2)
    if moved is not None and len(xy):
        xy = moved(image, xy)
    return Observations(xy, np.array([point.point3D_id for point in points2D], np.int64))


def _scene(model: pycolmap.Reconstruction, sparse_dir: Path, sparse: _Sparse, cuts: Mapping[str, Cut]) -> Scene:
    check_size(model, sparse_dir)
    origin = local_origin(model)
    if origin.any():
        logger.info("%s is in map coordinates; worked on relative to %s", sparse_dir, tuple(origin.tolist()))
    is_kept = is_plausible(sparse.points)
    if not is_kept.all():
        number = len(is_kept) - int(is_kept.sum())
        logger.warning("%s without possible coordinates: left out", counted(number, "sparse point"))
    rows_of = _Rows(sparse.ids[is_kept])
    points = sparse.points[is_kept] - origin
    registered = set(model.reg_image_ids())
    views = {}
    for image_id, observations in sparse.observations:
        if image_id in registered:
            view = _read_view(model, image_id, sparse_dir, origin)
            if view.name in cuts:
                view = replace(view, original=cuts[view.name].original)
            views[image_id] = _with_observations(view, observations, rows_of, points)
    faults = {image_id: _fault(view) for image_id, view in views.items()}
    usable = [views[image_id] for image_id in model.reg_image_ids() if not faults[image_id]]
    if not usable:
        told = ", ".join(f"{views[image_id].name}: {fault}" for image_id, fault in list(faults.items())[:1])
        raise InputError(
            f"No image of the model in {sparse_dir} has a usable pose and camera ({told}); run COLMAP's mapper "
            "again, or give the model as it was made."
        )
    for image_id, fault in faults.items():
        if fault:
            logger.warning("%s in %s: %s; left out", views[image_id].name, sparse_dir, fault)
    check_points_in_front(model, sparse_dir)
    views_by_name = tuple(sorted(usable, key=lambda view: view.name))
    return Scene(views_by_name, points, origin, image_ids=tuple(model.reg_image_ids()))


def _read_view(
    model: pycolmap.Reconstruction, image_id: int, sparse_dir: Path, origin: NDArray[np.float64]
) -> View:
    """An image of a model as a view that observes nothing."""
    image = model.image(image_id)
    camera = model.camera(image.camera_id)
    if not is_pinhole(camera):
        raise InputError(
            f"{image.name} in {sparse_dir} has a distorted {camera.model_name} camera; "
            "give this folder as --model to have it undistorted, or run COLMAP's image_undistorter."
        )
    pose = np.array(image.cam_from_world().matrix(), dtype=np.float64)
    with np.errstate(invalid="ignore", over="ignore"):  # an impossible pose is told later
        translation = pose[:, 3] + pose[:, :3] @ origin
    return View(
        image_id=image_id,
        name=image.name,
        width=camera.width,
        height=camera.height,
        K=np.array(camera.calibration_matrix(), dtype=np.float64),
        R=np.ascontiguousarray(pose[:, :3]),
        t=translation,
        point_indices=np.empty(0, np.int64),
    )


class _Rows:
    """Rows of points by their ids."""

    def __init__(self, ids: NDArray[np.int64]) -> None:
        self._ids = ids
        # A table is looked up many times faster than a sorted array is searched; ids seldom have large gaps.
        self._table = np.full(0, -1, np.int64)
        if len(ids) and ids[0] >= 0 and ids[-1] < _MOST_GAPS * len(ids):
            self._table = np.full(ids[-1] + 1, -1, np.int64)
            self._table[ids] = np.arange(len(ids))

    def of(self, wanted: NDArray[np.int64]) -> NDArray[np.int64]:
        """Row of each id that is wanted, -1 where there is none."""
        if len(self._table):
            return np.where(wanted < len(self._table), self._table[np.minimum(wanted, len(self._table) - 1)], -1)
        if not len(self._ids):
            return np.full(len(wanted), -1)
        places = np.minimum(np.searchsorted(self._ids, wanted), len(self._ids) - 1)
        return np.where(self._ids[places] == wanted, places, -1)


def _with_observations(
    view: View, observations: Observations, rows_of: _Rows, points: NDArray[np.float64]
) -> View:
    """A view with what it observes of points, and how far off these are."""
    rows = rows_of.of(observations.point)
    known = rows >= 0
    with np.errstate(all="ignore"):  # an impossible pose is told later
        projected, _ = view.project(points[rows[known]])
        observed = observations.xy[known]
        is_finite = np.isfinite(projected).all(axis=1) & np.isfinite(observed).all(axis=1)
        projected, observed = projected[is_finite], observed[is_finite]
        return replace(
            view,
            point_indices=np.unique(rows[known]),
            reprojection_error=_median_of_finite(np.linalg.norm(projected - observed, axis=1)),
            unexplained_error=_unexplained_error(projected, observed),
            focal_factors=_focal_factors(projected - view.K[:2, 2], observed - view.K[:2, 2]),
        )


def _focal_factors(projected: NDArray[np.float64], observed: NDArray[np.float64]) -> tuple[float, float] | None:
    """See `View.focal_factors`; (n, 2) finite pixels from the principal point.

    Observations in an image of another size would be scaled about its corner. Of points on one side of the image
    alone, such as its lower third, factors explain shifts nearly as well.
    """
    if not len(projected):
        return None
    factors = np.array([_median_of_finite(ratios) for ratios in (observed / projected).T])
    left = _median_of_finite(np.linalg.norm(factors * projected - observed, axis=1))
    moved = observed - projected
    if left < _EXPLAINED * _median_of_finite(np.linalg.norm(moved - np.median(moved, axis=0), axis=1)):
        return float(factors[0]), float(factors[1])
    return None


def _unexplained_error(projected: NDArray[np.float64], observed: NDArray[np.float64]) -> float:
    """Median distance in pixels, once the observed coordinates are scaled and shifted to fit; NaN without any."""
    if not len(projected):
        return math.nan
    arms, observed = (places - np.median(places, axis=0) for places in (projected, observed))
    factor = _median_of_finite((arms * observed).sum(axis=1) / (observed**2).sum(axis=1))
    return _median_of_finite(np.linalg.norm(arms - factor * observed, axis=1))


def _median_of_finite(values: NDArray[np.float64]) -> float:
    """NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _fault(view: View) -> str:
    """What makes the pose or calibration of a view impossible; empty where nothing does."""
    size = max(view.width, view.height)
    focal = np.array([view.K[0, 0], view.K[1, 1]])
    if min(view.width, view.height) <= 0:
        return f"its camera has {view.width} x {view.height} pixels"
    # Fields of view from half a second of arc to just under 180 degrees.
    if not ((focal > 1e-3 * size) & (focal < 1e6 * size)).all():
        return f"the focal length of its camera is {_pixels(focal)}, of an image of {view.width} x {view.height}"
    if not (np.abs(view.K[:2, 2]) < 1e3 * size).all():
        return f"the principal point of its camera is {_pixels(view.K[:2, 2])}"
    is_rotation = (np.abs(view.R) < 1.01).all() and abs(np.linalg.det(view.R) - 1.0) < 1e-3
    if not (is_rotation and is_plausible(view.t[None])[0]):
        return "its pose is no rotation and translation"
    return ""


def _pixels(values: NDArray[np.float64]) -> str:
    return f"{' and '.join(f'{value:g}' for value in values)} pixels"
