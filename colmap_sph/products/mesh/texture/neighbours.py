"""Triangles → which of them share an edge."""

import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.mesh.triangles import Triangles


def neighbours_of(mesh: Triangles) -> NDArray[np.int32]:
    """Find the faces beside each face, also where parts meet whose points are the same in place alone.

    Parameters
    ----------
    mesh : Triangles
        With m faces.

    Returns
    -------
    (m, 3) int32 ndarray
        The face beyond each edge; the face itself where there is none.

    Examples
    --------
    >>> points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    >>> faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    >>> neighbours_of(Triangles(points, np.zeros((4, 3), np.uint8), faces)).tolist()
    [[0, 1, 0], [0, 1, 1]]
    """
    corners = _by_place(mesh.points)[mesh.faces]
    first = corners.ravel()
    second = np.roll(corners, -1, axis=1).ravel()
    edge = np.minimum(first, second).astype(np.int64) * len(mesh.points) + np.maximum(first, second)
    order = np.argsort(edge, kind="stable")
    is_same = edge[order[1:]] == edge[order[:-1]]
    one, other = order[:-1][is_same], order[1:][is_same]
    beside = np.repeat(np.arange(len(mesh.faces), dtype=np.int32), 3)
    beside[one] = other // 3
    beside[other] = one // 3
    return beside.reshape(-1, 3)


def _by_place(points: NDArray[np.float32]) -> NDArray[np.int64]:
    """(n,) a number for each point, the same for points in one place."""
    order = np.lexsort(points.T)
    moved = (points[order[1:]] != points[order[:-1]]).any(axis=1)
    numbers = np.empty(len(points), np.int64)
    numbers[order] = np.concatenate([[0], np.cumsum(moved)])
    return numbers
