"""Project → COLMAP dense workspace of its undistorted images; or what that will be.

COLMAP itself undistorts (`pycolmap.undistort_images`). What goes in is checked before (see `originals`), because
COLMAP ends the process at some bad input. What comes out is mended here, because COLMAP leaves images which it did
not undistort, and cameras without distortion but of a distorted model, in the model it writes.
"""

import logging
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pycolmap

from colmap_sph.errors import InputError, OptionError, OutputError, reason_of
from colmap_sph.project.cameras import make_pinhole, replace_ideal_fisheyes, undistort_cameras
from colmap_sph.project.colmap_library import quiet_colmap
from colmap_sph.project.files import free_space, make_dir
from colmap_sph.project.images import image_problem
from colmap_sph.project.masks import undistort_mask
from colmap_sph.project.originals import Originals, read_originals
from colmap_sph.project.pair_lists import write_fusion_cfg, write_patch_match_cfg
from colmap_sph.project.project import Project
from colmap_sph.project.scene_reader import scene_of_model
from colmap_sph.project.sparse_model import (
    cameras_of_images,
    image_names,
    is_text,
    load_model,
    model_files,
    submodel,
)
from colmap_sph.project.staging import (
    check_discardable,
    discard_workspace,
    finish_move,
    is_finished,
    move_workspace_into_place,
    scratch_folder,
)
from colmap_sph.project.workspace import Workspace, mask_path
from colmap_sph.scene import Scene

logger = logging.getLogger(__name__)

_FULL_DISK_BYTES = 64 << 20
# Space that undistortion is given, relative to the files it starts from; JPEGs come out up to 1.6 times larger.
_SPACE_FACTOR = 2


@dataclass(frozen=True)
class UndistortionOptions:
    """How the original images become undistorted ones."""

    max_image_size: int = -1
    """Longest side of the undistorted images in pixels; larger ones are reduced. -1: keep their size."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of its bounds."""
        if self.max_image_size != -1 and self.max_image_size < 16:
            raise OptionError(
                f"max_image_size must be -1 (keep the size) or at least 16, not {self.max_image_size}.",
                "max_image_size",
            )

    def for_colmap(self) -> pycolmap.UndistortCameraOptions:
        """The same as COLMAP's options."""
        options = pycolmap.UndistortCameraOptions()
        options.max_image_size = self.max_image_size
        return options


@dataclass(frozen=True)
class Prepared:
    """A dense workspace that is complete, and what to expect in it.

    Attributes
    ----------
    workspace : Workspace
        With ``images``, ``sparse`` and ``stereo``, and ``masks`` where there are any.
    expected : tuple of str
        Sorted names of all registered images of the original model: those that the workspace does not have were
        left out.
    """

    workspace: Workspace
    expected: tuple[str, ...]


def prepare_workspace(project: Project, options: UndistortionOptions, *, overwrite: bool = False) -> Prepared:
    """Undistort the images of a sparse model into a COLMAP dense workspace, or reuse the finished one.

    Everything is made inside the workspace's ``colmap_sph`` and moved to its place when complete, so that an
    interrupted undistortion is never taken for a workspace. An image that is missing, unreadable or not of
    its camera's size is reported and left out of the workspace and its model.

    Parameters
    ----------
    project : Project
        With a model, of any camera model that has a pinhole equivalent.
    options : UndistortionOptions
    overwrite : bool
        Discard what an earlier run has made, once it is clear that this one can start.

    Returns
    -------
    Prepared

    Raises
    ------
    InputError
        No usable model or image, a mask that does not fit its image, or the folder holds a workspace made from
        something else.
    OutputError
        The workspace cannot be written.
    """
    options.check()
    originals = read_originals(project)
    workspace = Workspace(project.root)
    marker = _marker(originals, options)
    if overwrite or not _is_made(workspace, marker):
        _make_workspace(originals, workspace, marker, options, overwrite=overwrite)
    return Prepared(workspace, tuple(image_names(originals.model)))


@dataclass(frozen=True)
class Foreseen:
    """A workspace that is not there yet: its scene, and the pixels of all original images together."""

    scene: Scene
    original_pixels: int


def foresee_workspace(project: Project, options: UndistortionOptions, *, overwrite: bool) -> Foreseen | None:
    """Find what `prepare_workspace` would make, without making it.

    Parameters
    ----------
    project, options
        As for `prepare_workspace`, which raises the same.
    overwrite : bool
        The workspace that is there will be discarded first.

    Returns
    -------
    Foreseen or None
        None where it is made already.

    Raises
    ------
    InputError
        See `prepare_workspace`.
    """
    options.check()
    originals = read_originals(project)
    workspace = Workspace(project.root)
    if overwrite:
        check_discardable(workspace)
    elif is_finished(workspace, _marker(originals, options)):
        return None
    model = submodel(originals.model, set(originals.usable().images))
    cameras = [model.camera(image.camera_id) for image in model.images.values()]
    pixels = sum(camera.width * camera.height for camera in cameras)
    undistort_cameras(model, options.for_colmap())
    return Foreseen(scene_of_model(model, originals.model_dir), pixels)


def _is_made(workspace: Workspace, marker: dict[str, Any]) -> bool:
    """Whether the workspace is there, once a move into place that was interrupted is finished."""
    finish_move(workspace, marker)
    finished = is_finished(workspace, marker)
    if finished:
        logger.info("The undistorted images in %s are up to date", workspace.root)
    return finished


def _make_workspace(
    originals: Originals,
    workspace: Workspace,
    marker: dict[str, Any],
    options: UndistortionOptions,
    *,
    overwrite: bool,
) -> None:
    usable = originals.usable()
    if overwrite:
        discard_workspace(workspace)
    _check_space(originals, usable.images, workspace.root, options)
    scratch = workspace.undistortion_scratch_dir
    with scratch_folder(scratch):
        kept = _undistort(originals, usable.images, scratch, options)
        _undistort_masks(originals, sorted(set(kept) & set(usable.masked)), scratch, options)
        Workspace(scratch).create_stereo_dirs(kept)
        shutil.rmtree(Workspace(scratch).state_dir)
        move_workspace_into_place(workspace, marker)
    number = originals.model.num_reg_images()
    logger.info("Undistorted %d of %d images into %s", len(kept), number, workspace.root)


def _marker(originals: Originals, options: UndistortionOptions) -> dict[str, Any]:
    """What a workspace is made from."""
    return {"version": 1, "options": asdict(options), **originals.fingerprint()}


def _undistort(originals: Originals, names: list[str], scratch: Path, options: UndistortionOptions) -> list[str]:
    """Let COLMAP undistort images `names` into `scratch`; return the names that came out well."""
    model_dir = originals.model_dir
    # What is read here may be more than COLMAP itself would read of a text model.
    if replace_ideal_fisheyes(originals.model) or is_text(model_files(model_dir)):
        model_dir = scratch / "model"
        make_dir(model_dir)
        originals.model.write_binary(model_dir)
    logger.info("Undistorting %d images", len(names))
    try:
        with quiet_colmap():
            pycolmap.undistort_images(
                scratch,
                model_dir,
                originals.image_dir,
                image_names=names,
                undistort_options=options.for_colmap(),
            )
    except (RuntimeError, ValueError, OSError) as error:
        _raise_if_disk_is_full(scratch)
        raise InputError(f"COLMAP cannot undistort the images of {model_dir}: {reason_of(error)}") from error
    return _mend_workspace(Workspace(scratch), names)


def _undistort_masks(originals: Originals, names: list[str], scratch: Path, options: UndistortionOptions) -> None:
    """Undistort the masks of images `names` into `scratch`."""
    if originals.mask_dir is None:
        return
    logger.info("Undistorting %d masks", len(names))
    cameras = cameras_of_images(originals.model)
    for name in names:
        target = Workspace(scratch).mask_path(name)
        undistort_mask(mask_path(originals.mask_dir, name), cameras[name], options.for_colmap(), target)


def _mend_workspace(workspace: Workspace, names: list[str]) -> list[str]:
    """Leave only undistorted images and PINHOLE cameras in the model; write the configuration for them."""
    model = _load_written_model(workspace)
    cameras = cameras_of_images(model)
    kept = []
    for name in names:
        problem = image_problem(workspace.image_path(name), cameras[name].width, cameras[name].height)
        if problem is None:
            kept.append(name)
        else:
            _raise_if_disk_is_full(workspace.root)
            logger.warning("%s could not be undistorted: the result %s; left out", name, problem)
    if not kept:
        raise InputError("COLMAP could not undistort any of the images; see its messages above.")
    if len(kept) < model.num_reg_images():
        model = submodel(model, set(kept))
    for camera in model.cameras.values():
        make_pinhole(camera)
    shutil.rmtree(workspace.sparse_dir)
    make_dir(workspace.sparse_dir)
    model.write_binary(workspace.sparse_dir)
    _load_written_model(workspace)
    write_fusion_cfg(workspace.fusion_cfg_path, kept)
    write_patch_match_cfg(workspace.patch_match_cfg_path, dict.fromkeys(kept, 20))
    return kept


def _check_space(originals: Originals, names: list[str], output: Path, options: UndistortionOptions) -> None:
    """Raise `OutputError` unless the undistorted images will fit: COLMAP may not notice a full disk."""
    needed = sum(path.stat().st_size for path in model_files(originals.model_dir))
    cameras = cameras_of_images(originals.model)
    limit = options.max_image_size
    for name in names:
        longest = max(cameras[name].width, cameras[name].height)
        scale = min(1.0, limit / longest) if limit > 0 else 1.0
        needed += int(scale**2 * (originals.image_dir / name).stat().st_size)
    needed *= _SPACE_FACTOR
    free = free_space(output)
    if free < needed:
        raise OutputError(
            f"The undistorted images need about {needed / 1e6:.0f} MB, but on the disk of {output} only "
            f"{free / 1e6:.0f} MB are free; free some space or choose another --output."
        )


def _load_written_model(workspace: Workspace) -> pycolmap.Reconstruction:
    """Read a model that COLMAP has just written, without noticing whether the disk took it."""
    try:
        return load_model(workspace.sparse_dir)
    except InputError:
        _raise_if_disk_is_full(workspace.root)
        raise


def _raise_if_disk_is_full(folder: Path) -> None:
    if free_space(folder) < _FULL_DISK_BYTES:
        raise OutputError(f"The disk of {folder} is full; free some space or choose another --output.")
