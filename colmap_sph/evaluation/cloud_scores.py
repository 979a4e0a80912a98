"""Accuracy, completeness, F-score and cloud-to-cloud distance of a cloud against a reference.

Definitions
-----------
accuracy (precision)
    Share of the judged points whose distance to the reference is at most τ.
completeness (recall)
    Share of the reference's samples whose distance to the nearest point of the cloud is at most τ.
F-score
    Harmonic mean of the two.

`definition` chooses what is averaged:

points
    Every point counts alike, as CloudCompare and most papers count.
tanks-and-temples [1]_
    Both clouds are cropped, then thinned to voxel centroids at τ/2 before the search, and a distance must be
    *below* τ, as its toolbox does. Its crop polygons are not used: the reference's extent takes their place.
eth3d [2]_
    The share is taken per voxel and averaged over the voxels of two grids shifted by half a voxel, so that
    dense parts weigh no more than sparse ones. Its free-space test along laser beams needs the scanner's
    positions; it is replaced by cropping, or by what the images see where exact depth maps are the reference.

Cloud-to-cloud distance is CloudCompare's `-C2C_DIST` [3]_: nearest neighbour, mean and population standard
deviation over the judged points; with a cap, larger distances count as the cap. With ``register=False`` and
``crop="none"`` the numbers are CloudCompare's for the same files.

References
----------
.. [1] Knapitsch et al. (2017), Tanks and Temples. https://doi.org/10.1145/3072959.3073599
.. [2] Schöps et al. (2017), A multi-view stereo benchmark with high-resolution images and multi-camera
   videos. https://doi.org/10.1109/CVPR.2017.272
.. [3] https://www.cloudcompare.org/doc/wiki/index.php/Cloud-to-Cloud_Distance
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from colmap_sph.evaluation.neighbours import (
    PointIndex,
    Points,
    mean_voxel_shares,
    spatial_order,
    voxel_centroids,
)
from colmap_sph.evaluation.options import EvaluationOptions
from colmap_sph.evaluation.references import Reference
from colmap_sph.evaluation.registration import Registration


@dataclass(frozen=True)
class ThresholdScores:
    """The shares at one τ, each in 0 … 1."""

    tau: float
    """In metres."""
    accuracy: float
    completeness: float

    @property
    def f_score(self) -> float:
        """Harmonic mean of accuracy and completeness; 0 where both are."""
        total = self.accuracy + self.completeness
        return 2 * self.accuracy * self.completeness / total if total > 0 else 0.0

    def as_dict(self) -> dict[str, float]:
        """Plain values for `json.dump`."""
        return {
            "tau_m": self.tau,
            "accuracy": self.accuracy,
            "completeness": self.completeness,
            "f_score": self.f_score,
        }


@dataclass(frozen=True)
class DistanceStatistics:
    """Distances of the judged points to the reference, in metres; capped where a cap was given."""

    mean: float
    standard_deviation: float
    median: float
    maximum: float
    cap: float | None

    def as_dict(self) -> dict[str, float | None]:
        """Plain values for `json.dump`."""
        return {
            "mean_m": self.mean,
            "standard_deviation_m": self.standard_deviation,
            "median_m": self.median,
            "maximum_m": self.maximum,
            "cap_m": self.cap,
        }


@dataclass(frozen=True)
class CloudScores:
    """One cloud against one reference."""

    cloud: str
    reference: str
    definition: str
    gsd: float | None
    point_count: int
    """All points: completeness as papers that compare clouds of the same images count it."""
    judged_count: int
    """Points inside the reference's extent (and, with exact depth maps, in view of them)."""
    reference_count: int
    """Samples of the reference that completeness is a share of."""
    thresholds: tuple[ThresholdScores, ...]
    cloud_to_reference: DistanceStatistics
    registration: Registration | None
    seconds: float

    def as_dict(self) -> dict[str, object]:
        """Plain values for `json.dump`."""
        return {
            "cloud": self.cloud,
            "reference": self.reference,
            "definition": self.definition,
            "gsd_m": self.gsd,
            "point_count": self.point_count,
            "judged_count": self.judged_count,
            "reference_count": self.reference_count,
            "thresholds": [scores.as_dict() for scores in self.thresholds],
            "cloud_to_reference": self.cloud_to_reference.as_dict(),
            "registration": None if self.registration is None else self.registration.as_dict(),
            "seconds": self.seconds,
        }


def distance_statistics(distances: npt.NDArray[np.float64], cap: float | None) -> DistanceStatistics:
    """Mean, population standard deviation, median and maximum of (N,) distances, N > 0."""
    used = distances if cap is None else np.minimum(distances, cap)
    return DistanceStatistics(
        mean=float(used.mean()),
        standard_deviation=float(used.std()),
        median=float(np.median(used)),
        maximum=float(used.max()),
        cap=cap,
    )


def threshold_scores(
    cloud: Points,
    judged: Points,
    distances: npt.NDArray[np.float64],
    reference: Reference,
    options: EvaluationOptions,
) -> tuple[ThresholdScores, ...]:
    """Accuracy and completeness at every τ.

    Parameters
    ----------
    cloud : (N, 3) float64
        The whole cloud, in the reference's frame: what a reference sample may find.
    judged : (J, 3) float64
        The points that accuracy is a share of.
    distances : (J,) float64
        Their distances to the reference.
    reference : Reference
    options : EvaluationOptions

    Returns
    -------
    tuple of ThresholdScores
        One for every τ, ascending.
    """
    taus = options.taus
    if options.definition == "tanks-and-temples":
        # In spatial order the thinning, once per τ, reads memory in sequence.
        source = judged[spatial_order(judged)]
        target = reference.points[spatial_order(reference.points)]
        return tuple(_thinned_scores(source, target, tau, options.worker_count) for tau in taus)
    back = PointIndex(cloud).distances(
        reference.points, threads=options.worker_count, bound=float(np.nextafter(taus[-1], np.inf))
    )
    voxel = (options.voxel_size or taus[0]) if options.definition == "eth3d" else None
    accuracy = _shares(judged, distances, taus, voxel)
    completeness = _shares(reference.points, back, taus, voxel)
    return tuple(
        ThresholdScores(tau, float(right), float(found))
        for tau, right, found in zip(taus, accuracy, completeness, strict=True)
    )


def _shares(
    points: Points, distances: npt.NDArray[np.float64], taus: tuple[float, ...], voxel: float | None
) -> npt.NDArray[np.float64]:
    """Per τ: share of the points within it, or the mean of this share over voxels."""
    hits = distances[:, None] <= np.asarray(taus)
    return np.asarray(hits.mean(axis=0)) if voxel is None else mean_voxel_shares(points, hits, voxel)


def _thinned_scores(cloud: Points, reference: Points, tau: float, threads: int) -> ThresholdScores:
    source = voxel_centroids(cloud, tau / 2)
    target = voxel_centroids(reference, tau / 2)
    forward = PointIndex(target).distances(source, threads=threads, bound=tau)
    backward = PointIndex(source).distances(target, threads=threads, bound=tau)
    return ThresholdScores(tau, float(np.mean(forward < tau)), float(np.mean(backward < tau)))
