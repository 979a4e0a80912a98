"""Clouds and depth maps against truth. Needs no stage of the pipeline.

Files are measured by `evaluate_files`, arrays so. A cloud 3 cm above its reference:

>>> import numpy as np
>>> ground = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), axis=-1).reshape(-1, 3)
>>> reference = make_reference(PointCloud("ground", ground))
>>> options = EvaluationOptions(tau=(0.02, 0.05), register=False)
>>> scores = evaluate_cloud(PointCloud("cloud", ground + [0, 0, 0.03]), reference, options)
>>> [(threshold.tau, threshold.accuracy) for threshold in scores.thresholds]
[(0.02, 0.0), (0.05, 1.0)]
"""

from colmap_sph.evaluation.cloud_scores import CloudScores, DistanceStatistics, ThresholdScores
from colmap_sph.evaluation.depth_maps import (
    DepthMapScores,
    compare_depth_map,
    truth_at_pixel_origin,
    truth_normals_at_pixel_origin,
)
from colmap_sph.evaluation.evaluate import evaluate_cloud, evaluate_files
from colmap_sph.evaluation.geometry_io import Mesh, PointCloud, read_geometry
from colmap_sph.evaluation.options import EvaluationOptions
from colmap_sph.evaluation.references import Reference, make_reference
from colmap_sph.evaluation.registration import Registration, register
from colmap_sph.evaluation.report import format_clouds, format_depth_maps, mean_of_depth_maps, write_json
from colmap_sph.evaluation.visible_surface import DepthView, count_views, visible_surface

__all__ = [
    "CloudScores",
    "DepthMapScores",
    "DepthView",
    "DistanceStatistics",
    "EvaluationOptions",
    "Mesh",
    "PointCloud",
    "Reference",
    "Registration",
    "ThresholdScores",
    "compare_depth_map",
    "count_views",
    "evaluate_cloud",
    "evaluate_files",
    "format_clouds",
    "format_depth_maps",
    "make_reference",
    "mean_of_depth_maps",
    "read_geometry",
    "register",
    "truth_at_pixel_origin",
    "truth_normals_at_pixel_origin",
    "visible_surface",
    "write_json",
]
