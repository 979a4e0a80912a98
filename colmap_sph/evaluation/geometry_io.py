"""Reading clouds and meshes: PLY, OBJ, LAS and LAZ."""

from __future__ import annotations

import importlib
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import InputError, reason_of
from colmap_sph.evaluation.las_files import read_las
from colmap_sph.evaluation.neighbours import Points
from colmap_sph.evaluation.obj_files import read_obj
from colmap_sph.evaluation.ply_files import read_ply

logger = logging.getLogger(__name__)

_Content = TypeVar("_Content")
_LARGEST = 1e12
"""Coordinates beyond are no place in any unit; their squares are still numbers."""


@dataclass(frozen=True)
class PointCloud:
    """Points that are known to be there and finite."""

    name: str
    """Where they come from, for messages and tables."""
    points: Points
    """(N, 3) float64, N > 0."""
    crs: str | None = None
    """What a LAS file states, e.g. 'projected (WGS 84 / UTM zone 33N)'; None: nothing."""
    z_is_up: bool = False
    """True for LAS and LAZ, whose z axis is height by definition."""

    def __post_init__(self) -> None:
        _check_points(self.name, self.points)


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with finite vertices."""

    name: str
    vertices: Points
    """(V, 3) float64."""
    faces: npt.NDArray[np.int64]
    """(F, 3) rows of `vertices`, F > 0."""

    def __post_init__(self) -> None:
        _check_points(self.name, self.vertices)
        if not len(self.faces):
            raise InputError(f"{self.name} has no faces")
        outside = ((self.faces < 0) | (self.faces >= len(self.vertices))).any(axis=1)
        if outside.any():
            raise InputError(
                f"{self.name}: {np.count_nonzero(outside)} of {len(self.faces)} triangles have corners that are "
                "not among its vertices: it may be damaged, write it again"
            )


def read_geometry(path: Path) -> PointCloud | Mesh:
    """Read a cloud (PLY, OBJ without faces, LAS, LAZ; all tiles of an index) or a mesh (PLY or OBJ with faces).

    Raises
    ------
    InputError
        A file that is missing, damaged, empty, of another format, or with impossible coordinates or faces.
    """
    path = Path(path)
    if not path.is_file():
        lack = "is not a regular file" if path.exists() else "does not exist"
        raise InputError(f"{path} {lack}; give a cloud or a mesh, or as --reference a folder of exact depth maps.")
    kind = path.suffix.lower()
    if kind in (".las", ".laz"):
        points, crs = _read(path, "LAS/LAZ", partial(read_las, laspy=require("laspy")))
        return PointCloud(str(path), points, crs, z_is_up=True)
    if kind == ".json":
        points = _read(path, "index of tiles", _read_tiles)
        return PointCloud(str(path), points)
    if kind not in (".ply", ".obj"):
        raise InputError(
            f"{path} has the unknown format {kind or '(no ending)'!r}: convert it to PLY, OBJ, LAS or LAZ"
        )
    vertices, faces = _read(path, kind[1:].upper(), read_ply if kind == ".ply" else read_obj)
    geometry = Mesh(str(path), vertices, faces) if len(faces) else PointCloud(str(path), vertices)
    _warn_of_lost_digits(path, vertices)
    return geometry


def _read(path: Path, kind: str, reader: Callable[[Path], _Content]) -> _Content:
    """What a reader makes of a file; whatever it and its libraries raise at it becomes a sentence."""
    try:
        return reader(path)
    except (MemoryError, KeyboardInterrupt, SystemExit):
        raise
    # The decompressor's own panic is no `Exception`.
    except BaseException as error:
        raise InputError(f"{path} cannot be read as {kind}, it may be damaged: {reason_of(error)}") from error


def _read_tiles(index: Path) -> Points:
    """All points of the tiles beside an index that this program wrote."""
    files = [str(tile["file"]) for tile in json.loads(index.read_bytes())["tiles"]]
    if not all(Path(file).name == file for file in files):
        raise ValueError("its tiles are not beside it")
    return np.concatenate([np.zeros((0, 3)), *(read_ply(index.parent / file)[0] for file in files)])


def require(module: str) -> Any:
    """Import a module that only some evaluations need, or say how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(f"this needs {module}: pip install {module} ({reason_of(error)})") from error


def _check_points(name: str, points: Points) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} has points of shape {points.shape}, not (N, 3)")
    if not len(points):
        raise InputError(f"{name} is empty: it has no point to compare")
    possible = (np.abs(points) <= _LARGEST).all(axis=1)
    if not possible.all():
        raise InputError(
            f"{name}: {np.count_nonzero(~possible)} of {len(points)} points have coordinates that are NaN or "
            f"infinite, or beyond {_LARGEST:g}: remove them first"
        )


def _warn_of_lost_digits(path: Path, points: Points) -> None:
    """Map coordinates in 32-bit floats are rounded to decimetres: say so, the numbers would be worthless."""
    largest = float(np.abs(points).max(initial=0.0))
    if largest >= 1e5 and np.array_equal(points, points.astype(np.float32)):
        step = float(np.spacing(np.float32(largest)))
        logger.warning(
            "%s stores coordinates near %.0f in 32-bit floats, in steps of %.3g: write it with doubles or in "
            "a local frame",
            path,
            largest,
            step,
        )
