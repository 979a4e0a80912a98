"""Masks: parts of images that take no part, such as sky, water, whatever moves, or the vehicle itself.

As for COLMAP's feature extraction, the mask of ``a/b.jpg`` is ``a/b.jpg.png`` in the folder of masks; it has the
size of its image and is black where the image is to be ignored. An image without a mask is used whole.
"""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.workspace import mask_path


def read_mask(path: Path, width: int, height: int) -> NDArray[np.uint8] | None:
    """Read a mask.

    Parameters
    ----------
    path : Path
    width, height : int
        Size it must have: that of its image.

    Returns
    -------
    (height, width) uint8 ndarray or None
        255 where the image counts, 0 where it is to be ignored; None where there is no such file.

    Raises
    ------
    InputError
        The file is not an image, or not of this size.
    """
    if not path.exists():
        return None
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    mask = cv2.imread(str(path), flags) if path.is_file() else None
    if mask is None:
        raise InputError(f"The mask {path} cannot be read as an image; mend or remove it.")
    if mask.shape != (height, width):
        raise InputError(
            f"The mask {path} has {mask.shape[1]} x {mask.shape[0]} pixels, but its image {width} x {height}; "
            "mend or remove it."
        )
    return np.where(mask > 0, np.uint8(255), np.uint8(0))


def check_masks(folder: Path, cameras: Mapping[str, pycolmap.Camera]) -> list[str]:
    """Make sure that a folder's masks can be used; return the names of the images that have one.

    Parameters
    ----------
    folder : Path
    cameras : mapping of str to pycolmap.Camera
        That of each image, by its name.

    Raises
    ------
    InputError
        The folder does not exist or holds no mask for any of the images, or a mask cannot be read or is not of
        its image's size.
    """
    if not folder.is_dir():
        raise InputError(f"The mask folder {folder} does not exist; check --masks.")
    masked = [
        name
        for name, camera in cameras.items()
        if read_mask(mask_path(folder, name), camera.width, camera.height) is not None
    ]
    if not masked:
        name = min(cameras)
        raise InputError(f"{folder} holds no mask for any image; that of {name} must be {folder / name}.png.")
    return masked


def undistort_mask(
    source: Path, camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions, target: Path
) -> None:
    """Undistort a mask as COLMAP undistorts its image.

    Parameters
    ----------
    source, target : Path
        The mask, and the undistorted one to write: white only where no ignored pixel, and no pixel outside of the
        original image, has a part in the undistorted one.
    camera : pycolmap.Camera
        Of the original image.
    options : pycolmap.UndistortCameraOptions
        With which the image is undistorted.

    Raises
    ------
    InputError
        The mask cannot be read or is not of the camera's size.
    OutputError
        `target` cannot be written.
    """
    mask = read_mask(source, camera.width, camera.height)
    if mask is None:
        raise InputError(f"The mask {source} has disappeared; start again.")
    undistorted, _ = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(mask), camera)
    whole = np.where(undistorted.to_array() == 255, np.uint8(255), np.uint8(0))
    make_dir(target.parent)
    with atomic_file(target) as file:
        file.write(cv2.imencode(".png", whole)[1].tobytes())
