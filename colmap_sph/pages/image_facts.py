"""One image of a workspace → its small pictures, and what became of its pixels."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.pages.pictures import depth_picture, normal_picture, picture_uri, reason_picture
from colmap_sph.pages.reasons import Reason
from colmap_sph.pages.samples import MapSamples, read_normals
from colmap_sph.project.images.reading import image_problem, read_small_colours
from colmap_sph.project.state.ownership import undistorted_place
from colmap_sph.project.undistortion.rounding import coarsest_jpeg_step
from colmap_sph.project.wide.projection import Lens
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import View
from colmap_sph.stereo.blank import blank_pixels

Bytes = NDArray[np.uint8]

# Longest side at which an image is looked at; bytes of all pictures of a page, and of those of one image at most.
_LOOKED_AT = 512
_ALL_BYTES = 3_900_000
_MOST_BYTES = 60_000
# What each picture may take of them, and its longest side in samples of the maps.
_PARTS = {"picture": 0.38, "depth": 0.22, "normals": 0.24, "reasons": 0.16}
_PICTURE_SIDE = 1.6


@dataclass(frozen=True)
class Picture:
    """A picture of an image, as it is shown."""

    name: str
    uri: str
    width: int
    height: int
    note: str = ""
    exact: bool = False


@dataclass(frozen=True)
class ImageFacts:
    """What is known of an image, less what the run's report says.

    Attributes
    ----------
    name : str
    shares : tuple of float
        Share of its samples of each `Reason`.
    found : float
        Share with a photometric depth, of those that show the region.
    gsd : float or None
        Median of depth by focal length where there is a geometric depth, model units per pixel.
    has_maps : bool
    pictures : tuple of Picture
        Empty where none are shown.
    footprint : (4, 2) float64 ndarray or None
        Corners on the map, see `Frame.place`.
    width, height : int
        Pixels.
    cut_into : tuple of str
        Names of the views that were cut from it; none of an image that is whole.
    """

    name: str
    shares: tuple[float, ...]
    found: float
    gsd: float | None
    has_maps: bool
    pictures: tuple[Picture, ...]
    footprint: NDArray[np.float64] | None
    width: int
    height: int
    cut_into: tuple[str, ...] = ()

    @property
    def coverage(self) -> float:
        """Share with a geometric depth, of those samples that show the region."""
        return self.shares[Reason.CONFIRMED] / max(1 - self.shares[Reason.OUTSIDE], 1e-9)


def read_small_picture(workspace: Workspace, view: View) -> Bytes | None:
    """A view's image, small: (h, w, 3), blue, green and red; None where it cannot be read."""
    path = workspace.image_path(view.name)
    with suppress(InputError):
        if image_problem(path, view.width, view.height, decode=False) is None:
            return read_small_colours(path, _LOOKED_AT)
    return None


def find_blank(
    workspace: Workspace, name: str, picture: Bytes | None, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Where an image, of `read_small_picture`, shows nothing that could be matched, at samples of its maps."""
    if picture is None:
        return np.zeros(shape, bool)
    step = coarsest_jpeg_step(workspace.image_path(name), undistorted_place(workspace, name).record)
    blank = blank_pixels(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8), step)
    return np.asarray(cv2.resize(blank, shape[::-1], interpolation=cv2.INTER_NEAREST) > 0)


def facts_of_image(
    view: View,
    samples: MapSamples,
    reasons: Bytes,
    pictures: tuple[Picture, ...],
    footprint: NDArray[np.float64] | None,
) -> ImageFacts:
    """Count what became of a view's samples; see `ImageFacts`."""
    counts = np.bincount(reasons.ravel(), minlength=len(Reason))
    confirmed = samples.geometric > 0
    voted = (samples.photometric > 0) & (reasons != Reason.OUTSIDE)
    gsd = float(np.median(samples.geometric[confirmed]) / view.K[0, 0]) if confirmed.any() else None
    return ImageFacts(
        view.name,
        tuple((counts / reasons.size).tolist()),
        int(voted.sum()) / max(reasons.size - int(counts[Reason.OUTSIDE]), 1),
        gsd,
        samples.has_maps,
        pictures,
        footprint,
        view.width,
        view.height,
    )


def small_pictures(
    workspace: Workspace, view: View, samples: MapSamples, reasons: Bytes, picture: Bytes | None, shown: int
) -> tuple[Picture, ...]:
    """Make the pictures of one of `shown` images, the fewer the larger: image, depth, normals, and reasons.

    Parameters
    ----------
    workspace : Workspace
    view : View
    samples : MapSamples
    reasons : (h, w) uint8 ndarray
    picture : (H, W, 3) uint8 ndarray or None
        Blue, green and red, as of `read_small_picture`.
    shown : int
        Images whose pictures share the page.
    """
    parts: dict[str, Bytes] = {}
    note = ""
    if picture is not None:
        scale = min(1, _PICTURE_SIDE * max(reasons.shape) / max(picture.shape[:2]))
        size = [max(round(scale * side), 1) for side in picture.shape[1::-1]]
        small = cv2.cvtColor(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2RGB)
        parts["picture"] = np.asarray(small, np.uint8)
    if samples.has_maps:
        parts["depth"], ends = depth_picture(
            np.where(samples.has_geometric, samples.geometric, samples.photometric)
        )
        note = "" if ends is None else f"{ends[0]:.4g} (yellow) to {ends[1]:.4g} (blue)"
        normals = read_normals(workspace, view, samples)
        if normals is not None:
            parts["normals"] = normal_picture(normals)
    parts["reasons"] = reason_picture(reasons)
    return make_pictures(parts, view, shown, note)


def make_pictures(
    parts: Mapping[str, Bytes], view: View | Lens, shown: int, depth_note: str
) -> tuple[Picture, ...]:
    """Pictures of one of `shown` images by their names, of the shape of `view`; a note goes with depth."""
    most = min(_ALL_BYTES / shown, _MOST_BYTES)
    return tuple(
        _picture(name, pixels, view, most, depth_note if name == "depth" else "") for name, pixels in parts.items()
    )


def _picture(name: str, pixels: Bytes, view: View | Lens, most: float, note: str) -> Picture:
    exact = name == "reasons"
    uri = picture_uri(pixels, int(most * _PARTS[name]), exact=exact)
    shown = "confirmed, and lost" if exact else name
    # All of an image's pictures are of its shape, to the pixel.
    width = 320
    return Picture(shown, uri, width, max(round(width * view.height / view.width), 1), note, exact)
