"""A view's depth map with its uncertainty: what the votes and the confirmation give.

Depth is z in the camera frame along the ray K⁻¹ (col, row, 1): COLMAP's fusion reads depth maps so.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Depths = tuple[float, float]
"""Least and largest depth that is wanted, model units."""


@dataclass(frozen=True, eq=False)
class DepthEstimate:
    """A view's depth map with its uncertainty.

    Attributes
    ----------
    depth : (H, W) float32 ndarray
        z-depth, model units; 0 = none.
    sigma : (H, W) float32 ndarray
        Its standard deviation, model units.
    support : (H, W) uint8 ndarray
        Number of pairs (photometric) or views (geometric) behind it.
    """

    depth: NDArray[np.float32]
    sigma: NDArray[np.float32]
    support: NDArray[np.uint8]


def drop_other_depths(depth: NDArray[np.float32], depths: Depths | None) -> None:
    """Set a depth map to 0, in place, where its depth is none of those wanted; None: all are."""
    if depths is not None:
        depth[(depth < depths[0]) | (depth > depths[1])] = 0
