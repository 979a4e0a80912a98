"""Depth map of a view that was cut from a photograph → the same without fringes and its worst rims.

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
# Of the pixels so far around one, those are of its surface whose depth differs by less than this share. Along a
# straight edge these are three fifths; a pixel with more is no rim.
_AROUND = 2
_SAME = 0.05
_MOST_OF_RIM = 3 / 5
# Of a map's depths, no more than this share are left out as rims: one with more of them is of fragments, and what
# is wrong there is no likelier found at a rim.
_MOST_RIMS = 0.04


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


def drop_rims(depth: NDArray[np.float32], mask: NDArray[np.uint8] | None = None) -> None:
    """Drop the pixels with the least of their surface around them, of those that are rims.

    A rim is a pixel of whose surface no more is around it than along a straight edge: three fifths of the 5 x 5
    pixels that show anything. Those with the least go first, all with equally little at once, as long as they are
    no more than a twenty-fifth of the map's depths.

    Parameters
    ----------
    depth : (H, W) float32 ndarray
        z-depth; 0 = none. Changed.
    mask : (H, W) uint8 ndarray, optional
        0 where nothing is shown, as beyond the lens: what ends there is no rim for that. Without it all is shown.

    Examples
    --------
    >>> depth = np.full((20, 20), 5, np.float32)
    >>> depth[9:, 10:] = 0
    >>> depth[9, 11] = 4
    >>> drop_rims(depth)
    >>> depth[7:11, 8:13].astype(int).tolist()
    [[5, 5, 5, 5, 5], [5, 5, 5, 5, 5], [5, 5, 0, 0, 0], [5, 5, 0, 0, 0]]
    """
    side = 2 * _AROUND + 1
    window = np.ones((side, side), np.uint8)
    is_even = (cv2.erode(depth, window) > (1 - _SAME) * depth) & (cv2.dilate(depth, window) < (1 + _SAME) * depth)
    rows, columns = np.nonzero((depth > 0) & ~is_even)
    padded = np.pad(depth, _AROUND)
    is_shown = np.ones(depth.shape, np.uint8) if mask is None else (mask > 0).astype(np.uint8)
    shown = cv2.boxFilter(is_shown, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    places = (rows + _AROUND) * padded.shape[1] + columns + _AROUND
    own = depth[rows, columns]
    same = np.zeros(len(places), np.int64)
    for down, across in itertools.product(range(-_AROUND, _AROUND + 1), repeat=2):
        same += np.abs(padded.ravel()[places + down * padded.shape[1] + across] - own) < _SAME * own
    # The surface's share of what is shown, in pixels of a whole window.
    share = side**2 * same // np.maximum(shown[rows, columns], same)
    least = np.bincount(share, minlength=side**2 + 1)[: int(_MOST_OF_RIM * side**2) + 1]
    goes = np.count_nonzero(np.cumsum(least) <= _MOST_RIMS * np.count_nonzero(depth))
    is_rim = share < goes
    depth[rows[is_rim], columns[is_rim]] = 0
