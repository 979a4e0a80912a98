"""Depth maps against exact depth, at COLMAP's pixel origin.

COLMAP's fusion back-projects the integer pair (column, row) with a K whose first pixel has its centre at
(0.5, 0.5): the element [row, col] of a depth map belongs to the corner between four pixels, not to a pixel's
centre. A ray-cast truth is usually sampled at pixel centres, so it is moved by `truth_at_pixel_origin` first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import InputError, NoResultError, OptionError

_DepthMap = npt.NDArray[np.float32] | npt.NDArray[np.float64]


@dataclass(frozen=True)
class DepthMapScores:
    """How one depth map compares with exact depth. Shares are in 0 … 1, errors in GSD along the z axis."""

    truth_pixels: int
    """Pixels that have exact depth: the ones that are judged."""
    compared_pixels: int
    """Judged pixels that have a depth."""
    coverage: float
    """compared_pixels / truth_pixels."""
    thresholds: tuple[float, ...]
    """Bounds on the depth error, in GSD."""
    within: tuple[float, ...]
    """Per threshold: share of the compared pixels with a smaller or equal error."""
    median_error: float
    """Median absolute depth error of the compared pixels, in GSD; NaN without one."""
    median_normal_angle: float | None = None
    """Median angle in degrees between the map's and the exact normals; None where not asked for."""
    normal_coverage: float | None = None
    """Share of the compared pixels that have both normals; None where not asked for."""

    @property
    def complete_within(self) -> tuple[float, ...]:
        """Per threshold: share of all truth pixels with a depth inside it (coverage × within)."""
        return tuple(self.coverage * share for share in self.within)

    def as_dict(self) -> dict[str, object]:
        """Plain values for `json.dump`."""
        return {
            "truth_pixels": self.truth_pixels,
            "compared_pixels": self.compared_pixels,
            "coverage": self.coverage,
            "thresholds_gsd": list(self.thresholds),
            "within": list(self.within),
            "complete_within": list(self.complete_within),
            "median_error_gsd": None if np.isnan(self.median_error) else self.median_error,
            "median_normal_angle_deg": self.median_normal_angle,
            "normal_coverage": self.normal_coverage,
        }


def compare_depth_map(
    depth: _DepthMap,
    truth: _DepthMap,
    *,
    gsd: float | _DepthMap,
    thresholds: Sequence[float] = (1.0, 2.0, 4.0),
    normals: npt.NDArray[np.float32] | None = None,
    truth_normals: npt.NDArray[np.float32] | None = None,
) -> DepthMapScores:
    """Score a depth map against exact depth on the same pixel grid.

    Parameters
    ----------
    depth : (H, W) float
        z-depth; values that are not positive and finite mean none.
    truth : (H, W) float
        Exact z-depth in the same unit and at the same pixel origin (see `truth_at_pixel_origin`); none as
        above.
    gsd : float or (H, W) float
        Ground sampling distance, in the unit of the depths: one number, or ``truth / focal_length``.
    thresholds : sequence of float
        Bounds on the absolute depth error, in GSD.
    normals, truth_normals : (H, W, 3) float32, optional
        Unit normals in the camera frame, (0, 0, 0) = none. Give both or neither.

    Returns
    -------
    DepthMapScores

    Raises
    ------
    InputError
        Arrays of different sizes, or only one of the two normal maps.
    OptionError
        A threshold or GSD that is not positive.
    NoResultError
        A truth without a single depth.
    """
    _check_depth_maps(depth, truth, gsd, thresholds)
    has_truth = np.isfinite(truth) & (truth > 0)
    truth_pixels = int(np.count_nonzero(has_truth))
    if truth_pixels == 0:
        raise NoResultError("the exact depth map has no pixel with a depth: nothing can be compared")
    compared = has_truth & np.isfinite(depth) & (depth > 0)
    gsd_of_compared = np.broadcast_to(np.asarray(gsd, np.float64), truth.shape)[compared]
    errors = np.abs(depth[compared].astype(np.float64) - truth[compared]) / gsd_of_compared
    count = len(errors)
    angle, normal_coverage = _normal_angle(normals, truth_normals, compared)
    return DepthMapScores(
        truth_pixels=truth_pixels,
        compared_pixels=count,
        coverage=count / truth_pixels,
        thresholds=tuple(float(bound) for bound in thresholds),
        within=tuple(float(np.mean(errors <= bound)) if count else 0.0 for bound in thresholds),
        median_error=float(np.median(errors)) if count else float("nan"),
        median_normal_angle=angle,
        normal_coverage=normal_coverage,
    )


def truth_at_pixel_origin(
    centre_depth: _DepthMap, *, edge_tolerance: float = 1e-3, largest_step: float = 0.02
) -> npt.NDArray[np.float32]:
    """Exact depth at COLMAP's pixel origin from exact depth at pixel centres.

    The element [row, col] of the result is the depth along the ray K⁻¹ (col, row, 1): the corner where the
    pixels (row-1, col-1), (row-1, col), (row, col-1) and (row, col) meet. Inverse depth is affine on a plane,
    so its mean over the four centres is exact there; where they straddle an edge no value is right and the
    pixel is left out (0).

    Parameters
    ----------
    centre_depth : (H, W) float
        Exact z-depth at pixel centres, 0 = none.
    edge_tolerance : float
        An edge is a step of inverse depth between two neighbouring pixels that differs from the slope on both
        sides by more than this share of the inverse depth.
    largest_step : float
        Steps larger than this share of the inverse depth are edges whatever the slope beside them.

    Returns
    -------
    (H, W) float32
        0 in the first row and column, without all four neighbours, and across edges.
    """
    inverse, usable = _inverse_depth_and_corners(centre_depth, edge_tolerance, largest_step)
    mean = 0.25 * (inverse[:-1, :-1] + inverse[:-1, 1:] + inverse[1:, :-1] + inverse[1:, 1:])
    corner = np.zeros(centre_depth.shape, np.float32)
    np.divide(1.0, mean, out=corner[1:, 1:], where=usable, casting="same_kind")
    return corner


def truth_normals_at_pixel_origin(
    centre_depth: _DepthMap,
    K: npt.NDArray[np.float64],
    *,
    edge_tolerance: float = 1e-3,
    largest_step: float = 0.02,
) -> npt.NDArray[np.float32]:
    """Exact normals at COLMAP's pixel origin from exact depth at pixel centres.

    On a plane n · x = d inverse depth is n · K⁻¹ (x, y, 1) / d, so its gradient over the four pixel centres
    around a corner gives n exactly. Depth stored in steps blurs it: steps of 5 mm at a ground sampling
    distance of 0.14 m by about half a degree.

    Parameters
    ----------
    centre_depth : (H, W) float
        Exact z-depth at pixel centres, 0 = none.
    edge_tolerance, largest_step : float
        As for `truth_at_pixel_origin`.
    K : (3, 3) float64
        Pinhole without skew; the first pixel's centre is at (0.5, 0.5).

    Returns
    -------
    (H, W, 3) float32
        Unit normals in the camera frame, towards the camera; (0, 0, 0) where the depth has none.
    """
    inverse, usable = _inverse_depth_and_corners(centre_depth, edge_tolerance, largest_step)
    upper_left = inverse[:-1, :-1]
    upper_right = inverse[:-1, 1:]
    lower_left = inverse[1:, :-1]
    lower_right = inverse[1:, 1:]
    along_x = 0.5 * (upper_right - upper_left + lower_right - lower_left)
    along_y = 0.5 * (lower_left - upper_left + lower_right - upper_right)
    mean = 0.25 * (upper_left + upper_right + lower_left + lower_right)
    height, width = centre_depth.shape
    # Element [row, col] is the image point (col, row), the corner between four pixels.
    x, y = np.arange(1, width) - K[0, 2], np.arange(1, height)[:, None] - K[1, 2]
    towards = -np.stack([K[0, 0] * along_x, K[1, 1] * along_y, mean - x * along_x - y * along_y], axis=2)
    normals = np.zeros((height, width, 3), np.float32)
    length = np.linalg.norm(towards[usable], axis=1, keepdims=True)
    normals[1:, 1:][usable] = towards[usable] / length
    return normals


def _inverse_depth_and_corners(
    centre_depth: _DepthMap, edge_tolerance: float, largest_step: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """(H, W) inverse depth, 0 = none, and (H-1, W-1) whether four neighbours see one surface."""
    valid = np.isfinite(centre_depth) & (centre_depth > 0)
    inverse = np.zeros(centre_depth.shape, np.float64)
    np.divide(1.0, centre_depth, out=inverse, where=valid)
    all_four = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    edge_down = _edges_between_rows(inverse, edge_tolerance, largest_step)
    edge_right = _edges_between_rows(inverse.T, edge_tolerance, largest_step).T
    edge = edge_down[:, :-1] | edge_down[:, 1:] | edge_right[:-1] | edge_right[1:]
    return inverse, all_four & ~edge


def _edges_between_rows(
    inverse: npt.NDArray[np.float64], edge_tolerance: float, largest_step: float
) -> npt.NDArray[np.bool_]:
    """(H-1, W): whether the step from one row to the next is a depth edge."""
    step = np.diff(inverse, axis=0)
    scale = np.maximum(inverse[:-1], inverse[1:])
    change = np.abs(np.diff(step, axis=0))
    # At the image's border only one side has a slope to compare with.
    change_before = np.pad(change, ((1, 0), (0, 0)), constant_values=np.inf)
    change_after = np.pad(change, ((0, 1), (0, 0)), constant_values=np.inf)
    bent = np.minimum(change_before, change_after) > edge_tolerance * scale
    return np.asarray(bent | (np.abs(step) > largest_step * scale))


def _normal_angle(
    normals: npt.NDArray[np.float32] | None,
    truth_normals: npt.NDArray[np.float32] | None,
    compared: npt.NDArray[np.bool_],
) -> tuple[float | None, float | None]:
    """Median angle (degrees) between two normal maps on the compared pixels and the share that has both."""
    if normals is None and truth_normals is None:
        return None, None
    shape = (*compared.shape, 3)
    if normals is None or truth_normals is None or normals.shape != shape or truth_normals.shape != shape:
        raise InputError(f"comparing normals needs both normal maps, each of shape {shape}")
    given = normals[compared].astype(np.float64)
    exact = truth_normals[compared].astype(np.float64)
    lengths = np.linalg.norm(given, axis=1) * np.linalg.norm(exact, axis=1)
    both = lengths > 0
    if not both.any():
        return None, 0.0
    cosine = np.einsum("ij,ij->i", given[both], exact[both]) / lengths[both]
    angle = float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
    return angle, float(np.mean(both))


def _check_depth_maps(
    depth: _DepthMap, truth: _DepthMap, gsd: float | _DepthMap, thresholds: Sequence[float]
) -> None:
    if depth.ndim != 2 or depth.shape != truth.shape:
        raise InputError(
            f"the depth map is {depth.shape} and the exact depth {truth.shape} (rows, columns): "
            "compare maps of the same image at the same size"
        )
    if not thresholds or not all(np.isfinite(bound) and bound > 0 for bound in thresholds):
        raise OptionError(f"thresholds on the depth error must be positive GSD, not {tuple(thresholds)}")
    gsd_array = np.asarray(gsd)
    if gsd_array.ndim and gsd_array.shape != truth.shape:
        raise InputError(f"the per-pixel GSD is {gsd_array.shape}, the depth map {truth.shape}")
    used = gsd_array[np.isfinite(truth) & (truth > 0)] if gsd_array.ndim else gsd_array
    if not np.all(np.isfinite(used) & (used > 0)):
        raise OptionError("the GSD must be positive wherever the exact depth is")
