"""COLMAP sparse model → frozen `Scene` of pinhole `View`s and sparse points.

Every later stage works on these records and never touches pycolmap's own objects, so that a scene can also be
made up by a test or a renderer. Frames are COLMAP's: x right, y down, z forward, ``x_cam = R x_world + t``;
the first pixel's centre is at (0.5, 0.5).
"""

import logging
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.map_coordinates import is_plausible, local_origin
from colmap_sph.model_check import check_binary_file

logger = logging.getLogger(__name__)

MODEL_FILES = ("cameras", "images", "points3D")
# Files that COLMAP 3.12 added; older models do not have them.
RIG_FILES = ("rigs", "frames")


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
    """

    image_id: int
    name: str
    width: int
    height: int
    K: NDArray[np.float64]
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    point_indices: NDArray[np.int64]

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) projection centre in the world frame."""
        return np.asarray(-self.R.T @ self.t)

    @property
    def viewing_direction(self) -> NDArray[np.float64]:
        """(3,) unit vector of the optical axis in the world frame."""
        return np.asarray(self.R[2])

    @property
    def cam_from_world(self) -> NDArray[np.float64]:
        """(3, 4) matrix ``[R | t]``."""
        return np.hstack([self.R, self.t[:, None]])


def pixel_transfer(source: View, target: View) -> NDArray[np.float64]:
    """Return the (3, 4) matrix [A | a] from pixels of one view to those of another.

    The pixel (col, row) with z-depth z in `source` lies at the homogeneous pixel A (col, row, 1) z + a in
    `target`, whose third coordinate is its z-depth there. Both are integer pixels as the depth maps count them.
    """
    rotation = target.R @ source.R.T
    return np.hstack(
        [
            target.K @ rotation @ np.linalg.inv(source.K),
            (target.K @ (target.t - rotation @ source.t))[:, None],
        ]
    )


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

    def view(self, name: str) -> View:
        """Return the view of image `name`; `InputError` where the scene has none."""
        if name not in self.index_of:
            raise InputError(f"The model has no registered image named {name!r}; use a name from its list.")
        return self.views[self.index_of[name]]


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
        No readable model in the folder, no registered image, or a distorted camera.
    """
    return scene_of_model(load_model(sparse_dir), sparse_dir)


def scene_of_model(model: pycolmap.Reconstruction, sparse_dir: Path) -> Scene:
    """Return the scene of a model read from `sparse_dir`; see `read_scene`."""
    origin = local_origin(model)
    if origin.any():
        logger.info("%s is in map coordinates; worked on relative to %s", sparse_dir, tuple(origin.tolist()))
    points, row_of = _read_points(model)
    views = [_read_view(model, image_id, row_of, sparse_dir, origin) for image_id in model.reg_image_ids()]
    usable = [view for view in views if _is_possible(view)]
    for view in views:
        if not _is_possible(view):
            logger.warning("%s: the pose or calibration in %s is impossible; left out", view.name, sparse_dir)
    if not usable:
        raise InputError(f"No image of the model in {sparse_dir} has a usable pose; run COLMAP's mapper again.")
    views_by_name = tuple(sorted(usable, key=lambda view: view.name))
    return Scene(views_by_name, points - origin, origin, image_ids=tuple(model.reg_image_ids()))


def load_model(sparse_dir: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model with any camera model, binary preferred to text as COLMAP does.

    Parameters
    ----------
    sparse_dir : Path
        Folder holding ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``.

    Returns
    -------
    pycolmap.Reconstruction
        With at least one registered image.

    Raises
    ------
    InputError
        The folder or its model is missing, empty or damaged, or has no registered image.
    """
    sparse_dir = Path(sparse_dir)
    files = model_files(sparse_dir)
    binary = files[0].suffix == ".bin"
    if binary:
        for path in files:
            check_binary_file(path)
    try:
        model = pycolmap.Reconstruction()
        (model.read_binary if binary else model.read_text)(sparse_dir)
        registered = model.reg_image_ids()
        names = [model.image(image_id).name for image_id in registered]
    except UnicodeDecodeError as error:
        raise InputError(
            f"The model in {sparse_dir} has the image name {error.object!r}, which is not UTF-8; "
            "rename the image, and export the model from COLMAP again."
        ) from error
    except (RuntimeError, ValueError, IndexError, KeyError, MemoryError) as error:
        raise InputError(
            f"The model in {sparse_dir} is damaged ({_one_line(error)}); export it from COLMAP again."
        ) from error
    if not registered:
        raise InputError(
            f"The model in {sparse_dir} has no registered image; run COLMAP's mapper or give another model."
        )
    _check_names(names, sparse_dir)
    return model


def _check_names(names: list[str], sparse_dir: Path) -> None:
    """Every image needs a place of its own; COLMAP ends the process where one lies in the other's."""
    known = set(names)
    if len(known) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"The model in {sparse_dir} has two images named {twice!r}; rename one of them.")
    for name in names:
        inside = next((str(folder) for folder in PurePosixPath(name).parents if str(folder) in known), None)
        if inside is not None:
            raise InputError(
                f"The model in {sparse_dir} has the images {inside!r} and {name!r}, "
                "and a file cannot be a folder; rename one of them."
            )


def image_names(model: pycolmap.Reconstruction) -> list[str]:
    """Sorted names of the registered images of a model."""
    return sorted(model.image(image_id).name for image_id in model.reg_image_ids())


def cameras_of_images(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Camera]:
    """Cameras of the registered images of a model, by the image's name."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    return {image.name: model.camera(image.camera_id) for image in images}


def is_pinhole(camera: pycolmap.Camera) -> bool:
    """Whether a camera of any model maps as its calibration matrix does, to 0.001 px inside the image."""
    if camera.model in (pycolmap.CameraModelId.PINHOLE, pycolmap.CameraModelId.SIMPLE_PINHOLE):
        return True
    if not camera.is_perspective() or not np.all(np.isfinite(camera.params)) or camera.mean_focal_length() <= 0:
        return False
    u, v = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    rays = pixels @ np.linalg.inv(camera.calibration_matrix()).T
    mapped = np.asarray(camera.img_from_cam(rays), dtype=np.float64)
    return bool(np.abs(mapped - pixels[:, :2]).max() < 1e-3)


def make_pinhole(camera: pycolmap.Camera) -> None:
    """Turn a camera without distortion, of whatever model, into a PINHOLE one that maps alike."""
    if not is_pinhole(camera):
        raise ValueError(f"camera {camera.camera_id} ({camera.model_name}) is distorted")
    K = camera.calibration_matrix()
    camera.model = pycolmap.CameraModelId.PINHOLE
    camera.params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]


def model_files(sparse_dir: Path) -> list[Path]:
    """Return the files that make up the model in a folder; `InputError` where they are not complete."""
    if not sparse_dir.is_dir():
        is_file = sparse_dir.is_file()
        raise InputError(
            f"The model folder {sparse_dir} {'is a file' if is_file else 'does not exist'}; "
            "give the folder of a COLMAP model."
        )
    for extension in (".bin", ".txt"):
        if all((sparse_dir / f"{stem}{extension}").is_file() for stem in MODEL_FILES):
            files = [sparse_dir / f"{stem}{extension}" for stem in (*MODEL_FILES, *RIG_FILES)]
            return [path for path in files if path.is_file()]
    # A workspace's own model, `dense/sparse`, last: it is what undistortion made of the one that is meant.
    inside = sorted(
        (path.parent for depth in ("*", "*/*") for path in sparse_dir.glob(f"{depth}/cameras.bin")),
        key=lambda path: (path.name == "sparse" and path.parent != sparse_dir, path),
    )
    hint = f"did you mean {inside[0]}?" if inside else "give the folder of a COLMAP model, such as sparse/0."
    raise InputError(
        f"No COLMAP model in {sparse_dir}: cameras, images and points3D (.bin or .txt) are needed; {hint}"
    )


def _read_points(model: pycolmap.Reconstruction) -> tuple[NDArray[np.float64], dict[int, int]]:
    """Return the (N, 3) finite points, by ascending id, and the row of each point id."""
    xyz_of = {point_id: point.xyz for point_id, point in model.points3D.items()}
    ids = sorted(xyz_of)
    points = np.array([xyz_of[i] for i in ids], dtype=np.float64).reshape(-1, 3)
    kept = np.flatnonzero(is_plausible(points))
    if len(kept) < len(ids):
        logger.warning("%d sparse points have no possible coordinates; left out", len(ids) - len(kept))
    return points[kept], {ids[index]: row for row, index in enumerate(kept)}


def _read_view(
    model: pycolmap.Reconstruction,
    image_id: int,
    row_of: dict[int, int],
    sparse_dir: Path,
    origin: NDArray[np.float64],
) -> View:
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
    points2D = image.points2D
    rows = {row_of.get(points2D[i].point3D_id, -1) for i in image.get_observation_point2D_idxs()} - {-1}
    return View(
        image_id=image_id,
        name=image.name,
        width=camera.width,
        height=camera.height,
        K=np.array(camera.calibration_matrix(), dtype=np.float64),
        R=np.ascontiguousarray(pose[:, :3]),
        t=translation,
        point_indices=np.array(sorted(rows), dtype=np.int64),
    )


def _is_possible(view: View) -> bool:
    size, focal = max(view.width, view.height), np.array([view.K[0, 0], view.K[1, 1]])
    return bool(
        min(view.width, view.height) > 0
        # Fields of view from half a second of arc to just under 180 degrees.
        and (focal > 1e-3 * size).all()
        and (focal < 1e6 * size).all()
        and (np.abs(view.K[:2, 2]) < 1e3 * size).all()
        and is_plausible(view.t[None])[0]
        and (np.abs(view.R) < 1.01).all()
        and abs(np.linalg.det(view.R) - 1.0) < 1e-3
    )


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
