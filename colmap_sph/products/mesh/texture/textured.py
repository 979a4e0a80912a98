"""A mesh and its workspace → pages of texture in files, and which faces lie where on them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.mesh.texture.atlas import drawn_pages, lay_out
from colmap_sph.products.mesh.texture.choice import choose_views
from colmap_sph.products.mesh.triangles import Triangles
from colmap_sph.products.surface.pictures import pictures_of
from colmap_sph.products.surface.seen import SeenView
from colmap_sph.project.files import atomic_file
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene

_QUALITY = 92


@dataclass(frozen=True, eq=False)
class Sheet:
    """Faces of a mesh with one picture, or with the colours of their corners.

    Attributes
    ----------
    points : (n, 3) float32 ndarray
        Scene frame. Points where parts of the picture meet are there for each of them.
    faces : (m, 3) int32 ndarray
    colours : (n, 3) uint8 ndarray
        Red, green, blue of the corners.
    uv : (n, 2) float32 ndarray, optional
        Places on the picture, from 0, 0 in its upper left corner to 1, 1.
    picture : Path, optional
        JPEG file.
    """

    points: NDArray[np.float32]
    faces: NDArray[np.int32]
    colours: NDArray[np.uint8]
    uv: NDArray[np.float32] | None = None
    picture: Path | None = None


def plain(mesh: Triangles) -> Sheet:
    """A mesh without texture."""
    return Sheet(mesh.points, mesh.faces, mesh.colours)


def textured(
    mesh: Triangles,
    workspace: Workspace,
    scene: Scene,
    seen: Sequence[SeenView],
    tolerance: float,
    folder: Path,
    advance: Callable[[], None],
) -> list[Sheet]:
    """Give each face a part of the image that sees it best.

    One image, one page and one depth map at a time are in memory, besides the mesh.

    Parameters
    ----------
    mesh : Triangles
    workspace : Workspace
    scene : Scene
    seen : sequence of SeenView
    tolerance : float
        By which depths of the same surface differ at most, scene units.
    folder : Path
        For the pages.
    advance : callable
        Called after each view.

    Returns
    -------
    list of Sheet
        One for each page, and one for the faces that no image sees.
    """
    chosen = choose_views(mesh, workspace, seen, tolerance, advance)
    sheets = []
    if (chosen >= 0).any():
        charts, on_pages = lay_out(mesh, chosen, seen)
        pictures = pictures_of(workspace, scene, seen, balance=True, memory=0)
        for number, page in enumerate(drawn_pages(charts, pictures.of)):
            path = folder / f"page-{number}.jpg"
            _write_jpeg(path, page)
            of_page = on_pages.page == number
            sheets.append(_sheet(mesh, on_pages.faces[of_page], on_pages.uv[of_page], path))
    unseen = np.flatnonzero(chosen < 0)
    if len(unseen):
        used, renumbered = np.unique(mesh.faces[unseen], return_inverse=True)
        faces = renumbered.reshape(-1, 3).astype(np.int32)
        sheets.append(Sheet(mesh.points[used], faces, mesh.colours[used]))
    return sheets


def _sheet(mesh: Triangles, faces: NDArray[np.intp], uv: NDArray[np.float32], picture: Path) -> Sheet:
    """Corners in one place of the mesh and of the picture are one."""
    corners = mesh.faces[faces].ravel()
    places = uv.reshape(-1, 2)
    order = np.lexsort((places[:, 1], places[:, 0], corners))
    is_new = np.ones(len(order), bool)
    is_new[1:] = np.diff(corners[order]).astype(bool) | np.diff(places[order], axis=0).any(axis=1)
    number = np.empty(len(order), np.int32)
    number[order] = np.cumsum(is_new) - 1
    kept = order[is_new]
    points = corners[kept]
    return Sheet(mesh.points[points], number.reshape(-1, 3), mesh.colours[points], places[kept], picture)


def _write_jpeg(path: Path, page: NDArray[np.uint8]) -> None:
    data = cv2.imencode(".jpg", page[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    with atomic_file(path) as file:
        file.write(data.tobytes())
