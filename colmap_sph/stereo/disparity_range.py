"""Sparse points of a pair → the range of parallaxes it is searched in, and the columns that can have a match.

A parallax is an angle on the sphere and a tangent on the plane (see `rectified_pair`); times the columns per
radian it is a disparity. The range is that of the sparse points, with a margin on either side: surfaces nearer and
farther than these are common, and what lies outside of the range is never found.
"""

from collections.abc import Callable

import numpy as np

from colmap_sph.errors import RectificationError
from colmap_sph.scene import Photograph, View
from colmap_sph.stereo.rectified_pair import Float, ray_angles

Range = tuple[float, float]
"""Least and most."""

# Fewer shared points than this say too little about the range of parallaxes; what is then searched, in degrees.
_MIN_POINTS = 8
_UNKNOWN_DEGREES = (0.3, 60.0)
# Extremes of the sparse points that are believed; beyond are outliers.
_PERCENTILES = (1, 99)
# Zero is infinitely far away, and what is below it behind the cameras.
_LEAST_PARALLAX = 1e-4
# Ranges that are given reach at most so many times as far as those of sparse points.
_MOST_TIMES = 4
# What follows from sparse points is rounded to so many binary digits, so that the last of theirs does not count.
_DIGITS = 11


def parallax_angles(left: View | Photograph, right: View | Photograph, rotation: Float, points: Float) -> Float:
    """Parallaxes of points on the sphere.

    Parameters
    ----------
    left, right : View or Photograph
    rotation : (3, 3) float64 ndarray
        World to rectified frame.
    points : (n, 3) float64 ndarray
        World frame.

    Returns
    -------
    (n,) float64 ndarray
        θ_l − θ_r, radians (Elhashash & Qin, §3.2).
    """
    _, left_angles = ray_angles((points - left.center) @ rotation.T)
    _, right_angles = ray_angles((points - right.center) @ rotation.T)
    return np.asarray(left_angles - right_angles)


def parallax_tangents(left: View, rotation: Float, points: Float, baseline: float) -> Float:
    """Parallaxes of points on the plane.

    Parameters
    ----------
    left : View
    rotation : (3, 3) float64 ndarray
        World to rectified frame.
    points : (n, 3) float64 ndarray
        World frame.
    baseline : float
        Distance of the projection centres, model units.

    Returns
    -------
    (m,) float64 ndarray
        Baseline / Z (Elhashash & Qin, §3.1) of the points in front of the cameras.
    """
    depth = (points - left.center) @ rotation[2]
    return np.asarray(baseline / depth[depth > 0])


def parallax_range(parallaxes: Float, near_margin: float, far_margin: float) -> Range:
    """Range to search: robust extremes of the sparse points' parallaxes with a generous margin.

    Parameters
    ----------
    parallaxes : (n,) float64 ndarray
        Of sparse points; with fewer than 8 of them nearly everything is searched.
    near_margin, far_margin : float
        The nearest sparse points' distance divided by the first, and the farthest ones' times the second, is what
        is looked for.

    Returns
    -------
    least, most : float
        Radians or tangents.

    Examples
    --------
    Parallax is about baseline over distance: points ten to twenty baselines away, searched from five to thirty.

    >>> import numpy as np
    >>> least, most = parallax_range(1 / np.linspace(10, 20, 100), near_margin=2, far_margin=1.5)
    >>> bool(1 / 31 < least <= 1 / 29.5), bool(1 / 5.1 < most < 1 / 4.9)
    (True, True)
    """
    if len(parallaxes) < _MIN_POINTS:
        least, most = np.radians(_UNKNOWN_DEGREES)
        return least, most
    least, most = bounded_range(np.percentile(parallaxes, _PERCENTILES))
    return least / far_margin, most * near_margin


def bounded_range(parallaxes: Float) -> Range:
    """Least and most of some parallaxes, a little rounded outwards; nothing is behind the cameras."""
    least = few_digits(max(float(parallaxes.min()), _LEAST_PARALLAX), np.floor)
    most = few_digits(max(float(parallaxes.max()), _LEAST_PARALLAX), np.ceil)
    return least, most


def limited_range(given: Range, usual: Range) -> Range:
    """A range of parallaxes that was given, less what is far beyond the one that sparse points tell.

    Users give very wide ranges to say "no limit", and matching finds less in those. A range that lies elsewhere is
    meant as it is.

    Examples
    --------
    >>> limited_range((0.001, 9.0), (0.1, 0.2)), limited_range((0.001, 0.15), (0.1, 0.2))
    ((0.025, 0.8), (0.025, 0.15))
    >>> limited_range((5.0, 9.0), (0.1, 0.2))
    (5.0, 9.0)
    """
    least = max(given[0], usual[0] / _MOST_TIMES)
    most = min(given[1], usual[1] * _MOST_TIMES)
    return (least, most) if least < most else given


def few_digits(value: float, rounded: Callable[[float], float]) -> float:
    """The value to 11 binary digits, rounded as asked: by ``np.floor``, ``np.ceil`` or ``np.round``."""
    fraction, exponent = np.frexp(value)
    return float(np.ldexp(rounded(fraction * 2**_DIGITS), exponent - _DIGITS))


def columns_with_counterparts(left: Range, right: Range, least: float, most: float) -> tuple[Range, Range]:
    """Columns of each image that have a counterpart in the other at some parallax of the range.

    Parameters
    ----------
    left, right : (float, float)
        Extents of the two images along the epipolar lines: angles or tangents.
    least, most : float
        Range of parallaxes, in the same unit.

    Returns
    -------
    left, right : (float, float)
        What of them to keep.

    Raises
    ------
    RectificationError
        Nothing: at these parallaxes the images do not overlap.
    """
    left_low, left_high = left
    right_low, right_high = right
    left = max(left_low, right_low + least), min(left_high, right_high + most)
    right = max(right_low, left_low - most), min(right_high, left_high - least)
    if left[1] <= left[0] or right[1] <= right[0]:
        raise RectificationError("the two images do not overlap at the depths of the sparse points")
    return left, right
