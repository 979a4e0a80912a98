"""What `surface`, `mesh` and `export` have made in a workspace → their files with sizes, and small pictures."""

import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np

from colmap_sph.errors import InputError, counted
from colmap_sph.pages.pictures import picture_uri
from colmap_sph.platforms.files import is_link
from colmap_sph.project.images.decoding import read_header
from colmap_sph.project.images.jpeg import DamagedError
from colmap_sph.project.images.reading import read_colours
from colmap_sph.project.workspace import PREVIEW_PREFIX, PREVIEW_SIDE, Workspace

# Of a folder, and of a folder in it.
_MOST_FILES = 40
_MOST_COUNTED = 100_000
_MOST_PICTURES = 6
_PICTURE_BYTES = 80_000


@dataclass(frozen=True)
class ProductFile:
    """A product: a file, or a folder of files.

    Attributes
    ----------
    name : str
        Its path in the workspace.
    link : str
        From the page's folder, percent-encoded.
    size : str
    """

    name: str
    link: str
    size: str


@dataclass(frozen=True)
class ProductPicture:
    """A small picture of a product, and what it shows."""

    name: str
    uri: str
    width: int
    height: int


def products_of(workspace: Workspace) -> tuple[list[ProductFile], list[ProductPicture]]:
    """Products in their usual folders of a workspace, by name; links are not followed."""
    files: list[ProductFile] = []
    pictures: list[ProductPicture] = []
    for folder in workspace.product_dirs:
        for entry in _entries(folder):
            if not entry.name.startswith(PREVIEW_PREFIX):
                files.append(_file(workspace, Path(entry.path), _size(entry)))
            elif len(pictures) < _MOST_PICTURES and (picture := _picture(entry)) is not None:
                pictures.append(picture)
    return files, pictures


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    """Files and folders that are not hidden; none where the folder is a link or cannot be read."""
    with suppress(OSError):
        if not is_link(folder) and folder.is_dir():
            with os.scandir(folder) as found:
                shown = [each for each in found if not each.name.startswith(".") and not is_link(Path(each.path))]
            return sorted(shown, key=lambda entry: entry.name)[:_MOST_FILES]
    return []


def _file(workspace: Workspace, path: Path, size: str) -> ProductFile:
    name = path.relative_to(workspace.root).as_posix()
    return ProductFile(name, "../" + quote(os.fsencode(name)), size)


def _size(entry: os.DirEntry[str]) -> str:
    """Such as 1.2 MB; of a folder also its number of files."""
    with suppress(OSError):
        if not entry.is_dir(follow_symlinks=False):
            return _bytes(entry.stat(follow_symlinks=False).st_size)
        sizes = list(_sizes(Path(entry.path)))
        more = "more than " if len(sizes) == _MOST_COUNTED else ""
        return f"{more}{counted(len(sizes), 'file')}, {_bytes(sum(sizes))}"
    return "cannot be read"


def _sizes(folder: Path) -> Iterator[int]:
    count = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            found = (Path(parent) / name).lstat()
            if stat.S_ISREG(found.st_mode):
                yield found.st_size
                count += 1
                if count == _MOST_COUNTED:
                    return


def _bytes(size: int) -> str:
    value = float(size)
    for unit in ("bytes", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:,.3g} TB"


def _picture(entry: os.DirEntry[str]) -> ProductPicture | None:
    """None where it is no small image."""
    path = Path(entry.path)
    with suppress(InputError, DamagedError, OSError):
        if not entry.is_file(follow_symlinks=False):
            return None
        header = read_header(path)
        if max(header.width, header.height) <= PREVIEW_SIDE:
            colours = np.asarray(cv2.cvtColor(read_colours(path), cv2.COLOR_BGR2RGB), np.uint8)
            words = path.stem.removeprefix(PREVIEW_PREFIX).replace("_", " ")
            return ProductPicture(words, picture_uri(colours, _PICTURE_BYTES), header.width, header.height)
    return None
