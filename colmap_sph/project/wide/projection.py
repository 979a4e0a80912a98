"""Fisheyes and panoramas: rays ↔ image coordinates, for all angles off the axis.

COLMAP's formulas, but written with the angle between ray and axis in place of quotients by z, so that they go on
beyond 90 degrees, where its library has no rays or wrong ones.

Sources: COLMAP, `src/colmap/sensor/models.h`; J. Kannala, S. Brandt, A Generic Camera Model, PAMI 2006; F.
Devernay, O. Faugeras, Straight Lines Have to Be Straight, 2001; B. Khomutenko et al., An Enhanced Unified Camera
Model, 2016; A. Fitzgibbon, Simultaneous Linear Estimation of Multiple View Geometry and Lens Distortion, 2001.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Parameters = tuple[float, ...]

PANORAMA = "EQUIRECTANGULAR"

_NODES = 7201
_STEPS = 6
_DELTA = 1e-6
# Pixels by which what was found may miss what was asked for.
_MISS = 1e-6
_CLOSE = 1e-10
# Radians: the next step is about as long as this one's square.
_SMALL_STEP = 1e-7
_TINY = 1e-12


@dataclass(frozen=True)
class Lens:
    """A camera by its COLMAP model.

    Attributes
    ----------
    model : str
        COLMAP's name of the camera model; one of `MODELS` or `PANORAMA`.
    params : tuple of float
    width, height : int
        Pixels.
    limit : float
        Radians off the axis up to which the model is believed.
    """

    model: str
    params: Parameters
    width: int
    height: int
    limit: float = np.pi


def _polynomial(angle: Float, coefficients: Parameters) -> Float:
    square = angle * angle
    factor = np.zeros_like(angle)
    for coefficient in reversed(coefficients):
        factor = (factor + coefficient) * square
    return np.asarray(angle * (1 + factor))


def _fov(angle: Float, extra: Parameters) -> Float:
    (omega,) = extra
    if abs(omega) < _DELTA:
        return np.where(angle < np.pi / 2, np.tan(angle), np.nan)
    return np.asarray(np.arctan2(2 * np.sin(angle) * np.tan(omega / 2), np.cos(angle)) / omega)


def _unified(angle: Float, extra: Parameters) -> Float:
    alpha, beta = extra
    sine, cosine = np.sin(angle), np.cos(angle)
    depth = alpha * np.sqrt(beta * sine**2 + cosine**2) + (1 - alpha) * cosine
    return np.asarray(np.divide(sine, depth, out=np.full_like(angle, np.nan), where=depth > _TINY))


def _division(angle: Float, extra: Parameters) -> Float:
    (k,) = extra
    sine, cosine = np.sin(angle), np.cos(angle)
    inside = cosine**2 - 4 * k * sine**2
    depth = cosine + np.sqrt(np.maximum(inside, 0))
    is_seen = (inside >= 0) & (depth > _TINY)
    return np.asarray(np.divide(2 * sine, depth, out=np.full_like(angle, np.nan), where=is_seen))


def _thin_prism(extra: Parameters) -> Parameters:
    k1, k2, _, _, k3, k4, _, _ = extra
    return k1, k2, k3, k4


# Of each model: whether it has one focal length for x and y, the number of its other parameters but the principal
# point, and the radius in focal lengths by the angle.
_Radius = Callable[[Float, Parameters], Float]
MODELS: dict[str, tuple[bool, int, _Radius]] = {
    "SIMPLE_FISHEYE": (True, 0, _polynomial),
    "FISHEYE": (False, 0, _polynomial),
    "SIMPLE_RADIAL_FISHEYE": (True, 1, _polynomial),
    "RADIAL_FISHEYE": (True, 2, _polynomial),
    "OPENCV_FISHEYE": (False, 4, _polynomial),
    "THIN_PRISM_FISHEYE": (False, 8, lambda angle, extra: _polynomial(angle, _thin_prism(extra))),
    "RAD_TAN_THIN_PRISM_FISHEYE": (False, 12, lambda angle, extra: _polynomial(angle, extra[:6])),
    "FOV": (False, 1, _fov),
    "EUCM": (False, 2, _unified),
    "SIMPLE_DIVISION": (True, 1, _division),
    "DIVISION": (False, 1, _division),
}
# Those that shift points beside that.
_SHIFTED = ("THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")


def number_of_parameters(model: str) -> int:
    """How many parameters a camera model has; 0 of one that is not known here."""
    if model == PANORAMA:
        return 2
    is_simple, others, _ = MODELS.get(model, (True, -3, _polynomial))
    return (3 if is_simple else 4) + others


def _intrinsics(lens: Lens) -> tuple[Float, Float, Parameters]:
    """Focal lengths (2,), principal point (2,), and the other parameters."""
    is_simple, _, _ = MODELS[lens.model]
    number = 1 if is_simple else 2
    focal = np.array([lens.params[0], lens.params[number - 1]])
    return focal, np.array(lens.params[number : number + 2]), lens.params[number + 2 :]


def focal_length(lens: Lens) -> float:
    """Pixels per radian in the middle of the image; NaN of a lens that shows nothing there."""
    if lens.model == PANORAMA:
        return max(lens.params[0] / (2 * np.pi), lens.params[1] / np.pi)
    focal, _, _ = _intrinsics(lens)
    _, radius = _table(lens)
    if len(radius) == 1:
        return float("nan")
    return float(focal.mean() * radius[1] / (np.pi / (_NODES - 1)))


def principal_point(lens: Lens) -> Float:
    """Image coordinates (2,) of a fisheye's axis, pixels."""
    return _intrinsics(lens)[1]


@lru_cache(maxsize=64)
def _table(lens: Lens) -> tuple[Float, Float]:
    """Ascending angles and radii of a lens, as far as these grow."""
    _, _, extra = _intrinsics(lens)
    angle = np.linspace(0, np.pi, _NODES)
    radius = MODELS[lens.model][2](angle, extra)
    falls = ~(np.diff(radius) > 0)
    end = int(np.argmax(falls)) + 1 if falls.any() else _NODES
    return angle[:end], radius[:end]


def turning_angle(lens: Lens) -> float:
    """Radians off the axis up to which points move outward with the angle: pi where they always do."""
    return np.pi if lens.model == PANORAMA else float(_table(lens)[0][-1])


def image_points(lens: Lens, rays: Float) -> Float:
    """Where a lens shows rays.

    Parameters
    ----------
    lens : Lens
    rays : (n, 3) float64 ndarray
        In the camera frame, of any length.

    Returns
    -------
    (n, 2) float64 ndarray
        Image coordinates, pixels, also beyond the image's border; NaN for rays beyond the lens's limit.
    """
    if lens.model == PANORAMA:
        return _panorama_points(lens, rays)
    off_axis = np.hypot(rays[:, 0], rays[:, 1])
    angle = np.arctan2(off_axis, rays[:, 2])
    scale = angle / np.maximum(off_axis, _TINY)
    points = _distorted(lens, rays[:, :2] * scale[:, None])
    points[angle > min(lens.limit, turning_angle(lens))] = np.nan
    return points


def _distorted(lens: Lens, angles: Float) -> Float:
    """Image coordinates of rays given by direction and angle off the axis as (n, 2) vectors, radians."""
    focal, principal, extra = _intrinsics(lens)
    angle = np.hypot(angles[:, 0], angles[:, 1])
    radius = MODELS[lens.model][2](angle, extra)
    ratio = np.where(angle > _TINY, radius / np.maximum(angle, _TINY), 1.0)
    place = angles * ratio[:, None]
    if lens.model == "THIN_PRISM_FISHEYE":
        place = place + _thin_prism_shift(angles, extra)
    elif lens.model == "RAD_TAN_THIN_PRISM_FISHEYE":
        place = place + _tangential_shift(place, extra[6:])
    return np.asarray(place * focal + principal)


def _thin_prism_shift(at: Float, extra: Parameters) -> Float:
    _, _, p1, p2, _, _, sx1, sy1 = extra
    u, v = at.T
    square = u * u + v * v
    across = 2 * p1 * u * v + p2 * (square + 2 * u * u) + sx1 * square
    down = 2 * p2 * u * v + p1 * (square + 2 * v * v) + sy1 * square
    return np.column_stack([across, down])


def _tangential_shift(at: Float, extra: Parameters) -> Float:
    p0, p1, s0, s1, s2, s3 = extra
    u, v = at.T
    square = u * u + v * v
    common = 2 * (u * p0 + v * p1)
    across = common * u + square * p0 + square * (s0 + square * s1)
    down = common * v + square * p1 + square * (s2 + square * s3)
    return np.column_stack([across, down])


def camera_rays(lens: Lens, points: Float) -> Float:
    """Rays that a lens shows at places of its image: the inverse of `image_points`.

    Parameters
    ----------
    lens : Lens
    points : (n, 2) float64 ndarray
        Image coordinates, pixels.

    Returns
    -------
    (n, 3) float64 ndarray
        Unit vectors in the camera frame; NaN beyond the lens's limit, and where no ray is shown.
    """
    if lens.model == PANORAMA:
        return _panorama_rays(lens, points)
    angles = _undistorted(lens, points)
    angle = np.hypot(angles[:, 0], angles[:, 1])
    missed = np.abs(_distorted(lens, angles) - points).max(axis=1)
    good = (angle <= min(lens.limit, turning_angle(lens))) & (missed < _MISS)
    rays = np.column_stack([angles * np.sinc(angle / np.pi)[:, None], np.cos(angle)])
    return np.where(good[:, None], rays, np.nan)


def _undistorted(lens: Lens, points: Float) -> Float:
    """The inverse of `_distorted`: what the radius says, and Newton's method from there where that is not all."""
    focal, principal, _ = _intrinsics(lens)
    place = (points - principal) / focal
    distance = np.hypot(place[:, 0], place[:, 1])
    start = _angle_at(lens, distance)
    found = place * (start / np.maximum(distance, _TINY))[:, None]
    if lens.model not in _SHIFTED:
        return found
    left = np.arange(len(points))
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            miss = _distorted(lens, found[left]) - points[left]
            is_off = (np.abs(miss) > _CLOSE).any(axis=1)
            left, miss = left[is_off], miss[is_off]
            if not len(left):
                break
            here = found[left]
            columns = [
                (_distorted(lens, here + step) - _distorted(lens, here - step)) / (2 * _DELTA)
                for step in np.eye(2) * _DELTA
            ]
            (a, c), (b, d) = (column.T for column in columns)
            determinant = a * d - b * c
            change = np.column_stack([d * miss[:, 0] - b * miss[:, 1], a * miss[:, 1] - c * miss[:, 0]])
            found[left] -= np.clip(change / determinant[:, None], -0.2, 0.2)
    return np.nan_to_num(found, nan=np.inf)


def _angle_at(lens: Lens, distance: Float) -> Float:
    """(n,) angles of radii in focal lengths: all there is to most models, as exact as numbers are."""
    _, _, extra = _intrinsics(lens)
    radius_at = MODELS[lens.model][2]
    angle, radius = _table(lens)
    found = np.interp(distance, radius, angle)
    left = np.arange(len(found))
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            here = found[left]
            slope = (radius_at(here + _DELTA, extra) - radius_at(here - _DELTA, extra)) / (2 * _DELTA)
            step = (distance[left] - radius_at(here, extra)) / slope
            is_near = np.abs(step) < np.pi / (_NODES - 1)  # where the radius ends, it may turn back
            found[left[is_near]] += step[is_near]
            left = left[is_near & (np.abs(step) > _SMALL_STEP)]
            if not len(left):
                break
    return found


def _panorama_points(lens: Lens, rays: Float) -> Float:
    width, height = lens.params
    east = np.arctan2(rays[:, 0], rays[:, 2])
    down = np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2]))
    return np.column_stack([(east / (2 * np.pi) + 0.5) * width, (down / np.pi + 0.5) * height])


def _panorama_rays(lens: Lens, points: Float) -> Float:
    width, height = lens.params
    east = (points[:, 0] / width - 0.5) * 2 * np.pi
    down = (points[:, 1] / height - 0.5) * np.pi
    rays = np.column_stack([np.sin(east) * np.cos(down), np.sin(down), np.cos(east) * np.cos(down)])
    inside = (np.abs(east) <= np.pi) & (np.abs(down) <= np.pi / 2)
    return np.where(inside[:, None], rays, np.nan)
