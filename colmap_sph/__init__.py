"""Dense reconstruction for COLMAP without a GPU.

>>> import colmap_sph
>>> report = colmap_sph.run("sparse/0")  # doctest: +SKIP

The rooms: `project` is what the user brought and what lies on disk, `stereo` the method, `pipeline` a run of it, and
`app` the commands. Here are the names that a program needs first; docs/usage.md shows them at work.
"""

# pycolmap brings a zlib of its own; the first one loaded serves every module of the process, and with
# pycolmap's, Python's and OpenCV's PNG writers crash.
import zlib  # noqa: F401
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from colmap_sph.errors import ColmapSphError
    from colmap_sph.pipeline.options import RunOptions
    from colmap_sph.pipeline.reconstruct import reconstruct, run, run_project
    from colmap_sph.pipeline.report import Progress, RunReport
    from colmap_sph.project.images import read_grey
    from colmap_sph.project.map_files import read_depth_map, read_normal_map, write_depth_map, write_normal_map
    from colmap_sph.project.project import Project
    from colmap_sph.project.scene_reader import read_scene
    from colmap_sph.project.workspace import Workspace
    from colmap_sph.scene import Scene, View
    from colmap_sph.stereo.confirm import confirm_depth
    from colmap_sph.stereo.matching import RectifiedImage, match_pair
    from colmap_sph.stereo.normals import fit_normals
    from colmap_sph.stereo.pairs import select_pairs
    from colmap_sph.stereo.rectification import rectify_pair
    from colmap_sph.stereo.rectified_pair import PairDisparity
    from colmap_sph.stereo.refinement import refine_maps
    from colmap_sph.stereo.resampling import resample
    from colmap_sph.stereo.vote import vote_depth

__version__ = "0.1.0"

_MODULE_OF = {
    "ColmapSphError": "errors",
    "PairDisparity": "stereo.rectified_pair",
    "Progress": "pipeline.report",
    "Project": "project.project",
    "RectifiedImage": "stereo.matching",
    "RunOptions": "pipeline.options",
    "RunReport": "pipeline.report",
    "Scene": "scene",
    "View": "scene",
    "Workspace": "project.workspace",
    "confirm_depth": "stereo.confirm",
    "fit_normals": "stereo.normals",
    "match_pair": "stereo.matching",
    "read_depth_map": "project.map_files",
    "read_grey": "project.images",
    "read_normal_map": "project.map_files",
    "read_scene": "project.scene_reader",
    "reconstruct": "pipeline.reconstruct",
    "rectify_pair": "stereo.rectification",
    "refine_maps": "stereo.refinement",
    "resample": "stereo.resampling",
    "run": "pipeline.reconstruct",
    "run_project": "pipeline.reconstruct",
    "select_pairs": "stereo.pairs",
    "vote_depth": "stereo.vote",
    "write_depth_map": "project.map_files",
    "write_normal_map": "project.map_files",
}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used: `colmap_sph.evaluation` alone must not load the pipeline."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
