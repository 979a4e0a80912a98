"""The fused clouds against LiDAR (the paper's Table 2) and against exact depth."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from colmap_sph.evaluation import (
    DepthView,
    EvaluationOptions,
    PointCloud,
    evaluate_cloud,
    make_reference,
    read_geometry,
    visible_surface,
)
from colmap_sph.evaluation.neighbours import PointIndex
from colmap_sph.stereo.rectified_pair import Surface
from rectification_study.runs import Run

SEEN_BY_LIDAR = 4.0
"""LiDAR saw the exact surface where it has a return within this distance, in GSD: not on façades."""


def against_lidar(
    runs: Mapping[Surface, Run], lidar: Path, exact: Sequence[DepthView] | None, gsd: float
) -> dict[str, Any]:
    """Cloud-to-cloud distances after registration, as in the paper's Table 2, and where exact depth is given
    the floor below each: the same statistics of the exact surface at the places of the cloud's points."""
    options = EvaluationOptions(gsd=gsd)
    reference = make_reference(read_geometry(lidar), options)
    surface = None if exact is None else visible_surface(exact, gsd / 2)
    surface_index = None if surface is None else PointIndex(surface)
    result: dict[str, Any] = {}
    for which, run in runs.items():
        cloud = read_geometry(run.workspace.fused_path)
        assert isinstance(cloud, PointCloud)
        result[which] = {"cloud": evaluate_cloud(cloud, reference, options).as_dict()}
        if surface is None or surface_index is None:
            continue
        rows = surface_index.nearest(cloud.points, 1, threads=options.worker_count)[:, 0]
        fixed = EvaluationOptions(gsd=gsd, register=False)
        floor = PointCloud("exact surface", surface[rows])
        result[which]["floor"] = evaluate_cloud(floor, reference, fixed).as_dict()
        seen = np.asarray(reference.distances(floor.points, threads=options.worker_count, bound=np.inf))
        kept = seen <= SEEN_BY_LIDAR * gsd
        result[which]["share_seen_by_lidar"] = float(kept.mean())
        for name, points in (("cloud", cloud.points), ("floor", floor.points)):
            part = PointCloud(name, points[kept])
            result[which][f"{name}_seen_by_lidar"] = evaluate_cloud(part, reference, fixed).as_dict()
    return result


def against_exact_depth(runs: Mapping[Surface, Run], exact: Sequence[DepthView], gsd: float) -> dict[str, Any]:
    """Accuracy, completeness and F-score of the clouds, aware of what the images see."""
    options = EvaluationOptions(gsd=gsd)
    reference = make_reference(exact, options)
    return {
        surface: evaluate_cloud(read_geometry(run.workspace.fused_path), reference, options).as_dict()
        for surface, run in runs.items()
    }
