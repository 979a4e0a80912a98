"""Arrays → small pictures inside of a page: WebP as data URIs, none larger than it may be."""

import base64

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.pages.reasons import Reason

Bytes = NDArray[np.uint8]

# Red, green, blue of each reason: told apart by people who do not see all colours, on white and on black.
COLOURS: dict[Reason, tuple[int, int, int]] = {
    Reason.CONFIRMED: (148, 163, 184),
    Reason.OUTSIDE: (90, 96, 106),
    Reason.MASKED: (30, 30, 34),
    Reason.ONE_IMAGE: (230, 159, 0),
    Reason.NO_PARALLAX: (240, 228, 66),
    Reason.BLANK: (86, 180, 233),
    Reason.NOT_FOUND: (0, 114, 178),
    Reason.CONTRADICTED: (213, 60, 0),
    Reason.ALONE: (204, 121, 167),
}
# Where a map has nothing.
_NOTHING = (44, 46, 52)
# Of a layer of the map at most.
_LAYER_BYTES = 150_000
_QUALITIES = (80, 60, 40, 20)
_SMALLEST = 16
_LOSSLESS = 101


def layer_uri(picture: Bytes, *, exact: bool = False) -> str:
    """A layer of the map as a URI, see `picture_uri`."""
    return picture_uri(picture, _LAYER_BYTES, exact=exact)


def picture_uri(picture: Bytes, most_bytes: int, *, exact: bool = False) -> str:
    """A picture as a data URI.

    Parameters
    ----------
    picture : (H, W, 3) or (H, W, 4) uint8 ndarray
        Red, green, blue (and opacity).
    most_bytes : int
        Of its file: it is coarser, and then smaller, where it would take more.
    exact : bool
        Whether no colour may be changed.
    """
    swapped = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA if picture.shape[2] == 4 else cv2.COLOR_RGB2BGR)
    qualities = (_LOSSLESS,) if exact else _QUALITIES
    while True:
        for quality in qualities:
            data = cv2.imencode(".webp", swapped, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
            if len(data) <= most_bytes:
                return _uri(data)
        height, width = swapped.shape[:2]
        if min(height, width) <= _SMALLEST:
            return _uri(data)
        how = cv2.INTER_NEAREST if exact else cv2.INTER_AREA
        swapped = cv2.resize(swapped, (width * 3 // 4, height * 3 // 4), interpolation=how)


def _uri(data: bytes) -> str:
    return "data:image/webp;base64," + base64.b64encode(data).decode("ascii")


def depth_picture(depth: NDArray[np.float32]) -> tuple[Bytes, tuple[float, float] | None]:
    """Near yellow, far blue; and the depths at both ends of the scale, None where there is no depth."""
    found = depth > 0
    if not found.any():
        return _empty(depth.shape), None
    near, far = (float(value) for value in np.percentile(depth[found], (1, 99)))
    scaled = (depth - near) / max(far - near, 1e-6 * far)
    return shaded(1 - scaled, found), (near, far)


def shaded(values: NDArray[np.floating], there: NDArray[np.bool_], *, clear: bool = False) -> Bytes:
    """Values from 0, dark blue, to 1, yellow; dark grey, or nothing if `clear`, where there are none."""
    steps = np.where(there, 255 * np.clip(np.nan_to_num(values), 0, 1), 0).astype(np.uint8)
    coloured = cv2.cvtColor(cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    coloured[~there] = _NOTHING
    return (
        np.dstack([coloured, np.where(there, 255, 0).astype(np.uint8)])
        if clear
        else np.asarray(coloured, np.uint8)
    )


def normal_picture(normals: NDArray[np.float32]) -> Bytes:
    """(3, h, w) normals in the camera's frame: red right, green up, blue towards the camera."""
    x, y, z = np.nan_to_num(normals)
    picture = np.clip(127.5 * (1 + np.dstack([x, -y, -z])), 0, 255).astype(np.uint8)
    picture[(x == 0) & (y == 0) & (z == 0)] = _NOTHING
    return picture


def reason_picture(reasons: Bytes) -> Bytes:
    """A map of `Reason`s in their colours."""
    table = np.array([COLOURS[reason] for reason in Reason], np.uint8)
    return np.asarray(table[reasons])


def uncovered(picture: Bytes, where: NDArray[np.bool_]) -> Bytes:
    """A picture (h, w, 3) that shows nothing in some places (h, w)."""
    return np.asarray(np.where(where[:, :, None], np.array(_NOTHING, np.uint8), picture))


def _empty(shape: tuple[int, ...]) -> Bytes:
    return np.full((*shape, 3), _NOTHING, np.uint8)


def colour_of(reason: Reason) -> str:
    """A reason's colour, as a style sheet writes it."""
    return "#{:02x}{:02x}{:02x}".format(*COLOURS[reason])
