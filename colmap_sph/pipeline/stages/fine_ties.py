"""Disparity maps of pairs and their images → ties as fine as the images tell them, in image coordinates.

Soft photographs are matched coarsely, and what is measured in coarse windows knows its place less well than the
images do. Poses need the places: windows of such pairs are taken anew, a pixel of the window a pixel of the image.
"""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.pipeline.stages.pair_files import read_pair, read_ties
from colmap_sph.project.images.reading import read_grey
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.poses.ties import find_corners, find_ties
from colmap_sph.stereo.poses.tracks import ImageTies, image_coordinates
from colmap_sph.stereo.rectified_pair import RectifiedPair

CACHE_BYTES = 256 << 20
"""Of images that are kept while pairs are measured."""

_Grey = NDArray[np.uint8] | NDArray[np.float32]


def fine_ties(workspace: Workspace, pairs: Mapping[Pair, Path], scene: Scene) -> dict[Pair, ImageTies]:
    """Ties of all pairs; a pair whose file or images cannot be read has none.

    Parameters
    ----------
    workspace : Workspace
    pairs : mapping
        Files of the disparity maps.
    scene : Scene
        With the views that they were matched with.

    Returns
    -------
    dict
        Of each pair of image names.
    """
    photos: LoadCache[tuple[_Grey, NDArray[np.float64]]] = LoadCache(lambda photo: photo[0].nbytes)

    def photo(view: View) -> tuple[_Grey, NDArray[np.float64]]:
        return photos.get(view.name, lambda: _with_corners(workspace.image_path(view.name)))

    ties = {}
    with photos.holding(CACHE_BYTES):
        for pair, path in sorted(pairs.items()):
            with suppress(InputError):
                left, right = (scene.view(name) for name in pair)
                matched = read_pair(path)
                geometry, found = matched.geometry, read_ties(path)
                finer = _finer(left, right, geometry)
                if finer > 1:
                    image, corners = photo(left)
                    photos_of_pair = (left, image), (right, photo(right)[0])
                    found = find_ties(*photos_of_pair, geometry, matched.disparity, corners, finer)
                ties[pair] = ImageTies(
                    image_coordinates(left, geometry, "left", found.left),
                    image_coordinates(right, geometry, "right", found.right),
                )
    return ties


def _with_corners(path: Path) -> tuple[_Grey, NDArray[np.float64]]:
    image = read_grey(path)
    return image, find_corners(image)


def _finer(left: View, right: View, geometry: RectifiedPair) -> float:
    """How many times finer than a rectified pixel one of the images is."""
    return max(float(view.K[0, 0]) for view in (left, right)) / geometry.columns_per_radian
