"""Points of a cloud → a small PLY file."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {"<f4": "float", "<f8": "double", "|u1": "uchar"}


def write_ply(path: Path, xyz: NDArray[np.float64], rgb: NDArray[np.uint8]) -> None:
    """Write points as 32-bit floats, with normals of zero, which some readers miss otherwise, and colours."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    kind = np.dtype([*((name, "<f4") for name in names), *((name, "u1") for name in ("red", "green", "blue"))])
    points = np.zeros(len(xyz), kind)
    for name, values in zip(("x", "y", "z", "red", "green", "blue"), [*xyz.T, *rgb.T], strict=True):
        points[name] = values
    write_points(path, points)


def write_points(path: Path, points: NDArray[Any]) -> None:
    """Write a structured array as the points of a binary PLY file."""
    fields = [(name, _TYPES[points.dtype[name].str]) for name in points.dtype.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property {kind} {name}" for name, kind in fields]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + points.tobytes())
