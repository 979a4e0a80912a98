"""Disparity maps of pairs and their images → ties as fine as the images tell them, in image coordinates.

Soft photographs are matched coarsely, and what is measured in coarse windows knows its place less well than the
images do. Poses need the places: windows of such pairs are taken anew, a pixel of the window a pixel of the image.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from colmap_sph.errors import InputError
from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.pipeline.stages.pair_files import read_pair_with_ties
from colmap_sph.pipeline.stages.photo import Photo
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.poses.ties import find_ties
from colmap_sph.stereo.poses.tracks import ImageTies
from colmap_sph.stereo.rectified_pair import RectifiedPair, image_coordinates

CACHE_BYTES = 256 << 20
"""Of images that are kept while pairs are measured."""


def fine_ties(
    workspace: Workspace, pairs: Mapping[Pair, Path], scene: Scene, step: Callable[[], None]
) -> dict[tuple[str, str], ImageTies]:
    """Ties of all pairs; a pair whose file or images cannot be read has none.

    Parameters
    ----------
    workspace : Workspace
    pairs : mapping
        Files of the disparity maps.
    scene : Scene
        With the views that they were matched with.
    step : callable
        Called after each pair.

    Returns
    -------
    dict
        Of each pair of image names, left and right.
    """
    photos: LoadCache[Photo] = LoadCache(lambda photo: photo.nbytes)

    def photo(view: View) -> Photo:
        return photos.get(view.name, lambda: Photo.read(workspace.image_path(view.name)))

    ties = {}
    with photos.holding(CACHE_BYTES):
        for _, path in sorted(pairs.items()):
            with suppress(InputError):
                matched, found = read_pair_with_ties(path)
                geometry = matched.geometry
                left, right = scene.view(matched.left), scene.view(matched.right)
                finer = _finer(left, right, geometry)
                if finer > 1:
                    photos_of_pair = (left, photo(left).image), (right, photo(right).image)
                    found = find_ties(*photos_of_pair, geometry, matched.disparity, photo(left).corners, finer)
                ties[left.name, right.name] = ImageTies(
                    image_coordinates(left, geometry, "left", found.left),
                    image_coordinates(right, geometry, "right", found.right),
                )
            step()
    return ties


def _finer(left: View, right: View, geometry: RectifiedPair) -> float:
    """How many times finer than a rectified pixel one of the images is."""
    return max(float(view.K[0, 0]) for view in (left, right)) / geometry.scales[0]
