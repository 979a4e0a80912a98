"""A mesh → a GLB file: glTF 2.0 in one binary file, as browsers, Blender and game engines read it."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import OutputError
from colmap_sph.products.mesh.texture.textured import Sheet
from colmap_sph.project.files import atomic_file

_ARRAY, _INDICES = 34962, 34963
_FLOAT, _UBYTE, _UINT = 5126, 5121, 5125
# Of the whole file; its length is a number of 32 bits.
_MOST_BYTES = 2**32 - 1
_UNLIT = "KHR_materials_unlit"


def write_glb(path: Path, sheets: Sequence[Sheet], axes: NDArray[np.float64]) -> None:
    """Write a mesh with its pictures, or the colours of its corners, upright: glTF's y is up.

    Parameters
    ----------
    path : Path
    sheets : sequence of Sheet
        Its parts, at least one.
    axes : (3, 3) float64 ndarray
        Rows: to the right, to the top of a map, and up, in the mesh's frame.

    Raises
    ------
    OutputError
        It cannot be written, or is too large for the format.
    """
    low = np.min([sheet.points.min(axis=0) for sheet in sheets], axis=0)
    high = np.max([sheet.points.max(axis=0) for sheet in sheets], axis=0)
    document = _Document((low + high) / 2, axes)
    for sheet in sheets:
        document.add(sheet)
    size = document.num_bytes
    text = json.dumps(document.content()).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + size
    if total > _MOST_BYTES:
        raise OutputError(
            f"{path} would be larger than GLB files can be, 4 GiB; give --simplify, or --formats ply."
        )
    with atomic_file(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, total))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", size, b"BIN\0"))
        for blob in document.blobs:
            data = blob.read_bytes() if isinstance(blob, Path) else blob.tobytes()
            file.write(data + bytes(-len(data) % 4))


class _Document:
    """What a file says of its numbers, and these."""

    def __init__(self, middle: NDArray[np.float32], axes: NDArray[np.float64]) -> None:
        self._middle = middle
        self._turn = np.eye(4)
        self._turn[:3, :3] = [axes[0], axes[2], -axes[1]]
        self.blobs: list[NDArray[Any] | Path] = []
        self.num_bytes = 0
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._primitives: list[dict[str, Any]] = []
        self._materials: list[dict[str, Any]] = []
        self._images: list[dict[str, Any]] = []

    def add(self, sheet: Sheet) -> None:
        """Add a part, with a material of its own."""
        points = (sheet.points - self._middle).astype("<f4")
        extent = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        attributes = {"POSITION": self._numbers(points, "VEC3", _FLOAT, extent)}
        surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        material: dict[str, Any] = {"doubleSided": True, "pbrMetallicRoughness": surface}
        if sheet.uv is None or sheet.picture is None:
            colours = np.full((len(points), 4), 255, np.uint8)
            colours[:, :3] = sheet.colours
            attributes["COLOR_0"] = self._numbers(colours, "VEC4", _UBYTE, {"normalized": True})
        else:
            attributes["TEXCOORD_0"] = self._numbers(sheet.uv.astype("<f4"), "VEC2", _FLOAT, {})
            surface["baseColorTexture"] = {"index": len(self._images)}
            # The light is in the picture already.
            material["extensions"] = {_UNLIT: {}}
            view = self._view(sheet.picture, sheet.picture.stat().st_size)
            self._images.append({"bufferView": view, "mimeType": "image/jpeg"})
        faces = self._numbers(sheet.faces.astype("<u4"), "SCALAR", _UINT, {})
        self._primitives.append({"attributes": attributes, "indices": faces, "material": len(self._materials)})
        self._materials.append(material)

    def _numbers(self, values: NDArray[Any], kind: str, component: int, more: dict[str, Any]) -> int:
        """Add an array; returns its accessor."""
        is_scalar = kind == "SCALAR"
        view = self._view(values, values.nbytes, target=_INDICES if is_scalar else _ARRAY)
        count = values.size if is_scalar else len(values)
        self._accessors.append(
            {"bufferView": view, "componentType": component, "count": count, "type": kind, **more}
        )
        return len(self._accessors) - 1

    def _view(self, blob: NDArray[Any] | Path, size: int, **more: int) -> int:
        self._views.append({"buffer": 0, "byteOffset": self.num_bytes, "byteLength": size, **more})
        self.blobs.append(blob)
        self.num_bytes += size + -size % 4
        return len(self._views) - 1

    def content(self) -> dict[str, Any]:
        """The part of the file that is JSON."""
        document = {
            "asset": {"version": "2.0", "generator": "colmap_sph"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "matrix": self._turn.T.ravel().tolist()}],
            "meshes": [{"primitives": self._primitives}],
            "materials": self._materials,
            "buffers": [{"byteLength": self.num_bytes}],
            "bufferViews": self._views,
            "accessors": self._accessors,
        }
        if self._images:
            document["extensionsUsed"] = [_UNLIT]
            document["images"] = self._images
            document["textures"] = [{"source": number} for number in range(len(self._images))]
        return document
