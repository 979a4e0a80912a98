"""Which candidates together serve a view best: every part of it in several partners' sight, none in vain.

The images that share most sparse points with a view tend to see one and the same part of it. What only others see,
at the rim of a block or on the far side of a house, would then never be matched. So partners are chosen one after
the other, and what a view's chosen partners see already counts less for the next.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Photograph, View
from colmap_sph.stereo.partners.frusta import seen_by

# What a point that a view and a candidate both observe is worth; one that only lies in the candidate's view, where
# something may hide it, is worth the rest.
_OBSERVED = 0.5
# What is left of a point's worth with each partner that sees it well.
_SEEN_AGAIN = 0.2
# Parallax angles in degrees: matched best between the middle two, worth nothing beyond the outer two.
_ANGLES = (0.0, 6.0, 40.0, 70.0)


def triangulation_angles(
    points: NDArray[np.float64], center1: NDArray[np.float64], center2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Angles between the rays from points to two projection centres.

    Parameters
    ----------
    points : (…, 3) float64 ndarray
        World frame.
    center1, center2 : (…, 3) float64 ndarray
        Projection centres, world frame: of all points, or of each.

    Returns
    -------
    (…) float64 ndarray
        Degrees, 0 to 180.
    """
    x1, y1, z1 = np.moveaxis(center1 - points, -1, 0)
    x2, y2, z2 = np.moveaxis(center2 - points, -1, 0)
    # Unlike the arc cosine, exact for small angles.
    x, y, z = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
    sines = np.sqrt(x * x + y * y + z * z)
    return np.asarray(np.degrees(np.arctan2(sines, x1 * x2 + y1 * y2 + z1 * z2)))


def worth_of(
    view: View | Photograph,
    candidates: Sequence[View | Photograph],
    points: NDArray[np.float64],
    observed: NDArray[np.bool_] | float,
) -> NDArray[np.float32]:
    """How well candidates would serve each point of a view or photograph.

    Parameters
    ----------
    view : View or Photograph
    candidates : sequence of View or Photograph
        C of them.
    points : (N, 3) float64 ndarray
        Points that the view observes, world frame.
    observed : (C, N) bool ndarray, or (C, 1) or a float
        Which of them each candidate observes, too; or where that is not known, how much to believe that it does.

    Returns
    -------
    (C, N) float32 ndarray
        0 to 1.
    """
    centers = np.array([candidate.center for candidate in candidates])
    angles = triangulation_angles(points, view.center, centers[:, None])
    in_sight = _in_sight(candidates, points)
    observed = np.asarray(observed)
    if observed.dtype == bool:
        in_sight |= observed  # whatever the rounding at the image's rim
    parallax = np.interp(angles, _ANGLES, (0.0, 1.0, 1.0, 0.0))
    return np.asarray(in_sight * parallax * (1 - _OBSERVED + _OBSERVED * observed), dtype=np.float32)


def _in_sight(candidates: Sequence[View | Photograph], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(C, N) bool: which points each candidate has in view, a photograph in any of its views."""
    views = [candidate.views for candidate in candidates]
    firsts = np.cumsum([0, *map(len, views[:-1])])
    seen = seen_by([view for cut in views for view in cut], points)
    return np.asarray(np.logical_or.reduceat(seen, firsts, axis=0))


def choose(worths: NDArray[np.float32], count: int) -> list[int]:
    """Choose up to `count` candidates, the best first.

    Parameters
    ----------
    worths : (C, N) float32 ndarray
        Worth of each candidate for each point, see `worth_of`.
    count : int

    Returns
    -------
    list of int
        Indices of candidates; of equals the first.
    """
    chosen: list[int] = []
    need = np.ones(worths.shape[1])
    left = np.ones(len(worths), dtype=bool)
    while left.any() and len(chosen) < count:
        # Rounded: of candidates that serve alike the first must win, however their points' places are rounded.
        gains = np.where(left, np.round(np.einsum("ij,j->i", worths, need), 3), -1.0)
        best = int(np.argmax(gains))
        chosen.append(best)
        left[best] = False
        need *= 1 - (1 - _SEEN_AGAIN) * worths[best]
    return chosen
