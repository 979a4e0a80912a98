"""Depth map of a view that was cut from a photograph → the same without the fringes of what is near.

Windows beside the edge of a near surface show it, too, so that it is found a little too wide. The views of a wide
image have few pixels per degree: there the outermost pixel of such a surface is wrong nearly as often as right.
"""

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

# What lies behind an edge is farther away by this share, and so many pixels away at most, across pixels without
# depth: what a near thing hides from other views often has none.
_STEP = 0.1
_REACH = 3
# Surfaces that lead away from the camera are no edges: in inverse depth, which is even along a plane, they fall
# before a pixel nearly as much as behind it.
_BEND = 2.0
_DIRECTIONS = [step for step in itertools.product((-1, 0, 1), repeat=2) if step != (0, 0)]


def drop_fringes(depth: NDArray[np.float32]) -> None:
    """Drop the outermost pixels of surfaces that end before something farther away.

    A pixel is dropped where, in any of eight directions, the next depth beyond it is farther away, and the one on
    its other side is not. So lines of one pixel stay.

    Parameters
    ----------
    depth : (H, W) float32 ndarray
        z-depth; 0 = none. Changed.

    Examples
    --------
    >>> row = np.array([[5, 5, 5, 5, 0, 9, 9, 9]], np.float32)
    >>> drop_fringes(row)
    >>> row.astype(int).tolist()
    [[5, 5, 5, 0, 0, 9, 9, 9]]
    """
    side = 2 * _REACH + 1
    farthest = cv2.dilate(depth, np.ones((side, side), np.uint8))
    rows, columns = np.nonzero((depth > 0) & (farthest > (1 + _STEP) * depth))
    padded = np.pad(depth, _REACH)
    inverse = np.divide(1, padded, out=np.zeros_like(padded), where=padded > 0).ravel()
    places = (rows + _REACH) * padded.shape[1] + columns + _REACH
    own = inverse[places]
    is_fringe = np.zeros(len(places), np.bool_)
    for down, across in _DIRECTIONS:
        step = down * padded.shape[1] + across
        before = inverse[places - step]
        rise = _BEND * (before - own)
        is_open = (1 + _STEP) * before > own
        for away in range(1, _REACH + 1):
            beyond = inverse[places + away * step]
            is_farther = (beyond > 0) & (own > (1 + _STEP) * beyond)
            is_fringe |= is_open & is_farther & (own - beyond > away * rise)
            is_open &= beyond == 0
    depth[rows[is_fringe], columns[is_fringe]] = 0
