"""One original image → its undistorted one, and the same for its mask."""

from dataclasses import dataclass
from pathlib import Path

import pycolmap

from colmap_sph.errors import InputError
from colmap_sph.project.cameras import undistorted_camera
from colmap_sph.project.colmap_library import quiet_colmap
from colmap_sph.project.images import image_problem
from colmap_sph.project.masks import undistort_mask
from colmap_sph.project.undistortion.options import UndistortionOptions


@dataclass(frozen=True, eq=False)
class ImageToUndistort:
    """An image, its camera, and where what is made of it goes.

    Attributes
    ----------
    source : Path
        Original image, which is whole and of its camera's size.
    mask : Path or None
        Its mask, if there is one.
    camera : pycolmap.Camera
        Of the original image.
    options : UndistortionOptions
    folder : Path
        Where the undistorted image is written, under the name of `source` without its folders.
    mask_folder : Path
        Where its mask is, as ``NAME.png``.
    """

    source: Path
    mask: Path | None
    camera: pycolmap.Camera
    options: UndistortionOptions
    folder: Path
    mask_folder: Path

    @property
    def image_path(self) -> Path:
        """The undistorted image."""
        return self.folder / self.source.name

    @property
    def mask_path(self) -> Path:
        """Its mask."""
        return self.mask_folder / f"{self.source.name}.png"


def undistort(task: ImageToUndistort) -> None:
    """Undistort an image and its mask, both by COLMAP.

    Raises
    ------
    InputError
        COLMAP cannot read the image or write the result, or the mask does not fit.
    """
    camera = undistorted_camera(task.camera, task.options.for_colmap())
    if camera is None:
        task.image_path.write_bytes(task.source.read_bytes())
    else:
        with quiet_colmap():
            _undistort(task)
        problem = image_problem(task.image_path, camera.width, camera.height)
        if problem:
            raise InputError(f"{task.source} could not be undistorted: the result {problem}.")
    if task.mask is not None:
        undistort_mask(task.mask, task.camera, task.options.for_colmap(), task.mask_path)


def _undistort(task: ImageToUndistort) -> None:
    original = pycolmap.Bitmap.read(task.source, as_rgb=True)
    if original is None:
        raise InputError(f"COLMAP cannot read {task.source}; convert it to JPEG or PNG.")
    image, _ = pycolmap.undistort_image(task.options.for_colmap(), original, task.camera)
    if not image.write(task.image_path):
        raise InputError(f"COLMAP cannot write an image called {task.source.name}; rename it in the model, too.")
