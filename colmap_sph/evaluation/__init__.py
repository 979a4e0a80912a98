"""Clouds and depth maps against truth. Needs no stage of the pipeline.

>>> options = EvaluationOptions(gsd=0.1)
>>> reference = make_reference(read_geometry(Path("lidar.laz")), options)
>>> scores = evaluate_cloud(read_geometry(Path("fused.ply")), reference, options)
>>> print(format_clouds([scores]))
"""

from colmap_sph.evaluation.cloud_scores import CloudScores, DistanceStatistics, ThresholdScores
from colmap_sph.evaluation.depth_maps import DepthMapScores, compare_depth_map, truth_at_pixel_origin
from colmap_sph.evaluation.evaluate import evaluate_cloud
from colmap_sph.evaluation.geometry_io import Mesh, PointCloud, read_geometry
from colmap_sph.evaluation.options import EvaluationOptions
from colmap_sph.evaluation.references import Reference, make_reference
from colmap_sph.evaluation.registration import Registration, register
from colmap_sph.evaluation.report import format_clouds, format_depth_maps, mean_of_depth_maps, write_json
from colmap_sph.evaluation.visible_surface import DepthView, VisibleSurface, visible_surface

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
    "VisibleSurface",
    "compare_depth_map",
    "evaluate_cloud",
    "format_clouds",
    "format_depth_maps",
    "make_reference",
    "mean_of_depth_maps",
    "read_geometry",
    "register",
    "truth_at_pixel_origin",
    "visible_surface",
    "write_json",
]
