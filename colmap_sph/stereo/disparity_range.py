"""Sparse points of a pair → the range of parallaxes it is searched in, and the columns that can have a match.

A parallax is a difference of what columns are equal steps of (see `rectified_pair`): on the sphere of angles or
what they are flattened to, on the plane of tangents. Times the columns per radian it is a disparity. The range is
that of the sparse points, with a margin on either side: surfaces nearer and farther than these are common, and
what lies outside of the range is never found.
"""

from collections.abc import Callable

import numpy as np

from colmap_sph.errors import RectificationError
from colmap_sph.scene import Photograph, View
from colmap_sph.stereo.rectified_pair import Float, columns_of_angles, ray_angles

Range = tuple[float, float]
"""Least and most."""

# Fewer shared points than this say too little about the range of parallaxes; what is then searched, in degrees.
MIN_POINTS = 8
_UNKNOWN_DEGREES = (0.3, 60.0)
# Extremes of the sparse points that are believed; beyond are outliers.
_PERCENTILES = (1, 99)
# Zero is infinitely far away, and what is below it behind the cameras.
_LEAST_PARALLAX = 1e-4
# Ranges that are given reach at most so many times as far as those of sparse points.
_MOST_TIMES = 4
# What follows from sparse points is rounded to so many binary digits, so that the last of theirs does not count.
_DIGITS = 11


def sphere_parallaxes(
    left: View | Photograph, right: View | Photograph, rotation: Float, points: Float, flatness: float = 0.0
) -> Float:
    """Parallaxes of points on the sphere.

    Parameters
    ----------
    left, right : View or Photograph
    rotation : (3, 3) float64 ndarray
        World to rectified frame.
    points : (n, 3) float64 ndarray
        World frame.
    flatness : float
        Of the columns.

    Returns
    -------
    (n,) float64 ndarray
        With flatness 0 θ_l − θ_r, radians (Elhashash & Qin, §3.2).
    """
    seen = (ray_angles((points - view.center) @ rotation.T)[1] for view in (left, right))
    in_left, in_right = (columns_of_angles(angles, flatness) for angles in seen)
    return np.asarray(in_left - in_right)


def plane_parallaxes(left: View, rotation: Float, points: Float, baseline: float) -> Float:
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


def parallax_range(farther: Float, nearer: Float) -> Range:
    """Range to search: robust extremes of the sparse points' parallaxes with a generous margin.

    Parameters
    ----------
    farther, nearer : (n,) float64 ndarray
        Parallaxes of sparse points, moved away from the left image, and towards it, by the margin; with fewer
        than 8 of them nearly everything is searched.

    Returns
    -------
    least, most : float
        Radians or tangents.

    Examples
    --------
    Parallax is about baseline over distance: points ten to twenty baselines away, searched from five to thirty.

    >>> import numpy as np
    >>> parallaxes = 1 / np.linspace(10, 20, 100)
    >>> least, most = parallax_range(parallaxes / 1.5, parallaxes * 2)
    >>> bool(1 / 31 < least <= 1 / 29.5), bool(1 / 5.1 < most < 1 / 4.9)
    (True, True)
    """
    if len(nearer) < MIN_POINTS:
        least, most = np.radians(_UNKNOWN_DEGREES)
        return least, most
    low, high = _PERCENTILES
    return bounded_range(np.array([np.percentile(farther, low), np.percentile(nearer, high)]))


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
