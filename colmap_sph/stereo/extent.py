"""Two views → what of the rectified surface their images cover: rows are epipolar planes, columns lie along them.

On the sphere rows and columns are angles λ and θ, on the plane they are tangents, see `rectified_pair`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import RectificationError
from colmap_sph.scene import View
from colmap_sph.stereo.disparity_range import Range
from colmap_sph.stereo.rectified_pair import Float, ray_angles

# Rows repeated on both sides of the seam where a whole circle of epipolar planes is in view.
SEAM_ROWS = 32
# Rays along an image's border, and of a grid over it, per side.
_SIDE_SAMPLES = 33
# Samples up to so far outside of the common rows count for their columns: a share of these rows, and so many steps
# from one sample to the next.
_ROW_MARGIN = 0.02
_MARGIN_STEPS = 2
# Rays at the sine of this to a plane, about 1°, or nearer meet it nowhere useful.
_LEAST_STEEPNESS = 0.02
# Views whose rays are kept: pairs are laid out in an order of place.
_KEPT_VIEWS = 256

# Centre and half width, radians.
_Arc = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Extent:
    """What of a surface the two images cover: angles (radians) on the sphere, tangents on the plane.

    Attributes
    ----------
    rotation : (3, 3) float64 ndarray
        World to rectified frame.
    rows : (float, float)
        Least and most of the epipolar planes that both images have.
    columns : pair of (float, float)
        Least and most along these planes, in the left and in the right image.
    seam : int
        Rows to repeat on both sides, where the rows go round the whole circle.
    """

    rotation: Float
    rows: Range
    columns: tuple[Range, Range]
    seam: int


def outline_of(view: View) -> Float:
    """(4, 2) corners of a view's image, in the order in which outlines have them."""
    return np.array([[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]], dtype=np.float64)


def extent_on_sphere(
    rotation: Float,
    left: View,
    right: View,
    min_cosine: float,
    outlines: tuple[Float, Float] | None = None,
) -> Extent:
    """What two images cover of the sphere around their baseline.

    Parameters
    ----------
    rotation : (3, 3) float64 ndarray
        World to rectified frame; that of the result is rolled about the baseline, so that the rows' middle is 0.
    left, right : View
    min_cosine : float
        Rays whose angle with the baseline has a sine (that is cos θ) below this are left out.
    outlines : pair of (n, 2) float64 ndarray, optional
        Of what of the images counts: the corners of a convex polygon in each, in the order of `outline_of`.

    Returns
    -------
    Extent

    Raises
    ------
    RectificationError
        No plane through the baseline is in both images.
    """
    outlines = (outline_of(left), outline_of(right)) if outlines is None else outlines
    views = (left, right)
    # Rolled about the baseline they stay what they are.
    signs = [epipole_sign(view, rotation, outline) for view, outline in zip(views, outlines, strict=True)]
    arcs = (row_arc(*each, rotation) for each in zip(views, outlines, signs, strict=True))
    centre, half = _common_arc(*arcs)
    if half <= 0:
        raise RectificationError("the two images share no epipolar plane")
    rotation = rolled(rotation, centre)
    columns = [column_extent(*each, rotation, -half, half) for each in zip(views, outlines, signs, strict=True)]
    return bounded_extent(rotation, half, columns, min_cosine)


def bounded_extent(rotation: Float, half: float, columns: Sequence[Range], min_cosine: float) -> Extent:
    """The extent with as many rows to both sides, and columns no nearer to the epipoles than `min_cosine`.

    Parameters
    ----------
    rotation : (3, 3) float64 ndarray
    half : float
        Radians; where it is π, rows go all around, and there is a seam.
    columns : two of (float, float)
        Least and most θ that the left and the right image show, radians.
    min_cosine : float
        See `extent_on_sphere`.
    """
    limit = float(np.arccos(min_cosine))
    left, right = ((max(low, -limit), min(high, limit)) for low, high in columns)
    seam = SEAM_ROWS if half >= np.pi else 0
    return Extent(rotation, (-half, half), (left, right), seam)


def extent_on_plane(
    rotation: Float,
    left: View,
    right: View,
    outlines: tuple[Float, Float] | None = None,
) -> Extent:
    """What two images cover of the plane parallel to their baseline, at the distance 1 from it.

    Parameters
    ----------
    rotation : (3, 3) float64 ndarray
        World to rectified frame.
    left, right : View
    outlines : pair of (n, 2) float64 ndarray, optional
        See `extent_on_sphere`.

    Returns
    -------
    Extent

    Raises
    ------
    RectificationError
        A viewing ray runs along the plane, or no plane through the baseline is in both images.
    """
    outlines = (outline_of(left), outline_of(right)) if outlines is None else outlines
    tangents = []
    for view, outline in zip((left, right), outlines, strict=True):
        rays = _border_rays(view, rotation, outline)
        if (rays[:, 2] <= _LEAST_STEEPNESS * np.linalg.norm(rays, axis=1)).any():
            raise RectificationError(
                "no plane parallel to the baseline can hold both images (a viewing ray runs along it)"
            )
        tangents.append(rays[:, :2] / rays[:, 2:])
    low = max(float(t[:, 1].min()) for t in tangents)
    high = min(float(t[:, 1].max()) for t in tangents)
    if high <= low:
        raise RectificationError("the two images share no epipolar plane")
    left_columns, right_columns = ((float(t[:, 0].min()), float(t[:, 0].max())) for t in tangents)
    return Extent(rotation, (low, high), (left_columns, right_columns), seam=0)


def rolled(rotation: Float, angle: float) -> Float:
    """The frame rolled about its x axis, so that row angle `angle` becomes 0."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ rotation)


def _border_rays(view: View, rotation: Float, outline: Float) -> Float:
    """(k n, 3) rays along an outline in the image, in the rectified frame, in order around it."""
    return np.asarray(_world_rays(view, tuple(map(tuple, outline.tolist())))[0] @ rotation.T)


@lru_cache(_KEPT_VIEWS)
def _world_rays(view: View, corners: tuple[tuple[float, ...], ...]) -> tuple[Float, Float]:
    """(k n, 3) and (m, 3) rays along an outline in the image and over what it surrounds, in the world frame.

    Many pairs of a view ask for them, one soon after the other.
    """
    outline = np.array(corners)
    t = np.linspace(0, 1, _SIDE_SAMPLES)[:, None]
    border = outline[:, None] + t * (np.roll(outline, -1, axis=0) - outline)[:, None]
    columns, rows = (np.linspace(*ends, _SIDE_SAMPLES) for ends in zip(*_box_of(outline), strict=True))
    x, y = np.meshgrid(columns, rows)
    grid = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    inner = grid[_is_within(outline, grid), :2]
    return _rays(view, border.reshape(-1, 2)), _rays(view, inner)


def _box_of(outline: Float) -> tuple[Float, Float]:
    """Least and largest x and y."""
    return outline.min(axis=0), outline.max(axis=0)


def _rays(view: View, pixels: Float) -> Float:
    """(n, 3) rays of pixels in the world frame."""
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ view.inverse_K.T
    return np.asarray(rays @ view.R)


def _is_within(outline: Float, pixels: Float) -> NDArray[np.bool_]:
    """Which of (n, 3) homogeneous pixels before the camera an outline surrounds."""
    edges = np.roll(outline, -1, axis=0) - outline
    x, y = (pixels[:, axis, None] - pixels[:, 2:] * outline[:, axis] for axis in (0, 1))
    return np.asarray((pixels[:, 2] > 0) & (edges[:, 0] * y - edges[:, 1] * x >= 0).all(axis=1))


def epipole_sign(view: View, rotation: Float, outline: Float) -> int:
    """+1 or -1 when the baseline's positive or negative direction lies inside the outline, else 0."""
    epipole = view.K @ view.R @ rotation[0]
    within = _is_within(outline, np.stack([epipole, -epipole]))
    return int(within[0]) - int(within[1])


def row_arc(view: View, outline: Float, sign: int, rotation: Float) -> _Arc:
    """Centre and half width of the image's row angles; the half width is π when it holds an epipole, of `sign`."""
    if sign:
        return 0.0, np.pi
    row_angles, _ = ray_angles(_border_rays(view, rotation, outline))
    # Without an epipole the image is a convex cone beside the axis: its arc is shorter than π.
    first = row_angles[0]
    turned = np.unwrap(np.angle(np.exp(1j * (row_angles - first))))
    return float(first + (turned.min() + turned.max()) / 2), float((turned.max() - turned.min()) / 2)


def _common_arc(left: _Arc, right: _Arc) -> _Arc:
    if left[1] >= np.pi:
        return right
    if right[1] >= np.pi:
        return left
    centre = left[0] + float(np.angle(np.exp(1j * (right[0] - left[0]))))
    low = max(left[0] - left[1], centre - right[1])
    high = min(left[0] + left[1], centre + right[1])
    return (low + high) / 2, (high - low) / 2


def column_extent(view: View, outline: Float, sign: int, rotation: Float, low: float, high: float) -> Range:
    """Range of θ of the part inside an outline whose row angles lie in [low, high]."""
    first, last = _box_of(outline)
    border, inner = _world_rays(view, tuple(map(tuple, outline.tolist())))
    row_angles, column_angles = ray_angles(np.concatenate([inner @ rotation.T, border @ rotation.T]))
    step_pixels = _MARGIN_STEPS * np.hypot(*(last - first)) / _SIDE_SAMPLES
    margin = (high - low) * _ROW_MARGIN + step_pixels / view.K[0, 0]
    kept = column_angles[(row_angles > low - margin) & (row_angles < high + margin)]
    if not len(kept):
        return 0.0, 0.0
    least, most = float(kept.min()), float(kept.max())
    return (-np.pi / 2 if sign < 0 else least), (np.pi / 2 if sign > 0 else most)
