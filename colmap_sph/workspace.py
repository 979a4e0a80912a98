"""COLMAP's dense workspace: where things lie, and its depth map, normal map and configuration files.

Map files are ASCII ``width&height&channels&`` followed by little-endian float32, plane after plane. The code
is our own because ``pycolmap.NormalMap`` (4.2.1) writes interleaved memory as if it were planar.
"""

import os
import re
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OutputError

MapKind = Literal["photometric", "geometric"]
SourceImages = list[str] | int | Literal["__all__"]

# What a file system takes, less the longest ending: ``.photometric.json``.
_MAX_NAME_BYTES = 255 - 17
_MAX_HEADER = 30
_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")


@dataclass(frozen=True)
class Workspace:
    """Paths of one dense workspace.

    Attributes
    ----------
    root : Path
        The workspace's folder, usually called ``dense``.
    given_masks : Path, optional
        Where the masks of its images are, if not in the workspace itself.
    """

    root: Path
    given_masks: Path | None = None

    @property
    def images_dir(self) -> Path:
        """Undistorted images."""
        return self.root / "images"

    @property
    def sparse_dir(self) -> Path:
        """Sparse model of the undistorted images."""
        return self.root / "sparse"

    @property
    def stereo_dir(self) -> Path:
        """Depth maps, normal maps and COLMAP's configuration files."""
        return self.root / "stereo"

    @property
    def fused_path(self) -> Path:
        """The fused point cloud."""
        return self.root / "fused.ply"

    @property
    def fusion_cfg_path(self) -> Path:
        """Names of the images that take part in fusion."""
        return self.stereo_dir / "fusion.cfg"

    @property
    def patch_match_cfg_path(self) -> Path:
        """Source images of every reference image."""
        return self.stereo_dir / "patch-match.cfg"

    @property
    def state_dir(self) -> Path:
        """Our own state, report and log, which COLMAP never looks at."""
        return self.root / "colmap_sph"

    @property
    def local_dir(self) -> Path:
        """For a model in map coordinates: a workspace near its origin, for COLMAP's own programs to go on."""
        return self.state_dir / "local"

    def image_path(self, name: str) -> Path:
        """Undistorted image `name`."""
        return self.images_dir / _checked_name(name)

    @property
    def masks_dir(self) -> Path:
        """Masks of the undistorted images; need not exist."""
        return self.given_masks or self.root / "masks"

    def mask_path(self, name: str) -> Path:
        """Mask of undistorted image `name`; need not exist."""
        return mask_path(self.masks_dir, name)

    def depth_map_path(self, name: str, kind: MapKind) -> Path:
        """Depth map of image `name`."""
        return self.stereo_dir / "depth_maps" / f"{_checked_name(name)}.{kind}.bin"

    def normal_map_path(self, name: str, kind: MapKind) -> Path:
        """Normal map of image `name`."""
        return self.stereo_dir / "normal_maps" / f"{_checked_name(name)}.{kind}.bin"

    def create_stereo_dirs(self, names: Iterable[str]) -> None:
        """Create the folders that the maps of images `names` and our own state go to.

        Raises
        ------
        OutputError
            A folder cannot be created.
        """
        folders = {
            self.stereo_dir / "depth_maps",
            self.stereo_dir / "normal_maps",
            self.stereo_dir / "consistency_graphs",
            self.state_dir,
        }
        for name in names:
            folders.add(self.depth_map_path(name, "geometric").parent)
            folders.add(self.normal_map_path(name, "geometric").parent)
        for folder in sorted(folders):
            make_dir(folder)


def mask_path(folder: Path, name: str) -> Path:
    """Where COLMAP looks for the mask of image `name` in a folder of masks."""
    return folder / f"{_checked_name(name)}.png"


def make_dir(folder: Path) -> None:
    """Create `folder` and its parents; `OutputError` where that is impossible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"The folder {folder} cannot be created ({error.strerror or error}); choose another --output."
        ) from error


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that appears under its name only when it is complete.

    The bytes go to a temporary name in the same folder, which then replaces `path` in one step; after an
    error or an interruption `path` is as it was.

    Raises
    ------
    OutputError
        The file cannot be written: permissions, a full disk, a folder in the way.
    """
    # Short, so that it fits wherever the real name fits; one per thread, which writes one file at a time.
    temporary = path.parent / f".{os.getpid()}-{threading.get_ident()}.tmp"
    try:
        with temporary.open("wb") as file:
            yield file
        temporary.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written ({error.strerror or error}); check space and permissions."
        ) from error
    finally:
        with suppress(OSError):  # not there, or on a disk that has become read-only
            temporary.unlink()


def write_depth_map(path: Path, depth: NDArray[np.float32]) -> None:
    """Write a depth map in COLMAP's format.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    depth : (H, W) float32 ndarray
        z-depth in model units along the ray ``K⁻¹ (col, row, 1)``; 0 (or not finite) where there is none.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    if depth.ndim != 2:
        raise ValueError(f"a depth map has shape (H, W), not {depth.shape}")
    # Fusion's test is `depth <= 0`, which NaN passes.
    _write_planes(path, [np.where(np.isfinite(depth), depth, 0.0)], (*depth.shape, 1))


def read_depth_map(path: Path) -> NDArray[np.float32]:
    """Read a COLMAP depth map as an (H, W) float32 array; `InputError` where it is missing or damaged."""
    return np.asarray(_read_planes(path, channels=1)[0])


def write_normal_map(path: Path, normals: NDArray[np.float32]) -> None:
    """Write a normal map in COLMAP's format.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    normals : (H, W, 3) float32 ndarray
        Unit vectors in the camera frame, towards the camera; (0, 0, 0) (or not finite) where there is none.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    if normals.ndim != 3 or normals.shape[2] != 3:
        raise ValueError(f"a normal map has shape (H, W, 3), not {normals.shape}")
    finite = np.isfinite(normals).all(axis=2)
    _write_planes(path, (np.where(finite, normals[..., k], 0.0) for k in range(3)), (*finite.shape, 3))


def read_normal_map(path: Path) -> NDArray[np.float32]:
    """Read a COLMAP normal map as an (H, W, 3) float32 array; `InputError` where it is missing or damaged."""
    return np.ascontiguousarray(read_normal_planes(path).transpose(1, 2, 0))


def read_normal_planes(path: Path) -> NDArray[np.float32]:
    """Read a COLMAP normal map as it lies in the file: a (3, H, W) float32 array; raises as `read_normal_map`."""
    return _read_planes(path, channels=3)


def _write_planes(path: Path, planes: Iterable[NDArray[np.floating]], shape: tuple[int, int, int]) -> None:
    """Write planes one after the other, so that only one has to be in memory; `shape` is (H, W, planes)."""
    height, width, channels = shape
    with atomic_file(path) as file:
        file.write(f"{width}&{height}&{channels}&".encode())
        for plane in planes:
            file.write(np.ascontiguousarray(plane, dtype="<f4").data)


def check_map(path: Path, shape: tuple[int, ...]) -> None:
    """Raise `InputError` unless a map file is whole and its map has this shape: (H, W) or (H, W, 3).

    COLMAP's fusion trusts the files: it fuses one that is cut off or of another size without a word, or raises an
    error that does not name it.
    """
    try:
        with path.open("rb") as file:
            start, size = file.read(_MAX_HEADER), path.stat().st_size
    except OSError as error:
        raise InputError(
            f"The map {path} cannot be read ({error.strerror or error}); compute it again."
        ) from error
    channels = shape[2] if len(shape) == 3 else 1
    found, _ = _parse_header(path, start, size, channels)
    if found != shape[:2]:
        raise InputError(
            f"The map {path} has {found[1]} x {found[0]} pixels, but its image {shape[1]} x {shape[0]}; "
            "delete it and compute it again."
        )


def _parse_header(path: Path, start: bytes, size: int, channels: int) -> tuple[tuple[int, int], int]:
    """Return (height, width) and the header's length, from the first bytes of a map file of `size` bytes."""
    header = _HEADER.match(start)
    if header is None:
        raise InputError(f"{path} is not a COLMAP depth or normal map; delete it and compute it again.")
    width, height, found = (int(number) for number in header.groups())
    if found != channels:
        raise InputError(f"{path} has {found} channels where {channels} are expected; compute it again.")
    if size - header.end() != 4 * width * height * channels:
        raise InputError(f"{path} is truncated or damaged; delete it and compute it again.")
    return (height, width), header.end()


def _read_planes(path: Path, *, channels: int) -> NDArray[np.float32]:
    """Read a map file as a (channels, H, W) array."""
    try:
        with path.open("rb") as file:
            start, size = file.read(_MAX_HEADER), path.stat().st_size
            (height, width), header = _parse_header(path, start, size, channels)
            file.seek(header)
            values = np.fromfile(file, "<f4", channels * height * width)
    except OSError as error:
        raise InputError(
            f"The map {path} cannot be read ({error.strerror or error}); compute it again."
        ) from error
    if len(values) < channels * height * width:
        raise InputError(f"{path} is truncated or damaged; delete it and compute it again.")
    return values.astype(np.float32, copy=False).reshape(channels, height, width)


def write_fusion_cfg(path: Path, names: Iterable[str]) -> None:
    """Write ``fusion.cfg``: the images that fusion reads, one name per line, without comments."""
    with atomic_file(path) as file:
        file.write("".join(f"{name}\n" for name in names).encode())


def write_patch_match_cfg(path: Path, sources: Mapping[str, SourceImages]) -> None:
    """Write ``patch-match.cfg``: for each reference image its source images.

    Parameters
    ----------
    path : Path
        Target file.
    sources : mapping of str to list of str, int or "__all__"
        Names of the source images, or a number (COLMAP chooses that many), or ``"__all__"``. COLMAP cannot
        process a reference without sources, so an empty list is left out.
    """
    lines = []
    for reference, source in sources.items():
        if source != []:
            lines += [reference, _source_line(source)]
    with atomic_file(path) as file:
        file.write("".join(f"{line}\n" for line in lines).encode())


def _source_line(source: SourceImages) -> str:
    if isinstance(source, int):
        return f"__auto__, {source}"
    return source if isinstance(source, str) else ", ".join(source)


def read_patch_match_cfg(path: Path) -> dict[str, SourceImages]:
    """Read ``patch-match.cfg``: pairs of lines, a reference image and its sources.

    Returns
    -------
    dict
        For each reference image an explicit list of names, or an int N for ``__auto__, N``, or ``"__all__"``.

    Raises
    ------
    InputError
        The file cannot be read or is malformed; the message names the line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read ({error}); mend or delete it.") from error
    numbered = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in numbered if line and not line.startswith("#")]
    if len(lines) % 2:
        number, name = lines[-1]
        raise InputError(f"{path}, line {number}: the source images of {name!r} are missing.")
    sources: dict[str, SourceImages] = {}
    for (number, reference), (source_number, line) in zip(lines[::2], lines[1::2], strict=True):
        if reference in sources:
            raise InputError(f"{path}, line {number}: {reference!r} is listed twice; keep one of them.")
        if reference.startswith("__"):
            raise InputError(f"{path}, line {number}: {reference!r} stands where an image name is expected.")
        sources[reference] = _parse_sources(line, reference, f"{path}, line {source_number}")
    return sources


def _parse_sources(line: str, reference: str, where: str) -> SourceImages:
    words = [word.strip() for word in line.split(",")]
    if words == ["__all__"]:
        return "__all__"
    if words[0] == "__auto__":
        if len(words) != 2 or not words[1].isdecimal() or int(words[1]) < 1:
            raise InputError(f"{where}: {line!r} should read '__auto__, N' with a number N above 0.")
        return int(words[1])
    names = [word for word in words if word]
    if not names or any(name.startswith("__") for name in names):
        raise InputError(f"{where}: {line!r} is not a list of image names, '__auto__, N' or '__all__'.")
    if reference in names:
        raise InputError(f"{where}: {reference!r} is listed as its own source image; remove it.")
    return list(dict.fromkeys(names))


def _checked_name(name: str) -> str:
    """Refuse a name that would lead out of the workspace, or that leaves no room for the endings of our files."""
    parts = PurePosixPath(name)
    if not name or parts.is_absolute() or ".." in parts.parts:
        raise InputError(f"The image name {name!r} leads out of the workspace; rename the image in the model.")
    if len(parts.name.encode()) > _MAX_NAME_BYTES:
        raise InputError(
            f"The image name '{parts.name[:20]}…' is longer than the {_MAX_NAME_BYTES} bytes for which the names "
            "of its maps fit the disk; rename the image."
        )
    return name
