"""The model of the undistorted images, as COLMAP writes it.

COLMAP leaves images that were not undistorted, and cameras without distortion but of a distorted model, in the
model it writes; that is mended here.
"""

import errno
import tempfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OutputError, reason_of
from colmap_sph.platforms.files import take_room
from colmap_sph.project.cameras import change_camera, make_pinhole, plain_camera
from colmap_sph.project.colmap_library import quiet_colmap
from colmap_sph.project.files import make_dir
from colmap_sph.project.lens.field import LensField
from colmap_sph.project.lens.files import read_lens_fields
from colmap_sph.project.lens.straight import pixel_rays, ray_pixels, straight_camera
from colmap_sph.project.sparse_model import load_model, submodel
from colmap_sph.project.undistortion.options import UndistortionOptions
from colmap_sph.project.wide.cuts import Cuts
from colmap_sph.project.wide.model import model_of_views
from colmap_sph.project.wide.table import write_cuts

_FULL_DISK_BYTES = 64 << 20


def moved_pixels(
    camera: pycolmap.Camera, pixels: NDArray[np.float64], field: LensField | None, straight: pycolmap.Camera
) -> NDArray[np.float64]:
    """Where (n, 2) image coordinates of an original image are in the undistorted one."""
    rays = np.asarray(plain_camera(camera).cam_from_img(pixels), np.float64)[:, :2]
    return ray_pixels(straight, rays if field is None else field.straightened(rays))


@dataclass(frozen=True)
class ModelToUndistort:
    """A model to undistort.

    Attributes
    ----------
    model_dir : Path
        The original model, which is whole.
    names : tuple of str
        Its images that are undistorted.
    options : UndistortionOptions
    folder : Path
        To work in; the model of the undistorted images is left in its folder ``final``.
    """

    model_dir: Path
    names: tuple[str, ...]
    options: UndistortionOptions
    folder: Path

    @property
    def final_dir(self) -> Path:
        """Where the new model goes."""
        return self.folder / "final"


def undistort_model(task: ModelToUndistort) -> None:
    """Write the model of the undistorted images, with PINHOLE cameras; cameras and features are COLMAP's work.

    Raises
    ------
    InputError, OutputError
        COLMAP cannot do it, or nothing more can be written.
    """
    model = load_model(task.model_dir)
    fields = read_lens_fields(task.model_dir)
    cuts = task.options.cuts(model, task.model_dir)
    if cuts.views:
        made = model_with_views(model, cuts, task.names, fields, task.options)
        make_dir(task.final_dir)
        made.write_binary(task.final_dir)
        _load_written_model(task.final_dir)
        write_cuts({name: cuts.views[name] for name in task.names if name in cuts.views}, task.final_dir)
        return
    straight = {
        number: straight_camera(model.camera(number), task.options.for_colmap(), fields[number])
        for number in fields.keys() & model.cameras.keys()
    }
    plain = task.folder / "plain"
    _write_plain_model(model, plain)
    # COLMAP undistorts the images that it is told of, or all: it gets one, and does not find it.
    nowhere = task.folder / "no images"
    make_dir(nowhere)
    try:
        with quiet_colmap(int(pycolmap.logging.FATAL)):
            pycolmap.undistort_images(
                task.folder,
                plain,
                nowhere,
                image_names=[task.names[0]],
                undistort_options=task.options.for_colmap(),
                num_threads=1,
            )
    except (RuntimeError, ValueError, OSError) as error:
        raise_if_disk_is_full(task.folder)
        raise InputError(f"COLMAP cannot undistort {task.model_dir}: {reason_of(error)}") from error
    undistorted = _load_written_model(task.folder / "sparse")
    _straighten(undistorted, straight, fields)
    _write_final_model(undistorted, task.final_dir, task.names)


def model_with_views(
    model: pycolmap.Reconstruction,
    cuts: Cuts,
    names: Collection[str],
    fields: Mapping[int, LensField],
    options: UndistortionOptions,
) -> pycolmap.Reconstruction:
    """The model of views cut from wide images, and of other images undistorted as COLMAP does it."""

    def straight(camera: pycolmap.Camera) -> pycolmap.Camera:
        made = straight_camera(camera, options.for_colmap(), fields.get(camera.camera_id))
        make_pinhole(made)
        return made

    def moved(camera: pycolmap.Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        return moved_pixels(camera, pixels, fields.get(camera.camera_id), straight(camera))

    return model_of_views(model, cuts, names, straight, moved)


def _straighten(
    undistorted: pycolmap.Reconstruction,
    straight: Mapping[int, pycolmap.Camera],
    fields: Mapping[int, LensField],
) -> None:
    """Take lens fields out of a model, in place, that COLMAP undistorted without; to cameras by their numbers."""
    for camera_id in sorted(straight):
        bent = undistorted.camera(camera_id)
        for image in undistorted.images.values():
            if image.camera_id == camera_id and image.num_points2D():
                pixels = np.array([point.xy for point in image.points2D])
                rays = fields[camera_id].straightened(pixel_rays(bent, pixels))
                for point, xy in zip(image.points2D, ray_pixels(straight[camera_id], rays), strict=True):
                    point.xy = xy
        change_camera(bent, straight[camera_id])


def _write_plain_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model with cameras that COLMAP undistorts rightly, see `plain_camera`."""
    for camera in model.cameras.values():
        change_camera(camera, plain_camera(camera))
    make_dir(folder)
    model.write_binary(folder)
    _load_written_model(folder)


def _write_final_model(model: pycolmap.Reconstruction, target: Path, names: Collection[str]) -> None:
    """Write a model with images `names` alone, and PINHOLE cameras."""
    if len(names) < model.num_reg_images():
        model = submodel(model, set(names))
    for camera in model.cameras.values():
        make_pinhole(camera)
    make_dir(target)
    model.write_binary(target)
    _load_written_model(target)


def _load_written_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model that COLMAP has just written, without noticing whether the disk took it."""
    try:
        return load_model(folder)
    except InputError as error:
        raise_if_disk_is_full(folder)
        raise OutputError(f"The model written to {folder} is not whole; check space and permissions.") from error


def raise_if_disk_is_full(folder: Path) -> None:
    """Raise `OutputError` where there is no room: the disk is full, or a quota or a limit on files is reached."""
    with tempfile.TemporaryFile(dir=folder) as file:
        try:
            take_room(file.fileno(), _FULL_DISK_BYTES)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise OutputError(
                    f"Nothing more can be written to {folder} ({reason_of(error)}); free some space, raise the "
                    "limit (a quota, or ulimit -f), or choose another --output."
                ) from error
