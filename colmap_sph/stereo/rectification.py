"""Image pair → rectified pair: rows are epipolar planes, on a sphere around the baseline or on a plane.

Rectified frame: x along the baseline from the left to the right centre, z towards the scene. On the sphere
(Elhashash & Qin, §3.2, after their swap of axes) the ray of a rectified pixel is

    (sin θ, cos θ sin λ, cos θ cos λ),   λ = row angle about the baseline, θ = angle inside the epipolar plane

and a point seen at θ_l and θ_r has the parallax angle δ = θ_l − θ_r > 0. On the plane ("frame", §3.1) the
ray is (x, y, 1) and the parallax x_l − x_r = baseline / Z. Both are described by one record, `RectifiedPair`:
array coordinate = (angle or tangent) · scale − origin, with pixel centres at whole array coordinates.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from colmap_sph.errors import OptionError, RectificationError
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.rectified_pair import Float, RectifiedPair, Surface

# Rows repeated on both sides of the seam where a whole circle of epipolar planes is in view.
_SEAM_ROWS = 32
# Fewer shared points than this say too little about the range of parallaxes.
_MIN_RANGE_POINTS = 8
_SIDE_SAMPLES = 33
# In units of the depth: a parallax of some hundredths of a pixel, and more than centres on a grid are off.
_LEAST_BASELINE = 1e-5
# What follows from sparse points is rounded to so many binary digits, so that the last of theirs does not count.
_DIGITS = 11
# cv2.remap takes no more rows or columns.
_MAX_SIDE = 32766


@dataclass(frozen=True)
class RectificationOptions:
    """How pairs are rectified."""

    surface: Surface = "spherical"
    """Surface the images are resampled to: a sphere around the baseline, or a plane (the classic "frame")."""
    sampling: float = 1.0
    """Rectified pixels per pixel of the finer image."""
    min_cosine: float = 0.1
    """Rays closer to the baseline than acos of this (about 6° off the epipole) are left out."""
    near_margin: float = 2.0
    """Surfaces are looked for down to the distance of the nearest sparse points divided by this: treetops and
    roofs often carry no sparse point."""
    far_margin: float = 1.5
    """… and up to the distance of the farthest sparse points times this."""
    max_pixels_ratio: float = 8.0
    """A pair is given up when its rectified images have more pixels than this times the originals."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        if self.surface not in ("spherical", "frame"):
            raise OptionError(f"surface must be 'spherical' or 'frame', not {self.surface!r}.", "surface")
        if not 0.05 <= self.sampling <= 4:
            raise OptionError(f"sampling must lie in 0.05..4, not {self.sampling}.", "sampling")
        if not 0.01 <= self.min_cosine <= 0.9:
            raise OptionError(f"min_cosine must lie in 0.01..0.9, not {self.min_cosine}.", "min_cosine")
        for name in ("near_margin", "far_margin"):
            if not 1 <= getattr(self, name) <= 20:
                raise OptionError(f"{name} must lie in 1..20, not {getattr(self, name)}.", name)
        if not 1 <= self.max_pixels_ratio <= 100:
            raise OptionError(
                f"max_pixels_ratio must lie in 1..100, not {self.max_pixels_ratio}.", "max_pixels_ratio"
            )


def rectify_pair(scene: Scene, left: View, right: View, options: RectificationOptions) -> RectifiedPair:
    """Lay out the rectified images of a pair.

    Parameters
    ----------
    scene : Scene
        For the sparse points, which give the range of parallaxes.
    left, right : View
        The pair; which one is called left is free.
    options : RectificationOptions

    Returns
    -------
    RectifiedPair

    Raises
    ------
    RectificationError
        The centres coincide, the images do not overlap, or the chosen surface cannot hold the pair.
    """
    baseline = float(np.linalg.norm(right.center - left.center))
    depths = (scene.points[left.point_indices] - left.center) @ left.viewing_direction
    scale = float(np.median(depths)) if len(depths) else 0.0
    if not baseline > max(_LEAST_BASELINE * scale, 1e-12 * float(np.abs(left.center).max())):
        raise RectificationError("the two images have the same projection centre")
    rotation = _rectifying_rotation(left, right)
    points = _points_in_both(scene, left, right)
    if options.surface == "spherical":
        return _lay_out_sphere(rotation, baseline, left, right, points, options)
    return _lay_out_plane(rotation, baseline, left, right, points, options)


# ---- rotation -----------------------------------------------------------------------------------------------


def _rectifying_rotation(left: View, right: View) -> Float:
    """Rotation to the rectified frame (paper §3.1, in photogrammetric axes)."""
    r1 = right.center - left.center
    r1 /= np.linalg.norm(r1)
    reference = left.viewing_direction + right.viewing_direction
    across = reference - r1 * (r1 @ reference)
    if np.linalg.norm(across) < 0.2:
        # Forward motion, or opposite views: the roll about the baseline is free, so take any camera axis.
        across = left.R[1] - r1 * (r1 @ left.R[1])
        if np.linalg.norm(across) < 0.2:
            across = left.R[0] - r1 * (r1 @ left.R[0])
    r3 = across / np.linalg.norm(across)
    return np.stack([r1, np.cross(r3, r1), r3])


def _rolled(rotation: Float, angle: float) -> Float:
    """The frame rolled about its x axis, so that row angle `angle` becomes 0."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ rotation)


# ---- what both images see -----------------------------------------------------------------------------------


def _points_in_both(scene: Scene, left: View, right: View) -> Float:
    """Sparse points that one of the views observes and both have in view."""
    indices = np.union1d(left.point_indices, right.point_indices)
    points = scene.points[indices]
    for view in (left, right):
        pixel = (points @ view.R.T + view.t) @ view.K.T
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            uv = pixel[:, :2] / pixel[:, 2:]
        inside = (pixel[:, 2] > 0) & (uv > 0).all(axis=1) & (uv < [view.width, view.height]).all(axis=1)
        points = points[inside]
    return np.asarray(points)


def _border_rays(view: View, rotation: Float) -> Float:
    """(4 n, 3) rays along the image border, in the rectified frame, in order around the image."""
    t = np.linspace(0, 1, _SIDE_SAMPLES)
    zero, one = np.zeros_like(t), np.ones_like(t)
    x = np.concatenate([t, one, 1 - t, zero]) * view.width
    y = np.concatenate([zero, t, one, 1 - t]) * view.height
    rays = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(view.K).T
    return np.asarray(rays @ view.R @ rotation.T)


def _angles(rays: Float) -> tuple[Float, Float]:
    """(λ, θ) of rays in the rectified frame."""
    return np.arctan2(rays[:, 1], rays[:, 2]), np.arctan2(rays[:, 0], np.hypot(rays[:, 1], rays[:, 2]))


def _epipole_sign(view: View, rotation: Float) -> int:
    """+1 or -1 when the baseline's positive or negative direction lies inside the image, else 0."""
    for sign in (1, -1):
        pixel = view.K @ view.R @ (sign * rotation[0])
        if pixel[2] > 0 and 0 <= pixel[0] <= pixel[2] * view.width and 0 <= pixel[1] <= pixel[2] * view.height:
            return sign
    return 0


def _row_arc(view: View, rotation: Float) -> tuple[float, float]:
    """Centre and half width of the image's row angles; the half width is π when it holds an epipole."""
    if _epipole_sign(view, rotation):
        return 0.0, np.pi
    row_angles, _ = _angles(_border_rays(view, rotation))
    # Without an epipole the image is a convex cone beside the axis: its arc is shorter than π.
    first = row_angles[0]
    turned = np.angle(np.exp(1j * (row_angles - first)))
    turned = np.unwrap(turned)
    return float(first + (turned.min() + turned.max()) / 2), float((turned.max() - turned.min()) / 2)


def _common_arc(left: tuple[float, float], right: tuple[float, float]) -> tuple[float, float]:
    if left[1] >= np.pi:
        return right
    if right[1] >= np.pi:
        return left
    centre = left[0] + float(np.angle(np.exp(1j * (right[0] - left[0]))))
    low = max(left[0] - left[1], centre - right[1])
    high = min(left[0] + left[1], centre + right[1])
    return (low + high) / 2, (high - low) / 2


def _column_extent(view: View, rotation: Float, low: float, high: float) -> tuple[float, float]:
    """Range of θ of the part of the image whose row angles lie in [low, high]."""
    n = _SIDE_SAMPLES
    x, y = np.meshgrid(np.linspace(0, view.width, n), np.linspace(0, view.height, n))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(n * n)], axis=1) @ np.linalg.inv(view.K).T
    row_angles, column_angles = _angles(rays @ view.R @ rotation.T)
    margin = (high - low) * 0.02 + 2 * np.hypot(view.width, view.height) / n / view.K[0, 0]
    kept = column_angles[(row_angles > low - margin) & (row_angles < high + margin)]
    if not len(kept):
        return 0.0, 0.0
    sign = _epipole_sign(view, rotation)
    least, most = float(kept.min()), float(kept.max())
    return (-np.pi / 2 if sign < 0 else least), (np.pi / 2 if sign > 0 else most)


def _finest_scale(left: View, right: View, points: Float) -> float:
    """Pixels per radian of the finer image, averaged over the overlap.

    A pixel at the angle α off axis has the solid angle cos³ α / f², so its mean side is cos^1.5 α / f.
    """
    scales = []
    for view in (left, right):
        if len(points):
            rays = points @ view.R.T + view.t
            cosine = rays[:, 2] / np.linalg.norm(rays, axis=1)
        else:
            cosine = np.ones(1)
        scales.append(float(np.sqrt(view.K[0, 0] * view.K[1, 1]) * np.mean(cosine**-1.5)))
    return _few_digits(max(scales), np.round)


# ---- layouts ------------------------------------------------------------------------------------------------


def _lay_out_sphere(
    rotation: Float, baseline: float, left: View, right: View, points: Float, options: RectificationOptions
) -> RectifiedPair:
    centre, half = _common_arc(_row_arc(left, rotation), _row_arc(right, rotation))
    if half <= 0:
        raise RectificationError("the two images share no epipolar plane")
    rotation = _rolled(rotation, centre)
    limit = float(np.arccos(options.min_cosine))
    extents = []
    for view in (left, right):
        low, high = _column_extent(view, rotation, -half, half)
        extents.append((max(low, -limit), min(high, limit)))
    least, most = _parallax_range(_parallax_angles(left, right, rotation, points), options)
    (left_low, left_high), (right_low, right_high) = _crop(extents, least, most)
    scale = _finest_scale(left, right, points) * options.sampling
    nearest = max(0.0, left_low, -left_high), max(0.0, right_low, -right_high)
    rows_per_radian = scale * float(np.cos(min(nearest)))
    seam = _SEAM_ROWS if half >= np.pi else 0
    return _checked_size(
        RectifiedPair(
            surface="spherical",
            rectified_from_world=rotation,
            baseline=baseline,
            columns_per_radian=scale,
            rows_per_radian=rows_per_radian,
            row_origin=-half * rows_per_radian - seam,
            left_origin=left_low * scale,
            right_origin=right_low * scale,
            height=int(np.ceil(2 * half * rows_per_radian)) + 1 + 2 * seam,
            left_width=int(np.ceil((left_high - left_low) * scale)) + 1,
            right_width=int(np.ceil((right_high - right_low) * scale)) + 1,
            min_disparity=(least - left_low + right_low) * scale,
            max_disparity=(most - left_low + right_low) * scale,
        ),
        left,
        right,
        options,
    )


def _lay_out_plane(
    rotation: Float, baseline: float, left: View, right: View, points: Float, options: RectificationOptions
) -> RectifiedPair:
    tangents = []
    for view in (left, right):
        rays = _border_rays(view, rotation)
        if (rays[:, 2] <= 0.02 * np.linalg.norm(rays, axis=1)).any():
            raise RectificationError(
                "no plane parallel to the baseline can hold both images (a viewing ray runs along it)"
            )
        tangents.append(rays[:, :2] / rays[:, 2:])
    low = max(float(t[:, 1].min()) for t in tangents)
    high = min(float(t[:, 1].max()) for t in tangents)
    if high <= low:
        raise RectificationError("the two images share no epipolar plane")
    least, most = _parallax_range(_parallax_tangents(left, rotation, points, baseline), options)
    extents = [(float(t[:, 0].min()), float(t[:, 0].max())) for t in tangents]
    (left_low, left_high), (right_low, right_high) = _crop(extents, least, most)
    scale = _finest_scale(left, right, points) * options.sampling
    return _checked_size(
        RectifiedPair(
            surface="frame",
            rectified_from_world=rotation,
            baseline=baseline,
            columns_per_radian=scale,
            rows_per_radian=scale,
            row_origin=low * scale,
            left_origin=left_low * scale,
            right_origin=right_low * scale,
            height=int(np.ceil((high - low) * scale)) + 1,
            left_width=int(np.ceil((left_high - left_low) * scale)) + 1,
            right_width=int(np.ceil((right_high - right_low) * scale)) + 1,
            min_disparity=(least - left_low + right_low) * scale,
            max_disparity=(most - left_low + right_low) * scale,
        ),
        left,
        right,
        options,
    )


def _parallax_angles(left: View, right: View, rotation: Float, points: Float) -> Float:
    _, left_angles = _angles((points - left.center) @ rotation.T)
    _, right_angles = _angles((points - right.center) @ rotation.T)
    return np.asarray(left_angles - right_angles)


def _parallax_tangents(left: View, rotation: Float, points: Float, baseline: float) -> Float:
    depth = (points - left.center) @ rotation[2]
    return np.asarray(baseline / depth[depth > 0])


def _parallax_range(parallax: Float, options: RectificationOptions) -> tuple[float, float]:
    """Range to search: robust extremes of the sparse points' parallaxes with a generous margin."""
    if len(parallax) < _MIN_RANGE_POINTS:
        return np.radians(0.3), np.radians(60)
    least, most = np.percentile(parallax, [1, 99])
    least, most = _few_digits(max(float(least), 1e-4), np.floor), _few_digits(max(float(most), 1e-4), np.ceil)
    return least / options.far_margin, most * options.near_margin


def _few_digits(value: float, rounded: Callable[[float], float]) -> float:
    fraction, exponent = np.frexp(value)
    return float(np.ldexp(rounded(fraction * 2**_DIGITS), exponent - _DIGITS))


def _crop(
    extents: list[tuple[float, float]], least: float, most: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Columns of each image that have a counterpart in the other at some parallax of the range."""
    (left_low, left_high), (right_low, right_high) = extents
    left = max(left_low, right_low + least), min(left_high, right_high + most)
    right = max(right_low, left_low - most), min(right_high, left_high - least)
    if left[1] <= left[0] or right[1] <= right[0]:
        raise RectificationError("the two images do not overlap at the depths of the sparse points")
    return left, right


def _checked_size(pair: RectifiedPair, left: View, right: View, options: RectificationOptions) -> RectifiedPair:
    pixels = pair.height * (pair.left_width + pair.right_width)
    originals = left.width * left.height + right.width * right.height
    allowed = options.max_pixels_ratio * originals * max(1.0, options.sampling**2)
    if max(pair.height, pair.left_width, pair.right_width) > _MAX_SIDE:
        raise RectificationError(f"its rectified images would have more than {_MAX_SIDE} rows or columns")
    if pixels > allowed:
        raise RectificationError(
            f"its rectified images would have {pixels / originals:.1f} times the pixels of the originals"
        )
    if min(pair.height, pair.left_width, pair.right_width) < 16:
        raise RectificationError("the overlap is less than 16 pixels wide")
    return pair


# ---- resampling maps ----------------------------------------------------------------------------------------
