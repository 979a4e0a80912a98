"""Which view of a workspace was cut from which image: `wide_images.json`, beside its model's files."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import atomic_file, read_small
from colmap_sph.project.state.typed import from_json
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.layout import Face
from colmap_sph.project.wide.projection import Lens, number_of_parameters
from colmap_sph.project.workspace import checked_name

TABLE_NAME = "wide_images.json"

_VERSION = 1
_MAX_BYTES = 1 << 30
_ORTHONORMAL = 1e-6

Pixels = Annotated[int, Meta(ge=1, le=1_000_000)]
Place = Annotated[int, Meta(ge=0)]
Row = tuple[float, float, float]


class _Lens(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    model: str
    params: Annotated[tuple[float, ...], Meta(max_length=32)]
    width: Pixels
    height: Pixels
    limit: Annotated[float, Meta(gt=0, le=3.1416)]


class _Face(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    rotation: tuple[Row, Row, Row]
    width: Pixels
    height: Pixels
    focal: Annotated[float, Meta(gt=0)]
    x: float
    y: float


class _View(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    original: str
    lens: Place
    face: Place


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    version: int
    lenses: tuple[_Lens, ...]
    faces: tuple[_Face, ...]
    views: dict[str, _View]


def read_cuts(model_dir: Path) -> dict[str, Cut]:
    """How views of a model were cut, by their names; none where the model has no such table.

    Raises
    ------
    InputError
        The table is damaged.
    """
    path = model_dir / TABLE_NAME
    if not path.exists():
        return {}
    try:
        read = from_json(read_small(path, _MAX_BYTES), _Table)
        if read.version != _VERSION:
            raise ValueError(f"it is of version {read.version}")
        lenses, faces = [_lens(each) for each in read.lenses], [_face(each) for each in read.faces]
        return {
            checked_name(name): Cut(checked_name(view.original), lenses[view.lens], faces[view.face])
            for name, view in read.views.items()
        }
    except (OSError, ValueError, IndexError, InputError) as error:
        reason = reason_of(error) if isinstance(error, OSError) else "it does not say from what views were cut"
        raise InputError(f"{path} cannot be used ({reason}); make the workspace anew with --overwrite.") from error


def write_cuts(views: Mapping[str, Cut], model_dir: Path) -> None:
    """Write how views were cut, by their names, beside a model's files; `OutputError` where that fails."""
    lenses = list(dict.fromkeys(cut.lens for cut in views.values()))
    faces = list(dict.fromkeys(cut.face for cut in views.values()))
    lens_rows = {lens: row for row, lens in enumerate(lenses)}
    face_rows = {face: row for row, face in enumerate(faces)}
    table = {
        "version": _VERSION,
        "lenses": [vars(lens) for lens in lenses],
        "faces": [vars(face) for face in faces],
        "views": {
            name: {"original": cut.original, "lens": lens_rows[cut.lens], "face": face_rows[cut.face]}
            for name, cut in sorted(views.items())
        },
    }
    with atomic_file(model_dir / TABLE_NAME) as file:
        file.write(json.dumps(table, indent=1).encode())


def _lens(read: _Lens) -> Lens:
    if (
        number_of_parameters(read.model) != len(read.params)
        or not read.params
        or not np.isfinite(read.params).all()
    ):
        raise ValueError("no lens")
    return Lens(read.model, read.params, read.width, read.height, read.limit)


def _face(read: _Face) -> Face:
    R = np.array(read.rotation)
    if not np.abs(R @ R.T - np.eye(3)).max() < _ORTHONORMAL:
        raise ValueError("no rotation")
    return Face(read.name, read.rotation, read.width, read.height, read.focal, read.x, read.y)
