"""Masks: parts of images that take no part, such as sky, water, whatever moves, or the vehicle itself.

As for COLMAP's feature extraction, the mask of ``a/b.jpg`` is ``a/b.jpg.png`` in the folder of masks, or
``a/b.png``; it has the size of its image and is black where the image is to be ignored. An image without a mask is
used whole.
"""

import logging
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError, counted, reason_of
from colmap_sph.project.files import atomic_file, make_dir, real_path
from colmap_sph.project.given.image_places import files_below, other_spellings, told_from
from colmap_sph.project.images.decoding import read_pixels
from colmap_sph.project.images.jpeg import DamagedError
from colmap_sph.project.images.reading import fitted, image_problem
from colmap_sph.project.images.undistorting import undistorted_pixels
from colmap_sph.project.lens.field import LensField
from colmap_sph.project.workspace import mask_path
from colmap_sph.scene import View

logger = logging.getLogger(__name__)

# So many names are told of more that are as odd.
_NAMES_TOLD = 3
_NO_MASKS = {"Thumbs.db", "desktop.ini"}


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
    problem = image_problem(path, width, height, decode=False)
    if problem is not None:
        raise _unusable(path, problem.replace("its camera", "its image"))
    try:
        pixels = read_pixels(path)
    except OSError as error:
        raise _unusable(path, f"cannot be read ({reason_of(error)})") from error
    except DamagedError as error:
        raise _unusable(path, f"is damaged or no image ({error})") from error
    return np.where((pixels != 0).any(axis=2), np.uint8(255), np.uint8(0))


def read_view_mask(path: Path, view: View) -> NDArray[np.uint8] | None:
    """Do what `read_mask` does for a view's image; of a reduced view a pixel counts where all of it does."""
    mask = read_mask(path, *view.file_size)
    if mask is None or view.full_size is None:
        return mask
    return np.where(fitted(mask, (view.width, view.height)) == 255, np.uint8(255), np.uint8(0))


def _unusable(path: Path, problem: str) -> InputError:
    return InputError(f"The mask {path} {problem}; mend or remove it.")


def check_masks(
    folder: Path, cameras: Mapping[str, pycolmap.Camera], image_dir: Path, others: Iterable[str] = ()
) -> list[str]:
    """Make sure that a folder's masks can be used; return the names of the images that have one.

    Masks of no image, and images without one among others that have one, are reported by a warning.

    Parameters
    ----------
    folder : Path
    cameras : mapping of str to pycolmap.Camera
        That of each image, by its name.
    image_dir : Path
        Where the images are: it may be the same folder.
    others : iterable of str
        Further images, which are left out; their masks are not looked at.

    Raises
    ------
    InputError
        The folder does not exist or holds no mask for any of the images, or a mask cannot be read, is not of its
        image's size, is the image itself, or is called as its image's in another spelling.
    """
    if not folder.is_dir():
        raise InputError(f"The mask folder {folder} does not exist; check --masks.")
    if real_path(folder) == real_path(image_dir):
        _refuse_images(folder, cameras)
    masked = [
        name
        for name, camera in cameras.items()
        if read_mask(mask_path(folder, name), camera.width, camera.height) is not None
    ]
    check_mask_names(folder, cameras, image_dir, others)
    bare = sorted(set(cameras) - set(masked))
    if bare:
        they_are = "it is" if len(bare) == 1 else "they are"
        logger.warning("No mask in %s for %s: %s used whole", folder, _told(bare, "image"), they_are)
    return masked


def _refuse_images(folder: Path, names: Iterable[str]) -> None:
    """Raise `InputError` where images in a folder would be taken for their own masks: PNGs without any."""
    for name in names:
        if mask_path(folder, name) == folder / name:
            raise InputError(
                f"--masks {folder} is the folder of the images, and has no mask of {name}, which would count as "
                "its own; give a folder of masks alone."
            )


def check_mask_names(folder: Path, names: Collection[str], image_dir: Path, others: Iterable[str] = ()) -> None:
    """Do what `check_masks` does of the names of masks alone: warn of files that belong to no image.

    Raises
    ------
    InputError
        There is no mask for any of the images `names`, or one is called as an image's in another spelling.
    """
    masks = {name: mask_path(folder, name) for name in [*names, *others]}
    missing = [name for name, mask in masks.items() if not mask.exists()]
    unused = _unused_masks(folder, masks, image_dir)
    _refuse_misspelled(folder, missing, unused)
    if set(names) <= set(missing):
        name = min(names)
        raise InputError(f"{folder} holds no mask for any image; that of {name} must be {folder / name}.png.")
    _warn_of_unused(folder, unused)


def _unused_masks(folder: Path, masks: Mapping[str, Path], image_dir: Path) -> list[str]:
    """Files in a folder of masks that belong to none of the images; none where there is much that is no mask."""
    known = set(masks.values())
    if real_path(folder) == real_path(image_dir):
        known |= {folder / name for name in masks}
    files = (PurePosixPath(file) for file in sorted(files_below(folder, len(masks)) or []))
    named = (file for file in files if not file.name.startswith(".") and file.name not in _NO_MASKS)
    unused = [str(file) for file in named if folder / file not in known and (folder / file).is_file()]
    used = [path.relative_to(folder).as_posix() for path in known if path.exists()]
    spelled = other_spellings(unused, used)
    # Where the file system takes both spellings for one, it may list the other one.
    same = {there for right, there in spelled.items() if (folder / there).samefile(folder / right)}
    return [file for file in unused if file not in same]


def _refuse_misspelled(folder: Path, missing: Collection[str], unused: Iterable[str]) -> None:
    """Raise `InputError` for a mask that would not be used, as its image is spelled in another way."""
    wanted = [f"{name}.png" for name in missing]
    wanted += [str(PurePosixPath(name).with_suffix(".png")) for name in missing if PurePosixPath(name).suffix]
    spelled = other_spellings(unused, wanted)
    if spelled:
        right, there = min(spelled.items())
        raise InputError(
            f"The mask {told_from(right, there)} in {folder} would not be used, as its image's is called "
            f"{told_from(there, right)} (so for {counted(len(spelled), 'mask')}); rename the masks as "
            "their images."
        )


def _warn_of_unused(folder: Path, unused: list[str]) -> None:
    if unused:
        belong = "belongs" if len(unused) == 1 else "belong"
        logger.warning(
            "%s %s to no image: masks are called as their images, with .png after or in place of the ending",
            _told(unused, "file", f" in {folder}"),
            belong,
        )


def _told(names: list[str], kind: str, place: str = "") -> str:
    """Some names, and how many there are."""
    if len(names) == 1:
        return f"the {kind} {names[0]}{place}"
    some = ", ".join(names[:_NAMES_TOLD])
    more = ", …" if len(names) > _NAMES_TOLD else ""
    return f"{len(names)} {kind}s{place} ({some}{more})"


def undistort_mask(
    source: Path,
    camera: pycolmap.Camera,
    options: pycolmap.UndistortCameraOptions,
    target: Path,
    field: LensField | None = None,
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
    field : LensField, optional
        Of this camera.

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
    if field is None:
        undistorted = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(mask), camera)[0].to_array()
    else:
        undistorted = undistorted_pixels(mask[:, :, None], camera, options, field)[:, :, 0]
    whole = np.where(undistorted == 255, np.uint8(255), np.uint8(0))
    make_dir(target.parent)
    with atomic_file(target) as file:
        file.write(cv2.imencode(".png", whole)[1].tobytes())
