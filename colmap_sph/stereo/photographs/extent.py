"""Two photographs, of which one was cut into several views → what they cover of the sphere around their baseline.

Together the views may see all around: both epipoles, and every plane through the baseline. Rows are then the whole
circle, and columns go from near one epipole to near the other.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import RectificationError
from colmap_sph.scene import Photograph, View
from colmap_sph.stereo.disparity_range import Range
from colmap_sph.stereo.extent import Extent, bounded_extent, column_extent, epipole_sign, rolled, row_arc
from colmap_sph.stereo.rectified_pair import Float

# Half of the largest parallax that anything is matched at, radians.
_MOST_BEYOND = np.pi / 4
# A half that has less of the columns is not worth the difference.
_LEAST_HALF = 0.25
# Epipolar planes that are looked at, evenly around the baseline.
_PLANES = 1440


def extent_of_photographs(
    rotation: Float,
    left: View | Photograph,
    right: View | Photograph,
    min_cosine: float,
    outlines: tuple[Sequence[Float], Sequence[Float]],
) -> Extent:
    """What two photographs cover of the sphere around their baseline.

    Parameters
    ----------
    rotation : (3, 3) float64 ndarray
        World to rectified frame; that of the result is rolled about the baseline, so that the rows' middle is 0.
    left, right : View or Photograph
    min_cosine : float
        Rays whose angle with the baseline has a sine (that is cos θ) below this are left out.
    outlines : pair of sequence of (n, 2) float64 ndarray
        Of what counts of each view, see `extent_on_sphere`.

    Returns
    -------
    Extent

    Raises
    ------
    RectificationError
        No plane through the baseline is in both.
    """
    common = np.ones(_PLANES, bool)
    for photograph, shown in zip((left, right), outlines, strict=True):
        common &= _planes_of(photograph, rotation, shown)
    if not common.any():
        raise RectificationError("the two images share no epipolar plane")
    centre, half = _around_all(common)
    rotation = rolled(rotation, centre)
    columns: list[Range] = []
    for photograph, shown in zip((left, right), outlines, strict=True):
        ranges = [
            column_extent(view, outline, epipole_sign(view, rotation, outline), rotation, -half, half)
            for view, outline in zip(photograph.views, shown, strict=True)
        ]
        columns.append((min(least for least, _ in ranges), max(most for _, most in ranges)))
    return bounded_extent(rotation, half, columns, min_cosine)


def nearer_half(columns: Range, most: float) -> Range:
    """The columns of the left image where it may stand nearer to what it sees than the right one does.

    It does where θ_l + θ_r < 0, so where θ_l is less than half the parallax. A pair that sees all around has as
    much that the right image sees finer, and is matched the other way round for that.

    Parameters
    ----------
    columns : (float, float)
        Least and most θ_l, radians.
    most : float
        Largest parallax that is searched, radians.

    Examples
    --------
    >>> nearer_half((-1.5, 1.5), most=1.0), nearer_half((0.4, 1.5), most=1.0)
    ((-1.5, 0.5), (0.4, 1.5))
    """
    low, high = columns
    middle = min(high, most / 2, _MOST_BEYOND)
    return (low, middle) if middle - low >= _LEAST_HALF * (high - low) else columns


def _planes_of(photograph: View | Photograph, rotation: Float, outlines: Sequence[Float]) -> NDArray[np.bool_]:
    """Which of the planes through the baseline, by their row angles from -π on, any view has in its outline."""
    angles = _angles()
    seen = np.zeros(_PLANES, bool)
    for view, outline in zip(photograph.views, outlines, strict=True):
        centre, half = row_arc(view, outline, epipole_sign(view, rotation, outline), rotation)
        seen |= np.abs(np.angle(np.exp(1j * (angles - centre)))) <= half
    return seen


def _around_all(planes: NDArray[np.bool_]) -> tuple[float, float]:
    """Centre and half width of the shortest arc with all these planes; of the whole circle where it has no gap."""
    angles = _angles()
    there = np.flatnonzero(planes)
    gaps = np.diff(there, append=there[0] + _PLANES)
    widest = int(gaps.argmax())
    if gaps[widest] == 1:
        return 0.0, float(np.pi)
    step = 2 * np.pi / _PLANES
    half = step * (_PLANES - gaps[widest]) / 2
    first = angles[there[(widest + 1) % len(there)]]
    # Half a step beyond the outermost planes, up to which others may be seen.
    return float(first + half), float(min(half + step / 2, np.pi - step / 2))


def _angles() -> Float:
    return np.asarray((np.arange(_PLANES) + 0.5) / _PLANES * 2 * np.pi - np.pi)
