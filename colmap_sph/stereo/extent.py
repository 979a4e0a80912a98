"""Two views → what of the rectified surface their images cover: rows are epipolar planes, columns lie along them.

On the sphere rows and columns are angles λ and θ, on the plane they are tangents, see `rectified_pair`.
"""

from dataclasses import dataclass

import numpy as np

from colmap_sph.errors import RectificationError
from colmap_sph.scene import View
from colmap_sph.stereo.disparity_range import Range, parallax_angles, parallax_tangents
from colmap_sph.stereo.rectified_pair import Float, ray_angles

# Rows repeated on both sides of the seam where a whole circle of epipolar planes is in view.
_SEAM_ROWS = 32
# Rays along an image's border, and of a grid over it, per side.
_SIDE_SAMPLES = 33
# Samples up to so far outside of the common rows count for their columns: a share of these rows, and so many steps
# from one sample to the next.
_ROW_MARGIN = 0.02
_MARGIN_STEPS = 2
# Rays at the sine of this to a plane, about 1°, or nearer meet it nowhere useful.
_LEAST_STEEPNESS = 0.02

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
    parallaxes : (n,) float64 ndarray
        Of the sparse points that both see.
    seam : int
        Rows to repeat on both sides, where the rows go round the whole circle.
    """

    rotation: Float
    rows: Range
    columns: tuple[Range, Range]
    parallaxes: Float
    seam: int


def extent_on_sphere(rotation: Float, left: View, right: View, points: Float, min_cosine: float) -> Extent:
    """What two images cover of the sphere around their baseline.

    Parameters
    ----------
    rotation : (3, 3) float64 ndarray
        World to rectified frame; that of the result is rolled about the baseline, so that the rows' middle is 0.
    left, right : View
    points : (n, 3) float64 ndarray
        Sparse points that both see, world frame.
    min_cosine : float
        Rays whose angle with the baseline has a sine (that is cos θ) below this are left out.

    Returns
    -------
    Extent

    Raises
    ------
    RectificationError
        No plane through the baseline is in both images.
    """
    centre, half = _common_arc(_row_arc(left, rotation), _row_arc(right, rotation))
    if half <= 0:
        raise RectificationError("the two images share no epipolar plane")
    rotation = _rolled(rotation, centre)
    limit = float(np.arccos(min_cosine))
    columns: list[Range] = []
    for view in (left, right):
        low, high = _column_extent(view, rotation, -half, half)
        columns.append((max(low, -limit), min(high, limit)))
    parallaxes = parallax_angles(left, right, rotation, points)
    seam = _SEAM_ROWS if half >= np.pi else 0
    return Extent(rotation, (-half, half), (columns[0], columns[1]), parallaxes, seam)


def extent_on_plane(rotation: Float, left: View, right: View, points: Float, baseline: float) -> Extent:
    """What two images cover of the plane parallel to their baseline, at the distance 1 from it.

    Parameters
    ----------
    rotation : (3, 3) float64 ndarray
        World to rectified frame.
    left, right : View
    points : (n, 3) float64 ndarray
        Sparse points that both see, world frame.
    baseline : float
        Distance of the projection centres, model units.

    Returns
    -------
    Extent

    Raises
    ------
    RectificationError
        A viewing ray runs along the plane, or no plane through the baseline is in both images.
    """
    tangents = []
    for view in (left, right):
        rays = _border_rays(view, rotation)
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
    parallaxes = parallax_tangents(left, rotation, points, baseline)
    return Extent(rotation, (low, high), (left_columns, right_columns), parallaxes, seam=0)


def _rolled(rotation: Float, angle: float) -> Float:
    """The frame rolled about its x axis, so that row angle `angle` becomes 0."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ rotation)


def _border_rays(view: View, rotation: Float) -> Float:
    """(4 n, 3) rays along the image border, in the rectified frame, in order around the image."""
    t = np.linspace(0, 1, _SIDE_SAMPLES)
    zero = np.zeros_like(t)
    one = np.ones_like(t)
    x = np.concatenate([t, one, 1 - t, zero]) * view.width
    y = np.concatenate([zero, t, one, 1 - t]) * view.height
    rays = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(view.K).T
    return np.asarray(rays @ view.R @ rotation.T)


def _epipole_sign(view: View, rotation: Float) -> int:
    """+1 or -1 when the baseline's positive or negative direction lies inside the image, else 0."""
    for sign in (1, -1):
        pixel = view.K @ view.R @ (sign * rotation[0])
        if pixel[2] > 0 and 0 <= pixel[0] <= pixel[2] * view.width and 0 <= pixel[1] <= pixel[2] * view.height:
            return sign
    return 0


def _row_arc(view: View, rotation: Float) -> _Arc:
    """Centre and half width of the image's row angles; the half width is π when it holds an epipole."""
    if _epipole_sign(view, rotation):
        return 0.0, np.pi
    row_angles, _ = ray_angles(_border_rays(view, rotation))
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


def _column_extent(view: View, rotation: Float, low: float, high: float) -> Range:
    """Range of θ of the part of the image whose row angles lie in [low, high]."""
    n = _SIDE_SAMPLES
    x, y = np.meshgrid(np.linspace(0, view.width, n), np.linspace(0, view.height, n))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(n * n)], axis=1) @ np.linalg.inv(view.K).T
    row_angles, column_angles = ray_angles(rays @ view.R @ rotation.T)
    step_pixels = _MARGIN_STEPS * np.hypot(view.width, view.height) / n
    margin = (high - low) * _ROW_MARGIN + step_pixels / view.K[0, 0]
    kept = column_angles[(row_angles > low - margin) & (row_angles < high + margin)]
    if not len(kept):
        return 0.0, 0.0
    sign = _epipole_sign(view, rotation)
    least, most = float(kept.min()), float(kept.max())
    return (-np.pi / 2 if sign < 0 else least), (np.pi / 2 if sign > 0 else most)
