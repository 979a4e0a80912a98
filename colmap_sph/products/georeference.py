"""Where a model lies on the map: a similarity in 64-bit floats and a coordinate system, kept beside the model.

The model itself stays as it is; who writes a product takes its points through `Georeference.to_map`.
"""

import hashlib
import math
import os
from dataclasses import dataclass, field
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.sparse_model import model_files
from colmap_sph.project.state.records import read_json
from colmap_sph.project.workspace import Workspace

_MAX_BYTES = 256 << 20
_NOT_A_ROTATION = 1e-9

AlignedBy = Literal["", "positions", "points"]


class Residual(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is left at a camera or control point after the alignment.

    Attributes
    ----------
    name : str
        Of the image, or of the point.
    difference : (float, float, float)
        Aligned less given position, units of the map.
    is_check : bool
        Whether it was kept out of the estimate, or was found to be an outlier.
    pixels : float or None
        Of a control point: root mean square of its reprojection error.
    """

    name: str
    difference: tuple[float, float, float]
    is_check: bool = False
    pixels: float | None = None

    @property
    def length(self) -> float:
        """Distance of aligned and given position."""
        return math.hypot(*self.difference)


@dataclass(frozen=True, eq=False)
class Georeference:
    """Where a model lies on the map; by default just where its own coordinates say.

    Attributes
    ----------
    crs : str
        Coordinate system as it was named, such as "EPSG:25832"; empty where it is not known.
    wkt : str
        The same in WKT (OGC 01-009, GDAL's), for LAS and GeoTIFF; empty where it is not known.
    scale : float
        Map units per model unit.
    rotation : (3, 3) float64 ndarray
        Axes of the model → axes of the map.
    translation : (3,) float64 ndarray
        Map coordinates of the model's origin.
    aligned_by : {"", "positions", "points"}
        What the similarity was estimated from: camera positions, control points, or nothing.
    residuals : tuple of Residual
    """

    crs: str = ""
    wkt: str = ""
    scale: float = 1.0
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    translation: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    aligned_by: AlignedBy = ""
    residuals: tuple[Residual, ...] = ()

    @property
    def is_identity(self) -> bool:
        """Whether map coordinates are the model's own."""
        return self.scale == 1 and not self.translation.any() and bool((self.rotation == np.eye(3)).all())

    def to_map(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """(…, 3) points of the model's frame in map coordinates.

        Examples
        --------
        >>> turned = Georeference(scale=2.0, rotation=np.diag([-1.0, -1, 1]), translation=np.array([500.0, 0, 0]))
        >>> turned.to_map(np.array([[1.0, 2, 3]])).tolist()
        [[498.0, -4.0, 6.0]]
        """
        far = np.asarray(points, np.float64)
        if self.is_identity:
            return far
        return np.asarray(self.scale * (far @ self.rotation.T) + self.translation)

    def directions_to_map(self, directions: NDArray[np.floating]) -> NDArray[np.floating]:
        """(…, 3) directions of the model's frame, such as normals, along the axes of the map; same type."""
        if self.is_identity:
            return directions
        return np.asarray(directions @ self.rotation.T.astype(directions.dtype))


Vector = tuple[float, float, float]


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What stands in the file."""

    format: Literal["colmap_sph georeference 1"]
    crs: Annotated[str, Meta(max_length=1 << 16)]
    wkt: Annotated[str, Meta(max_length=1 << 16)]
    scale: Annotated[float, Meta(gt=0)]
    rotation: tuple[Vector, Vector, Vector]
    translation: Vector
    aligned_by: AlignedBy
    residuals: tuple[Residual, ...]
    poses: str


def read_georeference(workspace: Workspace) -> Georeference:
    """Read where a workspace's model lies on the map; where nothing is known, its own coordinates and no system.

    Raises
    ------
    InputError
        The file is damaged, or was made for another model.
    """
    path = workspace.georeference_path
    if not os.path.lexists(path):
        return Georeference()
    found = read_json(path, _File, max_bytes=_MAX_BYTES)
    again = "say anew where the model lies, by --crs and, for a local model, --align"
    if found is None or not _is_possible(found):
        raise InputError(f"{path} is damaged; {again}.")
    if found.poses != _digest_of_poses(workspace):
        raise InputError(f"{path} belongs to other poses than those of {workspace.sparse_dir}; {again}.")
    return Georeference(
        crs=found.crs,
        wkt=found.wkt,
        scale=found.scale,
        rotation=np.array(found.rotation),
        translation=np.array(found.translation),
        aligned_by=found.aligned_by,
        residuals=found.residuals,
    )


def write_georeference(workspace: Workspace, georeference: Georeference) -> None:
    """Keep where a workspace's model lies on the map; `OutputError` where it cannot be written."""
    content = _File(
        format="colmap_sph georeference 1",
        crs=georeference.crs,
        wkt=georeference.wkt,
        scale=georeference.scale,
        rotation=_rows(georeference.rotation),
        translation=_vector(georeference.translation),
        aligned_by=georeference.aligned_by,
        residuals=georeference.residuals,
        poses=_digest_of_poses(workspace),
    )
    make_dir(workspace.state_dir)
    with atomic_file(workspace.georeference_path) as file:
        file.write(msgspec.json.format(msgspec.json.encode(content), indent=1))


def _is_possible(found: _File) -> bool:
    rotation = np.array(found.rotation)
    values = np.array([found.scale, *found.translation, *rotation.ravel()])
    turned = np.abs(rotation @ rotation.T - np.eye(3)).max()
    is_rotation = turned < _NOT_A_ROTATION and np.linalg.det(rotation) > 0
    return bool(np.isfinite(values).all() and is_rotation)


def _digest_of_poses(workspace: Workspace) -> str:
    """Digest of the file with the poses, for which a similarity was estimated."""
    path = next(path for path in model_files(workspace.sparse_dir) if path.stem == "images")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()[:32]


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def _rows(matrix: NDArray[np.float64]) -> tuple[Vector, Vector, Vector]:
    first, second, third = map(_vector, matrix)
    return first, second, third
