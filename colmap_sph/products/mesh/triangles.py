"""Triangles with coloured corners, and PLY files of them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError, OutputError
from colmap_sph.project.files import atomic_file

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
_CHUNK = 1 << 18
_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "uint": "<u4"}
_MAX_HEADER = 1 << 14


@dataclass(frozen=True, eq=False)
class Triangles:
    """A mesh, or a part of one.

    Attributes
    ----------
    points : (n, 3) float32 ndarray
        Scene frame.
    colours : (n, 3) uint8 ndarray
        Red, green, blue.
    faces : (m, 3) int32 ndarray
        Rows of points, counter-clockwise from outside.
    """

    points: NDArray[np.float32]
    colours: NDArray[np.uint8]
    faces: NDArray[np.int32]


def joined(parts: Sequence[Triangles]) -> Triangles:
    """Parts beside each other, as one mesh; where they meet, each keeps points of its own, in the same places."""
    if not parts:
        return Triangles(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.int32))
    points = np.concatenate([part.points for part in parts])
    colours = np.concatenate([part.colours for part in parts])
    first = np.cumsum([0, *(len(part.points) for part in parts[:-1])])
    faces = np.concatenate([part.faces + shift for part, shift in zip(parts, first, strict=True)])
    return Triangles(points, colours, faces.astype(np.int32))


def write_ply(path: Path, mesh: Triangles, points: NDArray[np.floating]) -> None:
    """Write a mesh with its points elsewhere: (n, 3), float64 as ``double``; `OutputError` where it cannot be."""
    kind = "double" if points.dtype == np.float64 else "float"
    vertex = np.dtype([("xyz", points.dtype.newbyteorder("<"), 3), ("rgb", "u1", 3)])
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {kind} {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    with atomic_file(path) as file:
        file.write("\n".join(header).encode())
        for first in range(0, len(points), _CHUNK):
            rows = slice(first, first + _CHUNK)
            chunk = np.empty(len(points[rows]), vertex)
            chunk["xyz"] = points[rows]
            chunk["rgb"] = mesh.colours[rows]
            file.write(chunk.tobytes())
        for first in range(0, len(mesh.faces), _CHUNK):
            corners = mesh.faces[first : first + _CHUNK]
            faces = np.empty(len(corners), _FACE)
            faces["count"] = 3
            faces["corners"] = corners
            file.write(faces.tobytes())


def read_ply(path: Path) -> Triangles:
    """Read a mesh that COLMAP or `write_ply` wrote.

    Raises
    ------
    NoResultError
        It has no triangles.
    OutputError
        It was not written to its end, of which COLMAP tells nobody.
    """
    cut_off = OutputError(
        f"{path} cannot be written whole; free some space, raise the limit (a quota, or ulimit -f), or choose "
        "another --output."
    )
    with path.open("rb") as file:
        start = file.read(_MAX_HEADER)
        end = start.find(b"end_header\n") + len(b"end_header\n")
        if end < len(b"end_header\n"):
            raise cut_off
        header = start[:end].decode("ascii", "replace")
        counts = {kind: int(number) for kind, number in re.findall(r"element (\w+) (\d+)", header)}
        of_vertex = header.split("element face")[0]
        fields = [(name, _TYPES[kind]) for kind, name in re.findall(r"property (\w+) (\w+)\n", of_vertex)]
        count, corner = re.findall(r"property list (\w+) (\w+) ", header)[0]
        face = np.dtype([("count", _TYPES[count]), ("corners", _TYPES[corner], 3)])
        if not counts.get("vertex") or not counts.get("face"):
            raise NoResultError("The mesh has no faces: there are too few points for a surface; try --trim 0.")
        file.seek(end)
        vertices = np.fromfile(file, np.dtype(fields), counts["vertex"])
        faces = np.fromfile(file, face, counts["face"])
    if (len(vertices), len(faces)) != (counts["vertex"], counts["face"]):
        raise cut_off
    points = np.stack([vertices[name] for name in "xyz"], axis=1).astype(np.float32)
    colours = np.full((len(points), 3), 200, np.uint8)
    if vertices.dtype.names is not None and "red" in vertices.dtype.names:
        colours = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1).astype(np.uint8)
    return Triangles(points, colours, np.ascontiguousarray(faces["corners"], np.int32))
