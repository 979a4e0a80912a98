"""One original image → its undistorted one, and the same for its mask."""

from dataclasses import dataclass
from pathlib import Path

import pycolmap

from colmap_sph.errors import InputError
from colmap_sph.project.cameras import undistorted_camera
from colmap_sph.project.colmap_library import quiet_colmap
from colmap_sph.project.images.depth import ValueRange
from colmap_sph.project.images.orientation import copy_without_orientation
from colmap_sph.project.images.reading import image_problem
from colmap_sph.project.images.undistorting import undistort_bent, undistort_deep, write_undistorted
from colmap_sph.project.lens.field import LensField
from colmap_sph.project.lens.straight import straight_camera
from colmap_sph.project.masks import undistort_mask
from colmap_sph.project.undistortion.options import UndistortionOptions
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.cutting import cut_image


@dataclass(frozen=True, eq=False)
class ImageToUndistort:
    """An image, its camera, and where what is made of it goes.

    Attributes
    ----------
    source : Path
        Original image, which is whole and of its camera's size.
    values : ValueRange or None
        What becomes black and white, of an image of more than 8 bits.
    mask : Path or None
        Its mask, if there is one.
    camera : pycolmap.Camera
        Of the original image; see `cameras.plain_camera`.
    options : UndistortionOptions
    folder : Path
        Where the undistorted image is written, under the name of `source` without its folders.
    mask_folder : Path
        Where its mask is, as ``NAME.png``.
    field : LensField or None
        Of its camera.
    cut : Cut or None
        The view to cut from it instead, where it is wide.
    """

    source: Path
    values: ValueRange | None
    mask: Path | None
    camera: pycolmap.Camera
    options: UndistortionOptions
    folder: Path
    mask_folder: Path
    field: LensField | None = None
    cut: Cut | None = None

    @property
    def image_path(self) -> Path:
        """The undistorted image."""
        return self.folder / self.source.name

    @property
    def mask_path(self) -> Path:
        """Its mask."""
        return self.mask_folder / f"{self.source.name}.png"

    @property
    def has_mask(self) -> bool:
        """Whether a mask is made: with every view that is cut, as these show what is beyond the lens, too."""
        return self.mask is not None or self.cut is not None

    @property
    def undistorted_size(self) -> tuple[int, int]:
        """Width and height of what is made."""
        if self.cut is not None:
            return self.cut.face.width, self.cut.face.height
        return self.undistorted_camera.width, self.undistorted_camera.height

    @property
    def undistorted_camera(self) -> pycolmap.Camera:
        """Camera of the undistorted image."""
        return straight_camera(self.camera, self.options.for_colmap(), self.field)

    @property
    def is_colmaps(self) -> bool:
        """Whether COLMAP undistorts it: not what is copied or cut, has more than 8 bits or a lens field."""
        if self.values is not None or self.field is not None or self.cut is not None:
            return False
        return undistorted_camera(self.camera, self.options.for_colmap()) is not None


def undistort(task: ImageToUndistort) -> None:
    """Undistort an image and its mask.

    Raises
    ------
    InputError
        The image cannot be read, or the mask does not fit.
    OutputError
        A file cannot be written.
    """
    if task.cut is not None:
        cut_image(task.source, task.mask, task.cut, task.values, task.image_path, task.mask_path)
        return
    options = task.options.for_colmap()
    if task.values is not None:
        undistort_deep(task.source, task.camera, options, task.image_path, task.values, task.field)
    elif task.field is not None:
        undistort_bent(task.source, task.camera, options, task.image_path, task.field)
    elif task.is_colmaps:
        _undistort_by_colmap(task)
    else:
        copy_without_orientation(task.source, task.image_path)
    if task.is_colmaps:
        _check(task)
    if task.mask is not None:
        undistort_mask(task.mask, task.camera, options, task.mask_path, task.field)


def _check(task: ImageToUndistort) -> None:
    """Make sure that COLMAP has written the image: it may not notice a full disk."""
    problem = image_problem(task.image_path, task.undistorted_camera.width, task.undistorted_camera.height)
    if problem is not None:
        raise InputError(f"{task.source} could not be undistorted: the result {problem}.")


def _undistort_by_colmap(task: ImageToUndistort) -> None:
    with quiet_colmap():
        original = pycolmap.Bitmap.read(task.source, as_rgb=True)
        if original is None:
            raise InputError(f"COLMAP cannot read {task.source}; convert it to JPEG or PNG.")
        image, _ = pycolmap.undistort_image(task.options.for_colmap(), original, task.camera)
        write_undistorted(image, task.source, task.image_path)
