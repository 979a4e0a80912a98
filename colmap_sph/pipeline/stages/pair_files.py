"""Intermediate results on disk, as ``.npz`` files that hold the key they were made under.

A pair's disparity map comes with the geometry that gives it meaning. Disparities are stored in 16 bits, 1/64 pixel
apart or as fine as the pair's range allows; 0 = none.
"""

import json
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import atomic_file, open_regular
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair

_FINEST_STEP = 1 / 64
_CODES = 65535
# What NumPy raises for files that are cut off, garbage, or of other content.
_DAMAGED = (OSError, ValueError, KeyError, EOFError, RuntimeError, TypeError, MemoryError, zipfile.BadZipFile)


def write_pair(path: Path, pair: PairDisparity, key: str = "") -> None:
    """Write a pair's disparity map; `OutputError` where that fails.

    Parameters
    ----------
    path : Path
        Target ``.npz`` file; its folder exists.
    pair : PairDisparity
    key : str
        What `stored_key` shall return.
    """
    found = np.isfinite(pair.disparity)
    least = float(pair.disparity[found].min()) if found.any() else 0.0
    most = float(pair.disparity[found].max()) if found.any() else 0.0
    step = max(_FINEST_STEP, (most - least) / (_CODES - 1))
    codes = np.where(found, np.rint((pair.disparity - least) / step) + 1, 0).astype(np.uint16)
    # In one: every array of an archive takes its time to open.
    metadata = {"left": pair.left, "right": pair.right, "scale": [least, step], "geometry": vars(pair.geometry)}
    write_arrays(path, {"codes": codes, "metadata": json.dumps(metadata, default=np.ndarray.tolist)}, key)


def read_pair(path: Path) -> PairDisparity:
    """Read a pair's disparity map; `InputError` where the file is missing or damaged."""
    data = read_arrays(path, ("codes", "metadata"))
    codes = data["codes"]
    try:
        metadata = json.loads(str(data["metadata"]))
        left, right, (least, step) = metadata["left"], metadata["right"], map(float, metadata["scale"])
        rotation = np.array(metadata["geometry"]["rectified_from_world"], dtype=np.float64)
        geometry = RectifiedPair(**(metadata["geometry"] | {"rectified_from_world": rotation}))
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        path.unlink(missing_ok=True)
        raise InputError(
            f"{path} does not describe a pair ({reason_of(error)}); it was removed, run again."
        ) from error
    disparity = (codes - np.float32(1)) * np.float32(step) + np.float32(least)
    disparity[codes == 0] = np.nan
    return PairDisparity(left, right, geometry, disparity)


def write_arrays(path: Path, arrays: Mapping[str, Any], key: str) -> None:
    """Write named arrays as an ``.npz`` file.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    arrays : mapping of str to array
    key : str
        What `stored_key` shall return.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with atomic_file(path) as file:
        np.savez(file, key=key, **arrays)


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Read the arrays called `names` of an ``.npz`` file; `InputError` where one is missing or damaged.

    A damaged file is removed, so that the next run makes it anew.
    """
    try:
        # Opened here, as NumPy leaves a damaged file open.
        with open_regular(path) as file, np.load(file, allow_pickle=False) as data:
            return {name: data[name] for name in names}
    except _DAMAGED as error:
        damaged = _is_damaged(path)
        if isinstance(error, MemoryError) and not damaged:
            raise
        if damaged:
            path.unlink(missing_ok=True)
        remedy = "it was removed, run again" if damaged else "run again, or check its permissions"
        raise InputError(f"{path} cannot be read ({reason_of(error)}); {remedy}.") from error


def stored_key(path: Path) -> str | None:
    """The key under which a file was written, or None where it is missing or damaged, or has none."""
    try:
        with open_regular(path) as file, np.load(file, allow_pickle=False) as data:
            return str(data["key"])
    except _DAMAGED:
        return None


def disparity_bytes(path: Path) -> int:
    """About the memory that the disparity map of a pair's file takes; 0 where the file is missing.

    A missing file is for `read_pair` to report: another worker may have found it damaged and removed it.
    """
    try:
        return 2 * path.stat().st_size  # two bytes per pixel in the file, four in memory
    except OSError:
        return 0


def _is_damaged(path: Path) -> bool:
    """Whether an archive is there, but cut off or altered; its checksums tell."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is not None
    except OSError:  # missing, forbidden, a failing disk
        return False
    except (ValueError, EOFError, RuntimeError, NotImplementedError, zlib.error, zipfile.BadZipFile):
        return True
