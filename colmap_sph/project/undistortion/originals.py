"""What is to be undistorted: a sparse model, its images and their masks, found."""

import hashlib
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap

from colmap_sph.errors import InputError
from colmap_sph.project.files import real_path
from colmap_sph.project.given.image_places import find_images
from colmap_sph.project.given.poses import check_points_in_front
from colmap_sph.project.lens.field import LensField
from colmap_sph.project.lens.files import LENS_FIELDS_NAME, read_lens_fields
from colmap_sph.project.map_coordinates import check_size
from colmap_sph.project.project import Project
from colmap_sph.project.sparse_model import cameras_of_images, image_names, load_model, model_files
from colmap_sph.project.undistortion.options import UndistortionOptions
from colmap_sph.project.wide.cuts import NO_CUTS, Cuts
from colmap_sph.project.workspace import Workspace, checked_name, mask_path

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Originals:
    """A sparse model, its images, and their masks.

    Attributes
    ----------
    model_dir, image_dir : Path
    mask_dir : Path or None
        None: without masks.
    model : pycolmap.Reconstruction
        What is in `model_dir`.
    fields : mapping of int to LensField
        What lenses do beyond their camera models, by camera id.
    cuts : Cuts
        What is cut from wide images.
    """

    model_dir: Path
    image_dir: Path
    mask_dir: Path | None
    model: pycolmap.Reconstruction
    fields: Mapping[int, LensField] = field(default_factory=dict)
    cuts: Cuts = NO_CUTS

    def model_digest(self) -> str:
        """Digest of the content of the model's files."""
        digest = hashlib.sha256()
        lens_fields = [self.model_dir / LENS_FIELDS_NAME] if self.fields else []
        for path in [*model_files(self.model_dir), *lens_fields]:
            with path.open("rb") as file:
                digest.update(path.name.encode() + hashlib.file_digest(file, "sha256").digest())
        return digest.hexdigest()

    def image_path(self, name: str) -> Path:
        """Original image `name`; need not exist."""
        return self.image_dir / checked_name(name)

    def mask_of(self, name: str) -> Path | None:
        """Mask of original image `name`, if there is one."""
        path = None if self.mask_dir is None else mask_path(self.mask_dir, name)
        return path if path is not None and path.is_file() else None

    def check_outside(self, workspace: Workspace) -> None:
        """Raise `InputError` where the model, the images or the masks lie where a workspace is to be written.

        And where a new workspace would lie among the images: COLMAP takes all pictures below a folder of images
        for originals. Where the model lies there, too, that folder is the whole project.
        """
        root = real_path(workspace.root)
        for option, place in (("model", self.model_dir), ("images", self.image_dir), ("masks", self.mask_dir)):
            if place is not None and real_path(place).is_relative_to(root):
                raise InputError(
                    f"--{option} {place} lies inside the workspace {workspace.root} that is to be written; choose "
                    "another --output."
                )
        for path in self._files():
            if real_path(path).is_relative_to(root):
                raise InputError(
                    f"{path} is a link into the workspace {workspace.root} that is to be written; choose another "
                    "--output."
                )

        folder = real_path(self.image_dir)
        is_among = root.is_relative_to(folder) and not real_path(self.model_dir).is_relative_to(folder)
        if is_among and not workspace.marker_path.exists():
            raise InputError(
                f"The workspace {workspace.root} would lie in {self.image_dir}, where COLMAP would take its "
                "images for originals; choose another --output."
            )

    def _files(self) -> Iterator[Path]:
        """The files of model, images and masks."""
        yield from model_files(self.model_dir)
        for name in image_names(self.model):
            yield self.image_path(name)
            mask = self.mask_of(name)
            if mask is not None:
                yield mask


def read_originals(project: Project, options: UndistortionOptions) -> Originals:
    """Read a project's sparse model; where its images are is found out, if not given.

    Parameters
    ----------
    project : Project
        With a model.
    options : UndistortionOptions

    Returns
    -------
    Originals

    Raises
    ------
    InputError
        No readable model, one in an impossible unit, points behind its images, no camera with pixels and possible
        focal lengths, one that is no lens, damaged lens fields, or no images.
    """
    assert project.model is not None
    model = load_model(project.model)
    check_size(model, project.model)
    check_points_in_front(model, project.model)
    _check_cameras(model, project.model)
    _tell_newer_text(project.model)
    images = project.images
    if images is None:
        images = find_images(project.model, image_names(model))
    elif not images.is_dir():
        is_file = images.is_file()
        raise InputError(
            f"The image folder {images} {'is a file' if is_file else 'does not exist'}; check --images."
        )
    fields = read_lens_fields(project.model)
    return Originals(project.model, images, project.masks, model, fields, options.cuts(model, project.model))


def _check_cameras(model: pycolmap.Reconstruction, model_dir: Path) -> None:
    """Raise `InputError` where no image has a camera with pixels and focal lengths above 0; of some, it is told
    later."""
    fault = ""
    for camera in cameras_of_images(model).values():
        focal = np.array(camera.params)[list(camera.focal_length_idxs())]
        has_pixels = min(camera.width, camera.height) > 0
        if has_pixels and (focal > 0).all():
            return
        words = (
            " and ".join(f"{length:g}" for length in focal) if has_pixels else f"{camera.width} x {camera.height}"
        )
        fault = fault or f"camera {camera.camera_id}: {words} pixels"
    raise InputError(
        f"No image of the model in {model_dir} has a camera with a possible size and focal lengths ({fault}); run "
        "COLMAP's mapper again, or give the model as it was made."
    )


def _tell_newer_text(model_dir: Path) -> None:
    """Warn of text files, maybe edited, that are not read, as there are binary ones."""
    binary = [path for path in model_files(model_dir) if path.suffix == ".bin"]
    text = [path.with_suffix(".txt") for path in binary if path.with_suffix(".txt").is_file()]
    newest = max((path.stat().st_mtime for path in binary), default=0.0)
    newer = [path.name for path in text if path.stat().st_mtime > newest]
    if newer:
        logger.warning(
            "%s has binary and text files, and as by COLMAP the binary ones are read, though newer are %s; delete "
            "the binary ones if the text is meant",
            model_dir,
            ", ".join(newer),
        )
