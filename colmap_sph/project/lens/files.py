"""Lens fields of a model's cameras on disk: `lens_fields.json`, beside the model's own files.

COLMAP does not know it, and takes the cameras without.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import atomic_file, read_small
from colmap_sph.project.lens.field import LensField
from colmap_sph.project.state.typed import from_json

LENS_FIELDS_NAME = "lens_fields.json"

_VERSION = 1
_MAX_BYTES = 64 << 20
_FEWEST = 4
_MOST = 64

Pair = Annotated[tuple[float, ...], Meta(min_length=2, max_length=2)]
Row = Annotated[tuple[float, ...], Meta(min_length=_FEWEST, max_length=_MOST)]
Grid = Annotated[tuple[Row, ...], Meta(min_length=_FEWEST, max_length=_MOST)]


class _Field(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    low: Pair
    high: Pair
    x: Grid
    y: Grid


class _Fields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    version: int
    cameras: dict[int, _Field]


def read_lens_fields(model_dir: Path) -> dict[int, LensField]:
    """Lens fields by camera id; none where the model has no such file.

    Raises
    ------
    InputError
        The file is damaged, or what it says is no lens.
    """
    path = model_dir / LENS_FIELDS_NAME
    if not path.exists():
        return {}
    again = "refine the cameras again, or remove the file to use the model without it"
    try:
        read = from_json(read_small(path, _MAX_BYTES), _Fields)
        if read.version != _VERSION:
            raise InputError(f"{path} is of another version of the program ({read.version}); {again}.")
        fields = {camera: _field(part) for camera, part in read.cameras.items()}
    except (OSError, ValueError) as error:
        reason = reason_of(error) if isinstance(error, OSError) else "it does not hold lens fields"
        raise InputError(f"{path} cannot be used ({reason}); {again}.") from error
    if not all(field.is_sound for field in fields.values()):
        raise InputError(f"{path} cannot be used (no lens displaces rays like that); {again}.")
    return fields


def write_lens_fields(fields: Mapping[int, LensField], model_dir: Path) -> None:
    """Write lens fields by camera id beside a model's files; `OutputError` where that fails."""
    cameras = {
        str(camera): {
            "low": field.low.tolist(),
            "high": field.high.tolist(),
            "x": field.coefficients[0].tolist(),
            "y": field.coefficients[1].tolist(),
        }
        for camera, field in sorted(fields.items())
    }
    with atomic_file(model_dir / LENS_FIELDS_NAME) as file:
        file.write(json.dumps({"version": _VERSION, "cameras": cameras}).encode())


def _field(read: _Field) -> LensField:
    return LensField(np.array(read.low), np.array(read.high), np.array([read.x, read.y]))
