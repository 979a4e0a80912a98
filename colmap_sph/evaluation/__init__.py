"""Clouds and depth maps against truth. Needs no stage of the pipeline.

>>> scores = evaluate_files([Path("fused.ply")], Path("lidar.laz"), EvaluationOptions(gsd=0.1))
>>> print(format_clouds(scores))
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
