"""Dense reconstruction for COLMAP without a GPU.

>>> import colmap_sph
>>> report = colmap_sph.run("sparse/0")  # doctest: +SKIP

The rooms: `project` is what the user brought and what lies on disk, `stereo` the method, `pipeline` a run of it,
and `app` the commands. Here are the names that a program needs first; docs/usage.md shows them at work.
"""

# pycolmap brings a zlib of its own; the first one loaded serves every module of the process, and with
# pycolmap's, Python's and OpenCV's PNG writers crash.
import zlib  # noqa: F401
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from colmap_sph.app.colmap.python import patch_match_stereo as patch_match_stereo
    from colmap_sph.app.colmap.python import stereo_fusion as stereo_fusion
    from colmap_sph.errors import ColmapSphError as ColmapSphError
    from colmap_sph.pipeline.options import RunOptions as RunOptions
    from colmap_sph.pipeline.presets import preset as preset
    from colmap_sph.pipeline.reconstruct import reconstruct as reconstruct
    from colmap_sph.pipeline.reconstruct import run as run
    from colmap_sph.pipeline.reconstruct import run_project as run_project
    from colmap_sph.pipeline.report import Progress as Progress
    from colmap_sph.pipeline.report import RunReport as RunReport
    from colmap_sph.project.images.reading import read_grey as read_grey
    from colmap_sph.project.map_files import read_depth_map as read_depth_map
    from colmap_sph.project.map_files import read_normal_map as read_normal_map
    from colmap_sph.project.map_files import write_depth_map as write_depth_map
    from colmap_sph.project.map_files import write_normal_map as write_normal_map
    from colmap_sph.project.project import Project as Project
    from colmap_sph.project.scene_reader import read_scene as read_scene
    from colmap_sph.project.undistortion import UndistortionOptions as UndistortionOptions
    from colmap_sph.project.workspace import Workspace as Workspace
    from colmap_sph.scene import Scene as Scene
    from colmap_sph.scene import View as View
    from colmap_sph.stereo.anchor import anchored as anchored
    from colmap_sph.stereo.census import RectifiedImage as RectifiedImage
    from colmap_sph.stereo.confirm import ConfirmOptions as ConfirmOptions
    from colmap_sph.stereo.confirm import confirm_depth as confirm_depth
    from colmap_sph.stereo.fusion import FusionOptions as FusionOptions
    from colmap_sph.stereo.matching import MatchingOptions as MatchingOptions
    from colmap_sph.stereo.matching import match_pair as match_pair
    from colmap_sph.stereo.normals import NormalOptions as NormalOptions
    from colmap_sph.stereo.normals import fit_normals as fit_normals
    from colmap_sph.stereo.partners.pairs import PairOptions as PairOptions
    from colmap_sph.stereo.partners.pairs import select_pairs as select_pairs
    from colmap_sph.stereo.rectification import RectificationOptions as RectificationOptions
    from colmap_sph.stereo.rectification import rectify_pair as rectify_pair
    from colmap_sph.stereo.rectified_pair import PairDisparity as PairDisparity
    from colmap_sph.stereo.refinement import RefinementOptions as RefinementOptions
    from colmap_sph.stereo.refinement import refine_maps as refine_maps
    from colmap_sph.stereo.resampling import resample as resample
    from colmap_sph.stereo.vote import VoteOptions as VoteOptions
    from colmap_sph.stereo.vote import vote_depth as vote_depth

__version__ = "0.1.0"

_MODULE_OF = {
    "ColmapSphError": "errors",
    "ConfirmOptions": "stereo.confirm",
    "FusionOptions": "stereo.fusion",
    "MatchingOptions": "stereo.matching",
    "NormalOptions": "stereo.normals",
    "PairDisparity": "stereo.rectified_pair",
    "PairOptions": "stereo.partners.pairs",
    "Progress": "pipeline.report",
    "Project": "project.project",
    "RectificationOptions": "stereo.rectification",
    "RectifiedImage": "stereo.census",
    "RefinementOptions": "stereo.refinement",
    "RunOptions": "pipeline.options",
    "RunReport": "pipeline.report",
    "Scene": "scene",
    "UndistortionOptions": "project.undistortion",
    "View": "scene",
    "VoteOptions": "stereo.vote",
    "Workspace": "project.workspace",
    "anchored": "stereo.anchor",
    "confirm_depth": "stereo.confirm",
    "fit_normals": "stereo.normals",
    "match_pair": "stereo.matching",
    "patch_match_stereo": "app.colmap.python",
    "preset": "pipeline.presets",
    "read_depth_map": "project.map_files",
    "read_grey": "project.images.reading",
    "read_normal_map": "project.map_files",
    "read_scene": "project.scene_reader",
    "reconstruct": "pipeline.reconstruct",
    "rectify_pair": "stereo.rectification",
    "refine_maps": "stereo.refinement",
    "resample": "stereo.resampling",
    "run": "pipeline.reconstruct",
    "run_project": "pipeline.reconstruct",
    "select_pairs": "stereo.partners.pairs",
    "stereo_fusion": "app.colmap.python",
    "vote_depth": "stereo.vote",
    "write_depth_map": "project.map_files",
    "write_normal_map": "project.map_files",
}
__all__ = list(_MODULE_OF)


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used: `colmap_sph.evaluation` alone must not load the pipeline."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
