"""Reading clouds and meshes: PLY, OBJ, LAS and LAZ."""

from __future__ import annotations

import importlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import InputError, reason_of
from colmap_sph.evaluation.neighbours import Points

logger = logging.getLogger(__name__)

_LAS_CHUNK = 2_000_000
_WKT_PROJECTED = ("PROJCS", "PROJCRS", "PROJECTEDCRS")
_WKT_GEOGRAPHIC = ("GEOGCS", "GEOGCRS", "GEODCRS", "GEOGRAPHICCRS")
_GEOTIFF_MODEL_TYPE = 1024
_GEOTIFF_PROJECTED = 1
_GEOTIFF_GEOGRAPHIC = 2
_GEOTIFF_PROJECTED_CODE = 3072


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


def read_geometry(path: Path) -> PointCloud | Mesh:
    """Read a cloud (PLY, OBJ without faces, LAS, LAZ) or a mesh (PLY or OBJ with faces).

    Raises
    ------
    InputError
        A file that is missing, damaged, empty, of another format, or with coordinates that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist or is not a file: give the path of a cloud or mesh")
    kind = path.suffix.lower()
    if kind in (".las", ".laz"):
        return _read_las(path)
    if kind in (".ply", ".obj"):
        return _read_ply_or_obj(path)
    raise InputError(
        f"{path} has the unknown format {kind or '(no ending)'!r}: convert it to PLY, OBJ, LAS or LAZ"
    )


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
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{name}: {np.count_nonzero(~finite)} of {len(points)} points have coordinates that are NaN or "
            "infinite: remove them first"
        )


def _read_ply_or_obj(path: Path) -> PointCloud | Mesh:
    trimesh = require("trimesh")
    try:
        loaded = trimesh.load(path, process=False, skip_materials=True)
    except (ValueError, KeyError, IndexError, TypeError, EOFError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} cannot be read as {path.suffix[1:].upper()}, it may be damaged: {reason_of(error)}"
        ) from error
    if isinstance(loaded, trimesh.Scene):
        if not loaded.geometry:
            raise InputError(f"{path} is empty: it has no point to compare")
        loaded = loaded.to_mesh()
    vertices = np.array(loaded.vertices, np.float64, order="C").reshape(-1, 3)
    _warn_of_lost_digits(path, vertices)
    if isinstance(loaded, trimesh.Trimesh) and len(loaded.faces):
        return Mesh(str(path), vertices, np.array(loaded.faces, np.int64))
    return PointCloud(str(path), vertices)


def _warn_of_lost_digits(path: Path, points: Points) -> None:
    """Map coordinates in 32-bit floats are rounded to decimetres: say so, the numbers would be worthless."""
    largest = float(np.abs(points).max(initial=0.0))
    if np.isfinite(largest) and largest >= 1e5 and np.array_equal(points, points.astype(np.float32)):
        step = float(np.spacing(np.float32(largest)))
        logger.warning(
            "%s stores coordinates near %.0f in 32-bit floats, in steps of %.3g: write it with doubles or in "
            "a local frame",
            path,
            largest,
            step,
        )


def _read_las(path: Path) -> PointCloud:
    laspy = require("laspy")
    try:
        with laspy.open(path) as file:
            points = np.empty((file.header.point_count, 3))
            start = 0
            for chunk in file.chunk_iterator(_LAS_CHUNK):
                points[start : start + len(chunk)] = np.stack([chunk.x, chunk.y, chunk.z], axis=1)
                start += len(chunk)
            crs = _las_crs(file.header)
    except (laspy.errors.LaspyException, ValueError, EOFError, OSError, RuntimeError) as error:
        raise InputError(f"{path} cannot be read as LAS/LAZ, it may be damaged: {reason_of(error)}") from error
    if start < len(points):
        raise InputError(f"{path} is cut off: its header states {len(points)} points, it has {start}")
    return PointCloud(str(path), points, crs, z_is_up=True)


def _las_crs(header: Any) -> str | None:
    """The coordinate system as 'projected (NAME)' or 'geographic (NAME)'; None without one."""
    for record in [*header.vlrs, *(header.evlrs or [])]:
        wkt = str(getattr(record, "string", "")).strip("\0 ").upper() if record.record_id == 2112 else ""
        for kind, words in (("projected", _WKT_PROJECTED), ("geographic", _WKT_GEOGRAPHIC)):
            if any(f"{word}[" in wkt for word in words):
                name = str(record.string).split('"')
                return f"{kind} ({name[1]})" if len(name) > 1 else kind
    for record in header.vlrs:
        keys = {key.id: key.value_offset for key in getattr(record, "geo_keys", [])}
        if keys.get(_GEOTIFF_MODEL_TYPE) == _GEOTIFF_PROJECTED:
            return f"projected (EPSG:{keys.get(_GEOTIFF_PROJECTED_CODE, '?')})"
        if keys.get(_GEOTIFF_MODEL_TYPE) == _GEOTIFF_GEOGRAPHIC:
            return "geographic (degrees)"
    return None
