"""What is to be undistorted: a sparse model, its images and their masks, found and checked."""

import hashlib
import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from colmap_sph.errors import InputError
from colmap_sph.project.cameras import refuse_panoramas
from colmap_sph.project.images.reading import image_problem
from colmap_sph.project.masks import check_masks
from colmap_sph.project.project import Project
from colmap_sph.project.sparse_model import cameras_of_images, image_names, load_model, model_files
from colmap_sph.project.workspace import checked_name, mask_path

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Usable:
    """Sorted names of the images that are fit for undistortion, and of those of them that have a mask."""

    images: list[str]
    masked: list[str]


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
    """

    model_dir: Path
    image_dir: Path
    mask_dir: Path | None
    model: pycolmap.Reconstruction

    def fingerprint(self) -> dict[str, str | None]:
        """Hash of the model's content, and of names, sizes and times of images and masks."""
        names = image_names(self.model)
        masks = (
            None
            if self.mask_dir is None
            else _hash_times(
                self.mask_dir, [str(mask_path(self.mask_dir, name).relative_to(self.mask_dir)) for name in names]
            )
        )
        return {"model": _hash_model(self.model_dir), "images": _hash_times(self.image_dir, names), "masks": masks}

    def usable(self) -> Usable:
        """Find the images to undistort; the others are reported by a warning.

        Raises
        ------
        InputError
            No image is usable, or a mask does not fit its image.
        """
        cameras = cameras_of_images(self.model)
        good = {}
        for name, camera in sorted(cameras.items()):
            path = self.image_dir / checked_name(name)
            problem = image_problem(path, camera.width, camera.height)
            if problem is None:
                good[name] = camera
            else:
                logger.warning("%s %s; left out", path, problem)
        if not good:
            raise InputError(
                f"None of the model's {len(cameras)} images in {self.image_dir} is usable; check --images."
            )
        return Usable(
            list(good), [] if self.mask_dir is None else check_masks(self.mask_dir, good, self.image_dir, cameras)
        )


def read_originals(project: Project) -> Originals:
    """Read a project's sparse model; where its images are is found out, if not given.

    Parameters
    ----------
    project : Project
        With a model.

    Returns
    -------
    Originals

    Raises
    ------
    InputError
        No readable model, a camera without pinhole equivalent, or no images.
    """
    assert project.model is not None
    model = load_model(project.model)
    refuse_panoramas(model)
    images = project.images
    if images is None:
        images = find_images(project.model, image_names(model))
    elif not images.is_dir():
        is_file = images.is_file()
        raise InputError(
            f"The image folder {images} {'is a file' if is_file else 'does not exist'}; check --images."
        )
    return Originals(project.model, images, project.masks, model)


def find_images(model_dir: Path, names: Sequence[str]) -> Path:
    """Find the image folder of a model by COLMAP's usual layouts.

    For the model ``X/sparse/0`` these are ``X/images``, ``X/sparse/images`` and ``X/sparse/0/images``. The
    folder that holds most of the model's images is taken, the first among equals.

    Raises
    ------
    InputError
        None of the folders holds any image of the model; the message lists them.
    """
    # Of a link to a model both where it is and where it leads to.
    places = (Path.cwd() / model_dir, model_dir.resolve())
    parents = [p for model in places for p in (model.parent.parent, model.parent, model)]
    folders = list(dict.fromkeys(parent / "images" for parent in parents))
    found = [sum((folder / name).is_file() for name in names) for folder in folders]
    if max(found) == 0:
        tried = ", ".join(str(folder) for folder in folders)
        raise InputError(f"The images of {model_dir} were not found in {tried}; give their folder as --images.")
    return folders[found.index(max(found))]


def _hash_model(model_dir: Path) -> str:
    digest = hashlib.sha256()
    for path in model_files(model_dir):
        with path.open("rb") as file:
            digest.update(path.name.encode() + hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _mask_names(folder: Path, names: list[str]) -> list[str]:
    return [str(mask_path(folder, name).relative_to(folder)) for name in names]


def _hash_times(folder: Path, names: list[str]) -> str:
    """Hash names, sizes and times of images: their content would take as long to read as to undistort."""
    digest = hashlib.sha256()
    for name in names:
        with suppress(OSError):
            status = (folder / name).stat()
            digest.update(f"{name}\n{status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()
