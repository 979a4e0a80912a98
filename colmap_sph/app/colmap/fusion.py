"""`stereo_fusion` in COLMAP's place: the maps of a dense workspace → a cloud at any path."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from colmap_sph.app.colmap.options import STEREO_FUSION, Value
from colmap_sph.app.colmap.settings import WrongOptionError, check_workspace, run_options, spelled_as_colmap
from colmap_sph.pipeline.fuse_maps import fuse_maps
from colmap_sph.pipeline.report import Progress, RunReport
from colmap_sph.project.cloud_output import CloudOutput
from colmap_sph.project.project import Project, open_workspace
from colmap_sph.project.region_file import read_box_file
from colmap_sph.scene import Region


def make_cloud(
    plain: Mapping[str, Value],
    chosen: Mapping[str, Value],
    *,
    region: Region | None = None,
    command: str = "",
    progress: Progress | None = None,
) -> RunReport:
    """Fuse the maps of a dense workspace.

    Parameters
    ----------
    plain : mapping of str to value
        Options without a section, by COLMAP's names.
    chosen : mapping of str to value
        Those of `StereoFusion` that the user chose; ours are at their own defaults otherwise.
    region : Region, optional
        Where points are wanted, where no file says so.
    command : str
        What to type to do the same again.
    progress : Progress, optional

    Returns
    -------
    RunReport
    """
    check_workspace(plain)
    output = output_of(plain)
    kind = str(plain["input_type"]).lower()
    if kind not in ("photometric", "geometric"):
        raise WrongOptionError(f"--input_type must be photometric or geometric, not {plain['input_type']!r}.")
    options = run_options(chosen, STEREO_FUSION, "StereoFusion", {"fusion.input": kind})
    if plain.get("bbox_path"):
        region = read_box_file(Path(str(plain["bbox_path"])), "--bbox_path")
    project = Project(workspace=Path(str(plain["workspace_path"])))
    project.check()
    workspace = open_workspace(project)
    with spelled_as_colmap(STEREO_FUSION, "StereoFusion"):
        report = fuse_maps(workspace, output, options, region=region, progress=progress)
    report.command = command
    return report


def output_of(plain: Mapping[str, Value]) -> CloudOutput:
    """Where the cloud goes, and as what."""
    kinds: dict[str, Literal["ply", "bin", "txt"]] = {"ply": "ply", "bin": "bin", "txt": "txt"}
    kind = kinds.get(str(plain["output_type"]).lower())
    if kind is None:
        raise WrongOptionError(f"--output_type must be PLY, BIN or TXT, not {plain['output_type']!r}.")
    return CloudOutput(Path(str(plain["output_path"])), kind)
