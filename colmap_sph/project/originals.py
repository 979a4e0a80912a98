"""What is to be undistorted: a sparse model, its images and their masks, found and checked."""

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from colmap_sph.errors import InputError
from colmap_sph.project.cameras import refuse_panoramas
from colmap_sph.project.given.image_places import find_images, tell_problems
from colmap_sph.project.images import image_problem
from colmap_sph.project.masks import check_masks
from colmap_sph.project.project import Project
from colmap_sph.project.sparse_model import cameras_of_images, image_names, load_model, model_files
from colmap_sph.project.workspace import checked_name


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
        masks = None if self.mask_dir is None else _hash_times(self.mask_dir, [f"{name}.png" for name in names])
        return {"model": _hash_model(self.model_dir), "images": _hash_times(self.image_dir, names), "masks": masks}

    def usable(self) -> Usable:
        """Find the images to undistort; the others are reported by a warning.

        Raises
        ------
        InputError
            No image is usable, or a mask does not fit its image.
        """
        cameras = cameras_of_images(self.model)
        found = {
            name: image_problem(self.image_dir / checked_name(name), camera.width, camera.height)
            for name, camera in sorted(cameras.items())
        }
        problems = {name: problem for name, problem in found.items() if problem is not None}
        tell_problems(self.model_dir, self.image_dir, problems, len(cameras), undistorted=False)
        good = {name: camera for name, camera in sorted(cameras.items()) if name not in problems}
        return Usable(list(good), [] if self.mask_dir is None else check_masks(self.mask_dir, good))


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


def _hash_model(model_dir: Path) -> str:
    digest = hashlib.sha256()
    for path in model_files(model_dir):
        with path.open("rb") as file:
            digest.update(path.name.encode() + hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _hash_times(folder: Path, names: list[str]) -> str:
    """Hash names, sizes and times of images: their content would take as long to read as to undistort."""
    digest = hashlib.sha256()
    for name in names:
        with suppress(OSError):
            status = (folder / name).stat()
            digest.update(f"{name}\n{status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()
