"""Wavefront OBJ files → vertices and triangles. Normals, texture, materials and curves are left alone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from colmap_sph.evaluation.neighbours import Points
from colmap_sph.evaluation.polygons import Faces, Polygons

_VERTEX = re.compile(rb"\s*v\s")
_FACE = re.compile(rb"\s*f\s")
_TEXTURE_AND_NORMAL = re.compile(rb"/\S*")


def read_obj(path: Path) -> tuple[Points, Faces]:
    """Read a cloud or a mesh.

    Parameters
    ----------
    path : Path
        A regular file.

    Returns
    -------
    points : (N, 3) float64 ndarray
    faces : (F, 3) int64 ndarray
        Rows of `points`, as the file says; F = 0 for a cloud.

    Raises
    ------
    ValueError, OverflowError
        A line of a vertex or a face is not one; the text says why.
    """
    text = path.read_bytes()
    if b"\0" in text:
        raise ValueError("it is not text")
    vertices: list[bytes] = []
    polygons = Polygons()
    for line in text.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").split(b"\n"):
        if _VERTEX.match(line):
            vertices.append(line)
        elif _FACE.match(line):
            polygons.add_one(_corners(line, len(vertices)))
    if not vertices:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    points = np.loadtxt(vertices, np.float64, comments="#", ndmin=2, usecols=(1, 2, 3))
    return points, polygons.triangles() - 1


def _corners(line: bytes, num_vertices: int) -> list[bytes]:
    """Numbers of a face's corners, from 1; negative ones count back from the last vertex so far."""
    words = _TEXTURE_AND_NORMAL.sub(b"", line.partition(b"#")[0]).split()[1:]
    if b"-" not in line:
        return words
    return [b"%d" % (num_vertices + 1 + int(word)) if word.startswith(b"-") else word for word in words]
