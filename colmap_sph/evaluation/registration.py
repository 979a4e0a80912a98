"""Rigid registration of a cloud to its reference before measuring, by generalised ICP."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import InputError
from colmap_sph.evaluation.geometry_io import require
from colmap_sph.evaluation.neighbours import PointIndex, Points, bounds

logger = logging.getLogger(__name__)

_MAX_POINTS = 300_000
"""Points of either cloud that ICP sees: plenty for six unknowns."""
_MIN_POINTS = 100
_MOST_DEGREES = 5.0
"""What is nearly in place already is turned by less."""
_FINE_SHARE = 0.25
"""The second pass pairs points up to this share of the first pass's distance."""


@dataclass(frozen=True)
class Registration:
    """The motion that moves a cloud onto its reference, and what it changed."""

    matrix: npt.NDArray[np.float64]
    """(4, 4) reference_from_cloud, rigid."""
    applied: bool
    """False where ICP made the residual larger, or did not converge: the cloud stays as it is."""
    rotation_degrees: float
    shift: tuple[float, float, float]
    """Motion of the cloud's centre, in metres."""
    inlier_share: float
    """Share of the sampled points within the pairing distance, after the motion."""
    rms_before: float
    """Root mean square distance to the reference before the motion, in metres; a point without a pair counts
    as the pairing distance."""
    rms_after: float

    def transform(self, points: Points) -> Points:
        """(N, 3) points in the reference's frame; the points themselves where nothing was applied."""
        return points @ self.matrix[:3, :3].T + self.matrix[:3, 3] if self.applied else points

    def as_dict(self) -> dict[str, object]:
        """Plain values for `json.dump`."""
        return {
            "applied": self.applied,
            "reference_from_cloud": self.matrix.tolist(),
            "rotation_deg": self.rotation_degrees,
            "shift_m": list(self.shift),
            "inlier_share": self.inlier_share,
            "rms_before_m": self.rms_before,
            "rms_after_m": self.rms_after,
        }


def register(cloud: Points, reference: Points, *, max_distance: float, threads: int = 1) -> Registration:
    """Find the rigid motion of a cloud onto a reference that is nearly in place already.

    Generalised ICP [1]_ as small_gicp implements it, twice: pairs up to `max_distance`, then up to a quarter
    of it. Only the parts of both clouds that can meet take part, thinned at random (fixed seed).

    Parameters
    ----------
    cloud, reference : (N, 3), (M, 3) float64
    max_distance : float
        Largest distance of a pair. Misalignments beyond it are not found.
    threads : int
        For the measurement of the residuals; ICP itself runs on one thread so that its result is repeatable.

    Returns
    -------
    Registration

    Raises
    ------
    InputError
        Fewer than 100 points of one cloud in reach of the other.

    References
    ----------
    .. [1] Segal, Haehnel, Thrun (2009), Generalized-ICP. https://doi.org/10.15607/RSS.2009.V.021
    """
    centre = reference.mean(axis=0)
    source = _sample(_in_reach(cloud, reference, max_distance)) - centre
    target = _sample(_in_reach(reference, cloud, max_distance)) - centre
    if min(len(source), len(target)) < _MIN_POINTS:
        raise InputError(
            f"registration needs {_MIN_POINTS} points of the cloud and of the reference within "
            f"{max_distance:g} m of each other: align them first, or give --register False"
        )
    motion = _generalised_icp(source, target, max_distance)
    index = PointIndex(target)
    before, _ = _residual(index, source, max_distance, threads)
    moved = source @ motion[:3, :3].T + motion[:3, 3]
    after, inlier_share = _residual(index, moved, max_distance, threads)
    applied = bool(np.isfinite(motion).all() and after <= before)
    if not applied:
        logger.warning("registration made the residual larger (%.4g to %.4g m): it is not applied", before, after)
    from scipy.spatial.transform import Rotation  # which takes long to load

    rotation = float(np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude()))
    if applied and rotation > _MOST_DEGREES:
        logger.warning(
            "registration turned the cloud by %.1f degrees, which is no small misalignment: are cloud and "
            "reference of one place, and in one frame? Align them first, or give --register False",
            rotation,
        )
    matrix = motion.copy()
    matrix[:3, 3] += centre - motion[:3, :3] @ centre
    shift = moved.mean(axis=0) - source.mean(axis=0)
    return Registration(
        matrix=matrix,
        applied=applied,
        rotation_degrees=rotation,
        shift=(float(shift[0]), float(shift[1]), float(shift[2])),
        inlier_share=inlier_share,
        rms_before=before,
        rms_after=after,
    )


def _generalised_icp(source: Points, target: Points, max_distance: float) -> npt.NDArray[np.float64]:
    """(4, 4) target_from_source."""
    small_gicp = require("small_gicp")
    # Already thinned: the voxels here only merge points that coincide.
    source_cloud, _ = small_gicp.preprocess_points(source, downsampling_resolution=max_distance * 1e-3)
    target_cloud, tree = small_gicp.preprocess_points(target, downsampling_resolution=max_distance * 1e-3)
    motion = np.eye(4)
    for distance in (max_distance, _FINE_SHARE * max_distance):
        result = small_gicp.align(
            target_cloud,
            source_cloud,
            tree,
            init_T_target_source=motion,
            registration_type="GICP",
            max_correspondence_distance=distance,
            max_iterations=100,
            rotation_epsilon=1e-7,
            translation_epsilon=1e-5 * max_distance,
        )
        if result.num_inliers >= _MIN_POINTS:
            motion = np.array(result.T_target_source)
    return motion


def _in_reach(points: Points, others: Points, distance: float) -> Points:
    """The points inside the other cloud's bounding box enlarged by `distance`."""
    low, high = bounds(others)
    inside = np.ones(len(points), bool)
    for axis in range(3):
        inside &= (points[:, axis] >= low[axis] - distance) & (points[:, axis] <= high[axis] + distance)
    return np.asarray(points[inside])


def _sample(points: Points) -> Points:
    if len(points) <= _MAX_POINTS:
        return points
    chosen = np.random.default_rng(0).choice(len(points), _MAX_POINTS, replace=False)
    return points[np.sort(chosen)]


def _residual(index: PointIndex, points: Points, max_distance: float, threads: int) -> tuple[float, float]:
    """Root mean square distance of the pairs within `max_distance`, and the share of points that have one.

    Points without a pair count as `max_distance`, so that losing pairs is never an improvement.
    """
    distances = index.distances(points, threads=threads, bound=max_distance)
    paired = np.isfinite(distances)
    capped = np.where(paired, distances, max_distance)
    return float(np.sqrt(np.mean(np.square(capped)))), float(paired.mean())
