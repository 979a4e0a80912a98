"""A mesh → an OBJ file with its materials and pictures, as MeshLab, CloudCompare and Blender read it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.mesh.texture.textured import Sheet
from colmap_sph.project.files import NewFile, atomic_file, remove

_CHUNK = 1 << 16


def write_obj(path: Path, sheets: Sequence[Sheet], places: Sequence[NDArray[np.floating]]) -> list[Path]:
    """Write a mesh with its points elsewhere.

    Parameters
    ----------
    path : Path
    sheets : sequence of Sheet
        Its parts.
    places : sequence of (n, 3) ndarray
        Where the points of each part go; float64 for coordinates of a map, which get four decimals.

    Returns
    -------
    list of Path
        The file, that of its materials, and the pictures.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    materials = path.with_suffix(".mtl")
    pictures = []
    remove(path)  # an earlier one, whose pictures would be those of another mesh, should this be ended
    with atomic_file(materials) as file:
        for number, sheet in enumerate(sheets):
            file.write(f"newmtl part_{number}\nKd 1 1 1\nillum 0\n".encode())
            if sheet.picture is not None:
                pictures.append(path.with_name(f"{path.stem}_{number}.jpg"))
                file.write(f"map_Kd {pictures[-1].name}\n".encode())
                with atomic_file(pictures[-1]) as copy:
                    copy.write(sheet.picture.read_bytes())
    with atomic_file(path) as file:
        file.write(f"mtllib {materials.name}\n".encode())
        first = np.ones(2, np.int64)
        for number, (sheet, points) in enumerate(zip(sheets, places, strict=True)):
            file.write(f"usemtl part_{number}\n".encode())
            _write_sheet(file, sheet, points, first)
            first += len(points), 0 if sheet.uv is None else len(points)
    return [path, materials, *pictures]


def _write_sheet(file: NewFile, sheet: Sheet, points: NDArray[np.floating], first: NDArray[np.int64]) -> None:
    """Write a part whose first point and first place on a picture have these numbers in the file."""
    xyz = "v" + 3 * (" %.4f" if points.dtype == np.float64 else " %.8g")
    corners = sheet.faces + first[0]
    if sheet.uv is None:
        _write_rows(file, xyz + " %.4g %.4g %.4g", np.hstack([points, sheet.colours / 255.0]))
        _write_rows(file, "f %d %d %d", corners)
        return
    _write_rows(file, xyz, points)
    _write_rows(file, "vt %.7g %.7g", np.stack([sheet.uv[:, 0], 1 - sheet.uv[:, 1]], axis=1))
    both = np.stack([corners, sheet.faces + first[1]], axis=2)
    _write_rows(file, "f %d/%d %d/%d %d/%d", both.reshape(-1, 6))


def _write_rows(file: NewFile, line: str, values: NDArray[np.floating] | NDArray[np.integer]) -> None:
    for first in range(0, len(values), _CHUNK):
        rows = values[first : first + _CHUNK]
        file.write((f"{line}\n" * len(rows) % tuple(rows.ravel().tolist())).encode())
