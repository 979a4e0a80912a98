"""One cloud against one reference: check, register, crop, measure."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import InputError, NoResultError
from colmap_sph.evaluation.cloud_scores import CloudScores, distance_statistics, threshold_scores
from colmap_sph.evaluation.geometry_io import Mesh, PointCloud, read_geometry
from colmap_sph.evaluation.mesh_surface import MeshSurface
from colmap_sph.evaluation.neighbours import Points, bounds
from colmap_sph.evaluation.options import EvaluationOptions
from colmap_sph.evaluation.references import Reference, make_reference
from colmap_sph.evaluation.registration import Registration, register

logger = logging.getLogger(__name__)

_MAP_COORDINATES = 2e4
"""Distance from the origin beyond which coordinates look like map coordinates rather than a local frame."""


def evaluate_files(
    clouds: Sequence[Path], reference: Path, options: EvaluationOptions | None = None
) -> list[CloudScores]:
    """Measure the clouds of some files, read one at a time, against the cloud or mesh of another.

    Parameters
    ----------
    clouds : sequence of Path
    reference : Path
    options : EvaluationOptions, optional

    Returns
    -------
    list of CloudScores
        In the order of the clouds.

    Raises
    ------
    InputError, NoResultError, OptionError
        As `read_geometry`, `make_reference` and `evaluate_cloud`.
    """
    options = options or EvaluationOptions()
    prepared = make_reference(read_geometry(reference), options)
    return [evaluate_cloud(read_geometry(cloud), prepared, options) for cloud in clouds]


def evaluate_cloud(
    cloud: PointCloud | Mesh, reference: Reference, options: EvaluationOptions | None = None
) -> CloudScores:
    """Measure a cloud against a reference.

    Parameters
    ----------
    cloud : PointCloud or Mesh
        A mesh is measured by samples of its surface.
    reference : Reference
        From `make_reference`, with the same options.
    options : EvaluationOptions, optional

    Returns
    -------
    CloudScores

    Raises
    ------
    InputError
        Cloud and reference do not overlap.
    NoResultError
        No point of the cloud can be judged.
    OptionError
    """
    options = options or EvaluationOptions()
    options.check()
    started = time.perf_counter()
    if isinstance(cloud, Mesh):
        cloud = PointCloud(cloud.name, MeshSurface(cloud, options.sample_spacing).samples)
    reach = max(options.taus[-1], options.max_pair_distance if options.register else 0.0)
    check_overlap(cloud, reference, reach)
    points, registration = _registered(cloud, reference, options)
    judged = points[_is_judged(points, reference, options)]
    if not len(judged):
        raise NoResultError(
            f"no point of {cloud.name} lies within the extent of {reference.name}: check the crop option, "
            "and that both are in the same frame and unit"
        )
    bound = np.inf if options.distance_cap is None else max(options.distance_cap, options.taus[-1]) * 1.001
    distances = reference.distances(judged, threads=options.worker_count, bound=bound)
    return CloudScores(
        cloud=cloud.name,
        reference=reference.name,
        definition=options.definition,
        gsd=options.gsd,
        point_count=len(points),
        judged_count=len(judged),
        reference_count=len(reference.points),
        thresholds=threshold_scores(points, judged, distances, reference, options),
        cloud_to_reference=distance_statistics(distances, options.distance_cap),
        registration=registration,
        seconds=time.perf_counter() - started,
    )


def check_overlap(cloud: PointCloud, reference: Reference, reach: float) -> None:
    """Make sure that a cloud and its reference lie in one place.

    Parameters
    ----------
    cloud : PointCloud
    reference : Reference
    reach : float
        Metres that may lie between their bounding boxes.

    Raises
    ------
    InputError
        They are farther apart, or in degrees; the message has the remedy.
    """
    for name, crs in ((cloud.name, cloud.crs), (reference.name, reference.crs)):
        if crs is not None and crs.startswith("geographic"):
            raise InputError(f"{name} is in degrees, {crs}: reproject it to the metric frame of the other first")
    cloud_low, cloud_high = bounds(cloud.points)
    low, high = bounds(reference.points)
    if np.all(cloud_low - reach <= high) and np.all(low - reach <= cloud_high):
        return
    here = (cloud_low + cloud_high) / 2
    there = (low + high) / 2
    places = f"{cloud.name} lies around {_place(here)}, {reference.name} around {_place(there)}"
    for name, crs, centre, other in (
        (cloud.name, cloud.crs, here, there),
        (reference.name, reference.crs, there, here),
    ):
        if _looks_projected(crs, centre) and not _looks_projected(None, other):
            raise InputError(
                f"{name} is in map coordinates ({crs or 'far from the origin'}), the other in a local frame: "
                "subtract the offset that was taken off when the model was made local (--reference-shift "
                f"x y z does it for the reference); no rotation or scale may remain; {places}"
            )
    raise InputError(
        f"the cloud and the reference do not overlap: {places}; bring them into one frame and unit first, "
        f"registration only mends misalignments up to {reach:g} m"
    )


def _looks_projected(crs: str | None, centre: npt.NDArray[np.float64]) -> bool:
    far = float(np.abs(centre).max()) > _MAP_COORDINATES
    return far or (crs is not None and crs.startswith("projected") and float(np.abs(centre[:2]).max()) > 1e3)


def _place(centre: npt.NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value:.0f}" for value in centre) + ")"


def _registered(
    cloud: PointCloud, reference: Reference, options: EvaluationOptions
) -> tuple[Points, Registration | None]:
    """The cloud's points in the reference's frame, and the motion that brought them there."""
    if not options.register or not reference.movable:
        return cloud.points, None
    registration = register(
        cloud.points, reference.points, max_distance=options.max_pair_distance, threads=options.worker_count
    )
    return registration.transform(cloud.points), registration


def _is_judged(points: Points, reference: Reference, options: EvaluationOptions) -> npt.NDArray[np.bool_]:
    """(N,): whether a point lies in the part of space that the reference covers."""
    judged = reference.can_judge(points)
    crop = options.crop
    if crop == "auto":
        crop = "none" if not reference.movable else "horizontal" if reference.z_is_up else "box"
    if crop == "none":
        return judged
    low, high = bounds(reference.points)
    margin = options.taus[-1]
    for axis in range(2 if crop == "horizontal" else 3):
        judged &= (points[:, axis] >= low[axis] - margin) & (points[:, axis] <= high[axis] + margin)
    return judged
