"""Faces with views → pages of parts of images, and where on them the corners of each face lie.

No face is unfolded: what it shows is a part of an image already. An image is cut along squares, and the part of it
that the faces of a square need goes onto a page as it is, at full resolution.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.mesh.triangles import Triangles
from colmap_sph.products.surface.seen import SeenView

# Pixels along a square.
_SQUARE = 64
# Pixels of the image around what faces need, for smaller copies of a page that programs make.
_AROUND = 3
_SIDE = 4096
_CHUNK = 1 << 18


@dataclass(frozen=True, eq=False)
class Charts:
    """Parts of images, and their places on pages.

    Attributes
    ----------
    view : (n,) int32 ndarray
        Places in the sequence of views, ascending.
    box : (n, 4) int32 ndarray
        Left, top, right and bottom in the image, the last two excluded.
    page : (n,) int32 ndarray
    corner : (n, 2) int32 ndarray
        Column and row on the page.
    sizes : list of (int, int)
        Width and height of each page.
    """

    view: NDArray[np.int32]
    box: NDArray[np.int32]
    page: NDArray[np.int32]
    corner: NDArray[np.int32]
    sizes: list[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class OnPages:
    """Where faces lie on pages.

    Attributes
    ----------
    faces : (m,) intp ndarray
        Which faces of the mesh have a picture.
    page : (m,) int32 ndarray
    uv : (m, 3, 2) float32 ndarray
        From 0, 0 in the upper left corner of the page to 1, 1.
    """

    faces: NDArray[np.intp]
    page: NDArray[np.int32]
    uv: NDArray[np.float32]


def lay_out(mesh: Triangles, chosen: NDArray[np.int32], seen: Sequence[SeenView]) -> tuple[Charts, OnPages]:
    """Cut the images and lay the parts onto pages.

    Parameters
    ----------
    mesh : Triangles
    chosen : (m,) int32 ndarray
        See `choose_views`.
    seen : sequence of SeenView

    Returns
    -------
    charts : Charts
    on_pages : OnPages
    """
    faces = np.flatnonzero(chosen >= 0)
    faces = faces[np.argsort(chosen[faces], kind="stable")]
    pixels = _pixels(mesh, faces, chosen, seen)
    squares = np.floor(pixels.mean(axis=1) / _SQUARE).astype(np.int64)
    key = (chosen[faces].astype(np.int64) << 40) + (squares[:, 1] << 20) + squares[:, 0]
    order = np.argsort(key, kind="stable")
    faces, pixels, key = faces[order], pixels[order], key[order]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    number = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(key)))
    view = chosen[faces[starts]]
    charts = _laid_out(view, _boxes(pixels, starts, view, seen))
    sizes = np.array(charts.sizes, np.float64).reshape(-1, 2)
    shift = charts.corner - charts.box[:, :2]
    uv = (pixels + shift[number][:, None]) / sizes[charts.page[number]][:, None]
    return charts, OnPages(faces, charts.page[number], uv.astype(np.float32))


def _pixels(
    mesh: Triangles, faces: NDArray[np.intp], chosen: NDArray[np.int32], seen: Sequence[SeenView]
) -> NDArray[np.float32]:
    """(m, 3, 2) image coordinates of the corners of faces, which are sorted by views."""
    pixels = np.empty((len(faces), 3, 2), np.float32)
    bounds = np.searchsorted(chosen[faces], np.arange(len(seen) + 1))
    for each, start, end in zip(seen, bounds[:-1], bounds[1:], strict=True):
        for first in range(start, end, _CHUNK):
            part = slice(first, min(first + _CHUNK, end))
            points = mesh.points[mesh.faces[faces[part]]].reshape(-1, 3).astype(np.float64)
            pixels[part] = each.view.project(points)[0].reshape(-1, 3, 2)
    return pixels


def _boxes(
    pixels: NDArray[np.float32], starts: NDArray[np.intp], view: NDArray[np.int32], seen: Sequence[SeenView]
) -> NDArray[np.int32]:
    """(n, 4) what of the images the faces from each start on need."""
    least = np.floor(np.minimum.reduceat(pixels.min(axis=1), starts)) - _AROUND
    most = np.ceil(np.maximum.reduceat(pixels.max(axis=1), starts)) + _AROUND
    size = np.array([(each.view.width, each.view.height) for each in seen])[view]
    return np.concatenate([np.maximum(least, 0), np.minimum(most, size)], axis=1).astype(np.int32)


def _laid_out(view: NDArray[np.int32], box: NDArray[np.int32]) -> Charts:
    """Put boxes side by side in rows, view by view and the tallest first, onto as many pages as it takes."""
    size = box[:, 2:] - box[:, :2]
    width, height = (max(_SIDE, int(side)) for side in size.max(axis=0))
    page = np.empty(len(box), np.int32)
    corner = np.empty((len(box), 2), np.int32)
    sizes: list[tuple[int, int]] = []
    left = top = tall = 0
    for index in np.lexsort((-size[:, 1], view)).tolist():
        across, down = size[index].tolist()
        if left + across > width:
            left, top, tall = 0, top + tall, 0
        if top + down > height:
            sizes.append((width, top + tall))
            left = top = tall = 0
        page[index] = len(sizes)
        corner[index] = left, top
        left += across
        tall = max(tall, down)
    sizes.append((width if top else left, top + tall))
    return Charts(view, box, page, corner, sizes)


def drawn_pages(charts: Charts, picture_of: Callable[[int], NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    """Each page with its parts of images, (H, W, 3).

    Parameters
    ----------
    charts : Charts
    picture_of : callable
        The image of a view, by its place in the sequence of views. A view is asked for once for each page that
        has something of it.
    """
    for number, (width, height) in enumerate(charts.sizes):
        page = np.zeros((height, width, 3), np.uint8)
        on_page = np.flatnonzero(charts.page == number)
        for view in np.unique(charts.view[on_page]).tolist():
            picture = picture_of(view)
            for index in on_page[charts.view[on_page] == view].tolist():
                left, top, right, bottom = charts.box[index].tolist()
                column, row = charts.corner[index].tolist()
                part = picture[top:bottom, left:right]
                page[row : row + bottom - top, column : column + right - left] = part
        yield page
