"""Disparity maps of rectified pairs on disk: one ``.npz`` per pair, with the geometry that gives them meaning.

Disparities are stored in 16 bits, 1/64 pixel apart or as fine as the pair's range allows; 0 = none.
"""

from pathlib import Path
from typing import Any

import numpy as np

from colmap_sph.depth import PairDisparity
from colmap_sph.errors import InputError
from colmap_sph.rectification import RectifiedPair
from colmap_sph.workspace import atomic_file

_FINEST_STEP = 1 / 64
_CODES = 65535


def write_pair(path: Path, pair: PairDisparity) -> None:
    """Write a pair's disparity map; `OutputError` where that fails.

    Parameters
    ----------
    path : Path
        Target ``.npz`` file; its folder exists.
    pair : PairDisparity
    """
    found = np.isfinite(pair.disparity)
    least = float(pair.disparity[found].min()) if found.any() else 0.0
    most = float(pair.disparity[found].max()) if found.any() else 0.0
    step = max(_FINEST_STEP, (most - least) / (_CODES - 1))
    codes = np.where(found, np.rint((pair.disparity - least) / step) + 1, 0).astype(np.uint16)
    content: dict[str, Any] = {name: getattr(pair.geometry, name) for name in RectifiedPair.__dataclass_fields__}
    content |= {"left": pair.left, "right": pair.right, "codes": codes, "scale": np.array([least, step])}
    with atomic_file(path) as file:
        np.savez(file, **content)


def read_pair(path: Path) -> PairDisparity:
    """Read a pair's disparity map; `InputError` where the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as data:
            fields = {
                name: data[name] if data[name].ndim else data[name].item()
                for name in RectifiedPair.__dataclass_fields__
            }
            least, step = data["scale"]
            codes = data["codes"]
            disparity = (codes - np.float32(1)) * np.float32(step) + np.float32(least)
            disparity[codes == 0] = np.nan
            return PairDisparity(str(data["left"]), str(data["right"]), RectifiedPair(**fields), disparity)
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InputError(f"{path} cannot be read ({error}); delete it and run again.") from error
