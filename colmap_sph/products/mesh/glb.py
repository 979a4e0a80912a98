"""A mesh → a GLB file: glTF 2.0 in one binary file, as browsers, Blender and game engines read it."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import OutputError
from colmap_sph.products.mesh.triangles import Triangles
from colmap_sph.project.files import atomic_file

_ARRAY, _INDICES = 34962, 34963
_FLOAT, _UBYTE, _UINT = 5126, 5121, 5125
# Of the whole file; its length is a number of 32 bits.
_MOST_BYTES = 2**32 - 1


def write_glb(path: Path, mesh: Triangles, axes: NDArray[np.float64]) -> None:
    """Write a mesh with the colours of its corners, upright: glTF's y is up.

    Parameters
    ----------
    path : Path
    mesh : Triangles
    axes : (3, 3) float64 ndarray
        Rows: to the right, to the top of a map, and up, in the mesh's frame.

    Raises
    ------
    OutputError
        It cannot be written, or is too large for the format.
    """
    middle = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    points = (mesh.points - middle).astype("<f4")
    colours = np.full((len(points), 4), 255, np.uint8)
    colours[:, :3] = mesh.colours
    faces = mesh.faces.astype("<u4")
    blobs = [points, colours, faces]
    size = sum(blob.nbytes for blob in blobs)
    text = json.dumps(_document(points, len(faces), axes, [blob.nbytes for blob in blobs])).encode()
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
        for blob in blobs:
            file.write(np.ascontiguousarray(blob).tobytes())


def _document(
    points: NDArray[np.float32], num_faces: int, axes: NDArray[np.float64], sizes: list[int]
) -> dict[str, Any]:
    turn = np.eye(4)
    turn[:3, :3] = [axes[0], axes[2], -axes[1]]
    starts = np.cumsum([0, *sizes[:-1]]).tolist()
    targets = (_ARRAY, _ARRAY, _INDICES)
    return {
        "asset": {"version": "2.0", "generator": "colmap_sph"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": turn.T.ravel().tolist()}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [
            {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
        ],
        "buffers": [{"byteLength": sum(sizes)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": size, "target": target}
            for start, size, target in zip(starts, sizes, targets, strict=True)
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(points),
                "type": "VEC3",
                "min": points.min(axis=0).tolist(),
                "max": points.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": _UBYTE, "normalized": True, "count": len(points), "type": "VEC4"},
            {"bufferView": 2, "componentType": _UINT, "count": 3 * num_faces, "type": "SCALAR"},
        ],
    }
