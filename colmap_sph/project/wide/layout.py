"""Which pinhole views are cut from the image of a wide lens.

Views overlap, since matching loses a margin of each. Of a fisheye up to about 200 degrees these are four, tilted
into the quarters of its image, or to the left, right, up and down where these have fewer pixels; each reaches from
a little beyond the axis to the rim. Of what sees more they are six, as of the faces of a cube, but wider. All are
cropped to what the lens shows, and one that shows nothing but what others show as well is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from colmap_sph.project.wide.projection import (
    PANORAMA,
    Lens,
    camera_rays,
    focal_length,
    image_points,
    principal_point,
)

Float = NDArray[np.float64]
Rotation = tuple[tuple[float, float, float], ...]

# Degrees. What a single pinhole view shows at most; how far off the axis four views reach.
WIDEST_PINHOLE = 110.0
_FOUR_VIEWS = 103.0
# By which neighbours overlap across the axis, and beyond the rim; half a face of the cube.
_OVERLAP = 9.0
_RIM = 1.5
_HALF_FACE = 55.0
# Four views tilted into the quarters have what lies level with the axis, often a horizon with most there is to
# see, off their own axes, where pinholes have more pixels per degree. They may have so many times the pixels.
_MOST_PIXELS = 1.1
# A view is left out where others show all that it does, so far within their borders.
_MARGIN = 5.0
_GRID = 96
_CROP_GRID = 160
_HALF = 0.5
# What views are called: to the sides, and as these come to lie when they are turned by 45 degrees.
_SIDES = ("left", "right", "up", "down")
_QUARTERS = ("lower_left", "upper_right", "upper_left", "lower_right")


@dataclass(frozen=True)
class Face:
    """A pinhole view cut from a wide image.

    Attributes
    ----------
    name : str
        "left", say.
    rotation : 3 tuples of 3 floats
        Rows: x, y and z of the view in the camera's frame.
    width, height : int
        Pixels.
    focal : float
        Pixels.
    x, y : float
        Principal point, pixels.
    """

    name: str
    rotation: Rotation
    width: int
    height: int
    focal: float
    x: float
    y: float

    @property
    def R(self) -> Float:
        """(3, 3): from the camera's frame to the view's."""
        return np.array(self.rotation)

    def rays(self, rows: slice) -> Float:
        """(pixels, 3) rays in the camera's frame of the centres of some rows of pixels; z is 1 in the view's."""
        x = (np.arange(self.width) + 0.5 - self.x) / self.focal
        y = (np.arange(rows.start, rows.stop) + 0.5 - self.y) / self.focal
        across, down = np.meshgrid(x, y)
        rays = np.column_stack([across.ravel(), down.ravel(), np.ones(across.size)])
        return np.asarray(rays @ self.R)

    def points(self, rays: Float) -> tuple[Float, NDArray[np.bool_]]:
        """(n, 2) image coordinates of (n, 3) rays in the camera's frame, and which of them the view shows."""
        local = rays @ self.R.T
        with np.errstate(divide="ignore", invalid="ignore"):
            places = local[:, :2] / local[:, 2:] * self.focal + (self.x, self.y)
            inside = (places >= 0).all(axis=1) & (places <= (self.width, self.height)).all(axis=1)
        return places, inside & (local[:, 2] > 0)

    def margins(self, rays: Float) -> Float:
        """Radians by which (n, 3) unit rays in the camera's frame lie within the borders; negative beyond."""
        low, high = (-self.x, -self.y), (self.width - self.x, self.height - self.y)
        sides = np.array(
            [
                [self.focal, 0, -low[0]],
                [-self.focal, 0, high[0]],
                [0, self.focal, -low[1]],
                [0, -self.focal, high[1]],
            ]
        )
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        return np.asarray(np.arcsin(np.clip(rays @ self.R.T @ sides.T, -1, 1)).min(axis=1))


def shown(lens: Lens, points: Float) -> NDArray[np.bool_]:
    """Whether image coordinates (n, 2) lie between four pixels of the image, or across a panorama's seam."""
    low = np.full(2, _HALF)
    high = np.array([lens.width, lens.height]) - _HALF
    if lens.model == PANORAMA:
        low[1], high[1] = 0, lens.height  # beyond the last row lies the pole
        if lens.width == lens.params[0]:
            low[0], high[0] = 0, lens.width
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))


def angles_shown(lens: Lens) -> tuple[float, float]:
    """Degrees that a fisheye shows along its middle row and column."""
    x, y = principal_point(lens)
    ends = np.array([[_HALF, y], [lens.width - _HALF, y], [x, _HALF], [x, lens.height - _HALF]])
    angles = np.degrees(_angles(lens, ends))
    return float(angles[:2].sum()), float(angles[2:].sum())


def _angles(lens: Lens, points: Float) -> Float:
    """Radians off the axis of what image coordinates (n, 2) show; the lens's limit beyond that."""
    rays = camera_rays(lens, points)
    return np.where(np.isnan(rays[:, 2]), lens.limit, np.arccos(np.clip(rays[:, 2], -1, 1)))


@lru_cache(maxsize=64)
def faces_of(lens: Lens, scale: float = 1.0, max_size: int = -1) -> tuple[Face, ...]:
    """Views to cut from the images of a lens.

    Parameters
    ----------
    lens : Lens
        Fisheye or panorama.
    scale : float
        Focal length of the views, of the lens's in the middle of its image.
    max_size : int
        Longest side of a view in pixels, where they would be larger; -1: as they come.

    Returns
    -------
    tuple of Face
    """
    rays = _rays_shown(lens)
    if not len(rays):
        return ()
    reach = float(np.arccos(np.clip(rays[:, 2].min(), -1, 1)))
    focal = scale * focal_length(lens)
    if lens.model != PANORAMA and np.degrees(reach) <= _FOUR_VIEWS:
        quarters = _needed(lens, _four(reach, focal, _QUARTERS, np.pi / 4), rays)
        sides = _needed(lens, _four(reach, focal, _SIDES, 0.0), rays)
        faces = quarters if _pixels(quarters) <= _MOST_PIXELS * _pixels(sides) else sides
    else:
        faces = _needed(lens, _cube(focal), rays)
    longest = max(max(face.width, face.height) for face in faces)
    if max_size > 0 and longest > max_size:
        return faces_of(lens, scale * (max_size - 1) / longest, max_size)
    return tuple(faces)


def _rays_shown(lens: Lens) -> Float:
    """(n, 3) rays all over the image, and of its border."""
    x = np.linspace(_HALF, lens.width - _HALF, _GRID)
    y = np.linspace(_HALF, lens.height - _HALF, _GRID)
    rays = camera_rays(lens, np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2))
    return rays[~np.isnan(rays).any(axis=1)]


def _four(reach: float, focal: float, names: Sequence[str], turn: float) -> list[Face]:
    """Views tilted off the axis, of a lens that shows so much to all sides, radians.

    To the left, right, up and down, or to where these are once turned about the axis, radians.
    """
    tilt = reach / 2 + np.radians(1.0)
    rim = reach + np.radians(_RIM)
    # Between two views, at 45 degrees, each must reach the rim to its side.
    sine = np.sin(rim) * np.sqrt(0.5)
    side = max(sine / (sine * np.sin(tilt) + np.cos(rim) * np.cos(tilt)), np.tan(tilt))
    inner = np.tan(tilt + np.radians(_OVERLAP))
    outer = np.tan(rim - tilt)
    # How far to the rim the corner of a view reaches beyond the middle of its side, cropping will say.
    outer = max(outer, side)
    tilts = (_about(1, -tilt), _about(1, tilt), _about(0, tilt), _about(0, -tilt))
    borders = (
        (outer, side, inner, side),
        (inner, side, outer, side),
        (side, outer, side, inner),
        (side, inner, side, outer),
    )
    turned = _about(2, turn)
    return [
        _drawn(name, rotation @ turned, reaches, focal)
        for name, rotation, reaches in zip(names, tilts, borders, strict=True)
    ]


def _cube(focal: float) -> list[Face]:
    half = float(np.tan(np.radians(_HALF_FACE)))
    turns = (
        ("front", 1, 0),
        ("right", 1, 90),
        ("back", 1, 180),
        ("left", 1, -90),
        ("up", 0, 90),
        ("down", 0, -90),
    )
    return [_drawn(name, _about(axis, np.radians(turn)), (half,) * 4, focal) for name, axis, turn in turns]


def _drawn(name: str, rotation: Float, borders: Sequence[float], focal: float) -> Face:
    """A view with the tangents of the angles to its left, top, right and bottom border."""
    left, top, right, bottom = (float(border * focal) for border in borders)
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    width, height = int(np.ceil(left + right)), int(np.ceil(top + bottom))
    return Face(name, ((a, b, c), (d, e, f), (g, h, i)), width, height, focal, left, top)


def _about(axis: int, angle: float) -> Float:
    """From the camera's frame to one turned about its x (0: upward), y (1: to the right) or z axis (2)."""
    cosine, sine = np.cos(angle), np.sin(angle)
    if axis == 2:
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    if axis == 0:
        return np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]])
    return np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])


def _needed(lens: Lens, drawn: list[Face], rays: Float) -> list[Face]:
    """Those views that show `rays` which no other shows, cropped to what the lens shows."""
    return [_cropped(lens, face, rays) for face in _without_idle(drawn, rays)]


def _pixels(faces: Sequence[Face]) -> int:
    return sum(face.width * face.height for face in faces)


def _cropped(lens: Lens, face: Face, rays: Float) -> Face:
    """A view without rows and columns at its borders that show nothing of a lens; that shows `rays` and others."""
    x, y = np.linspace(0, face.width, _CROP_GRID), np.linspace(0, face.height, _CROP_GRID)
    grid = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    local = np.column_stack([(grid - (face.x, face.y)) / face.focal, np.ones(len(grid))])
    places, inside = face.points(rays)
    seen = np.concatenate([grid[shown(lens, image_points(lens, local @ face.R))], places[inside]])
    # What is between two places that were looked at may be seen.
    step = np.array([x[1], y[1]])
    size = (face.width, face.height)
    left, top = (int(value) for value in np.maximum(np.floor(seen.min(axis=0) - step), 0))
    right, bottom = (int(value) for value in np.minimum(np.ceil(seen.max(axis=0) + step), size))
    return replace(face, width=right - left, height=bottom - top, x=face.x - left, y=face.y - top)


def _without_idle(faces: list[Face], rays: Float) -> list[Face]:
    """Leave out views that show nothing but what others show, too."""
    margins = np.stack([face.margins(rays) for face in faces])
    kept = list(range(len(faces)))
    for number in sorted(kept, key=lambda each: int((margins[each] > 0).sum())):
        others = [other for other in kept if other != number]
        own = margins[number] > 0
        if not own.any() or (others and (margins[others][:, own].max(axis=0) >= np.radians(_MARGIN)).all()):
            kept = others
    return [faces[number] for number in kept]
