"""Views that were cut from one photograph, and overlap → which of them each ray belongs to.

A ray belongs to the view whose axis is nearest to it, of those that have it in their image. So the borders between
them run through the middle of their overlap, and a photograph has each of its rays once.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View, in_bands

# Pixels that are looked at together, at some hundred bytes each.
_BAND_PIXELS = 1 << 16


def owned_pixels(view: View, others: Sequence[View]) -> NDArray[np.bool_]:
    """Find the pixels of a view whose rays belong to it.

    Parameters
    ----------
    view : View
    others : sequence of View
        Of the same centre. Where two axes are equally near, a ray belongs to the view that comes first by name.

    Returns
    -------
    (H, W) bool ndarray
        For the ray ``K⁻¹ (col, row, 1)`` of each `[row, col]`, see "pixel origin" in docs/algorithm.md.

    Examples
    --------
    Two views with a field of view of 90 degrees, one turned by 60 degrees to the right: what lies more than 30
    degrees to the right belongs to that one.

    >>> K = np.array([[50.0, 0, 50], [0, 50, 50], [0, 0, 1]])
    >>> sine, cosine = np.sin(np.radians(60)), 0.5
    >>> turned = np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    >>> none = np.empty(0, np.int64)
    >>> ahead = View(1, "ahead", 100, 100, K, np.eye(3), np.zeros(3), none)
    >>> right = View(2, "right", 100, 100, K, turned, np.zeros(3), none)
    >>> int(owned_pixels(ahead, [right])[50].argmin())  # 50 + 50 tan 30° = 78.9
    79
    """
    owned = np.empty((view.height, view.width), bool)
    for band in in_bands(owned.shape, _BAND_PIXELS):
        owned[band] = _owned_in_band(view, others, band)
    return owned


def _owned_in_band(view: View, others: Sequence[View], band: slice) -> NDArray[np.bool_]:
    """`owned_pixels` of a band of rows."""
    columns, rows = np.meshgrid(np.arange(view.width), np.arange(band.start, band.stop))
    pixels = np.stack([columns, rows, np.ones_like(columns)]).reshape(3, -1).astype(float)
    owned = np.ones(pixels.shape[1], bool)
    for other in others:
        # Depth 1 here; the cosines of a ray with both axes are as its depths.
        x, y, depth = (other.K @ other.R @ view.R.T @ view.inverse_K) @ pixels
        nearer = (depth > 1) | ((depth == 1) & (other.name < view.name))
        inside = (x >= 0) & (x <= other.width * depth) & (y >= 0) & (y <= other.height * depth)
        owned &= ~(nearer & inside)
    return owned.reshape(-1, view.width)
