"""Depth map and region → which pixels show the region, those without a depth among them."""

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Region, View
from colmap_sph.stereo.region.focus import Focus
from colmap_sph.stereo.region.inside import pixels_inside


def filled(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) depths with the nearest one in place of none; 0 everywhere where there is not any."""
    none = (depth <= 0).astype(np.uint8)
    if none.all() or not none.any():
        return depth
    _, labels = cv2.distanceTransformWithLabels(none, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros(int(labels.max()) + 1, np.float32)
    of_label[labels[none == 0]] = depth[none == 0]
    return np.asarray(of_label[labels], np.float32)


def count_shown(view: View, found: NDArray[np.float32], kept: NDArray[np.float32], region: Region) -> int:
    """Count the pixels of a view that show a region: of what coverage is a share.

    A pixel without a depth is taken to be as far away as the nearest one with a depth.

    Parameters
    ----------
    view : View
    found : (H, W) float32 ndarray
        Depths that were found, in the region and around it; 0 = none.
    kept : (H, W) float32 ndarray
        Depths in the region; what has one shows it.
    region : Region
        In the view's world frame, see `Focus.near`.

    Returns
    -------
    int
        All pixels where nothing was found.
    """
    known = np.where(kept > 0, kept, found)
    if not known.any():
        return known.size
    return int(np.count_nonzero(pixels_inside(view, filled(known), region) | (kept > 0)))


def count_focus(
    view: View, found: NDArray[np.float32], kept: NDArray[np.float32], focus: Focus | None
) -> int | None:
    """As `count_shown`, of the region that a run is for; None where it is for all of the scene."""
    return None if focus is None else count_shown(view, found, kept, focus.near)
