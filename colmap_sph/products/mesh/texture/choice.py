"""A mesh and the views that see it → the view that each face takes its picture from."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.mesh.texture.neighbours import neighbours_of
from colmap_sph.products.mesh.triangles import Triangles
from colmap_sph.products.surface.seen import SeenView, read_part
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import View
from colmap_sph.stereo.surface.visibility import looked_up, towards_border

# So often the worth of a face is averaged with that of the faces beside it, so that seams are few.
_ROUNDS = 12
# A view without a depth there, which may see it all the same, counts for so much of one with it.
_UNCONFIRMED = 0.01
# Places on a face that are looked at, as weights of its corners.
_PLACES = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / np.array([[3], [6], [6], [6]])
_CHUNK = 1 << 18


def choose_views(
    mesh: Triangles, workspace: Workspace, seen: Sequence[SeenView], tolerance: float, advance: Callable[[], None]
) -> NDArray[np.int32]:
    """Find the view with the most pixels on each face, and on those around it, that sees it unoccluded.

    Parameters
    ----------
    mesh : Triangles
        With m faces.
    workspace : Workspace
    seen : sequence of SeenView
    tolerance : float
        By which depths of the same surface differ at most, scene units.
    advance : callable
        Called after each view.

    Returns
    -------
    (m,) int32 ndarray
        Places in `seen`; -1 where none sees the face.
    """
    beside = neighbours_of(mesh)
    chosen = np.full(len(mesh.faces), -1, np.int32)
    most = np.zeros(len(mesh.faces), np.float32)
    for place, each in enumerate(seen):
        view = each.view
        depth = read_part(workspace, view, (0, 0, view.width, view.height), with_normals=False).depth
        worth = worth_of_faces(mesh, view, depth, tolerance)
        faces = np.flatnonzero(worth)
        smooth = _smoothed(worth, faces, beside)
        is_better = smooth > most[faces]
        chosen[faces[is_better]] = place
        most[faces[is_better]] = smooth[is_better]
        advance()
    return chosen


def worth_of_faces(
    mesh: Triangles, view: View, depth: NDArray[np.float32], tolerance: float
) -> NDArray[np.float32]:
    """Pixels of a view per area of each face, less towards the image's border; 0 where it does not see the face.

    Parameters
    ----------
    mesh : Triangles
        With m faces.
    view : View
    depth : (view.height, view.width) float32 ndarray
        z-depth along the ray K⁻¹ (column, row, 1), scene units; 0 = none.
    tolerance : float
        See `choose_views`.

    Returns
    -------
    (m,) float32 ndarray
    """
    worth = np.zeros(len(mesh.faces), np.float32)
    for first in range(0, len(mesh.faces), _CHUNK):
        part = slice(first, first + _CHUNK)
        worth[part] = _worth(mesh.points[mesh.faces[part]].astype(np.float64), view, depth, tolerance)
    return worth


def _worth(
    corners: NDArray[np.float64], view: View, depth: NDArray[np.float32], tolerance: float
) -> NDArray[np.float64]:
    """Of (n, 3, 3) corners of faces."""
    pixels, z = view.project(corners.reshape(-1, 3))
    pixels, z = np.nan_to_num(pixels, nan=-1.0).reshape(-1, 3, 2), z.reshape(-1, 3)
    # Between pixels' centres: beyond there is no colour to interpolate.
    inside = ((pixels >= 0.5) & (pixels <= np.array([view.width, view.height]) - 0.5)).all(axis=2) & (z > 0)
    facing = -_twice_area(pixels)  # the image's y is down
    index = np.flatnonzero(inside.all(axis=1) & (facing > 0))
    worth = np.zeros(len(corners))
    if not len(index):
        return worth
    corners, pixels = corners[index], pixels[index]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    is_free = np.ones(len(index), bool)
    matches = np.zeros(len(index), bool)
    for weights in _PLACES:
        places, far = view.project(np.einsum("nki,k->ni", corners, weights))
        found = looked_up(depth, places[:, 0], places[:, 1], far, tolerance)
        is_free &= found.is_free
        matches |= found.matches
    middle = pixels.mean(axis=1)
    border = towards_border(middle[:, 0], middle[:, 1], view, view)
    sharp = facing[index] / np.maximum(area, 1e-30) * border
    worth[index] = np.where(is_free, np.where(matches, sharp, _UNCONFIRMED * sharp), 0)
    return worth


def _twice_area(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) signed, of (n, 3, 2) corners."""
    along, across = pixels[:, 1] - pixels[:, 0], pixels[:, 2] - pixels[:, 0]
    return np.asarray(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0])


def _smoothed(
    worth: NDArray[np.float32], faces: NDArray[np.intp], beside: NDArray[np.int32]
) -> NDArray[np.float32]:
    """The worth of these faces, averaged along the surface; others count as 0, as it ends for the view there."""
    place = np.full(len(worth), len(faces), np.int64)
    place[faces] = np.arange(len(faces))
    around = place[beside[faces]]
    smooth = np.append(worth[faces], np.float32(0))
    for _ in range(_ROUNDS):
        smooth[:-1] = (smooth[:-1] + smooth[around].sum(axis=1)) / 4
    return smooth[:-1]
