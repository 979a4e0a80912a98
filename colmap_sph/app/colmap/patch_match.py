"""`patch_match_stereo` in COLMAP's place: depth and normal maps of a dense workspace."""

import time
from collections.abc import Mapping
from pathlib import Path

from colmap_sph.app.colmap.options import PATCH_MATCH_STEREO, Value
from colmap_sph.app.colmap.settings import WrongOptionError, check_workspace, run_options, spelled_as_colmap
from colmap_sph.pipeline.context import Until
from colmap_sph.pipeline.input.start import Request
from colmap_sph.pipeline.reconstruct import reconstruct
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.project.claim import check_links, claimed
from colmap_sph.project.project import Project, open_workspace


def make_maps(
    plain: Mapping[str, Value],
    chosen: Mapping[str, Value],
    *,
    command: str = "",
    progress: Progress | None = None,
    started: float | None = None,
) -> RunReport:
    """Make the maps of a dense workspace.

    Parameters
    ----------
    plain : mapping of str to value
        Options without a section, by COLMAP's names.
    chosen : mapping of str to value
        Those of `PatchMatchStereo` that the user chose; ours are at their own defaults otherwise.
    command : str
        What to type to do the same again.
    progress : Progress, optional
    started : float, optional
        When the command began, as `time.monotonic` tells; default: now.

    Returns
    -------
    RunReport
    """
    check_workspace(plain)
    pair_list = Path(str(plain["config_path"])) if plain.get("config_path") else None
    if pair_list is not None and not pair_list.is_file():
        raise WrongOptionError(f"--config_path: {pair_list} is no file; name a list of pairs.")
    options = run_options(chosen, PATCH_MATCH_STEREO, "PatchMatchStereo")
    project = Project(workspace=Path(str(plain["workspace_path"])))
    project.check()
    workspace = open_workspace(project)
    check_links(workspace, is_given=True)
    with claimed(workspace), spelled_as_colmap(PATCH_MATCH_STEREO, "PatchMatchStereo"):
        request = Request(
            progress=progress or Silent(),
            report=RunReport(command=command, started=started or time.monotonic()),
            pair_list=pair_list,
            needs_all=not chosen.get("allow_missing_files", False),
        )
        until: Until = "geometric" if chosen.get("geom_consistency", True) else "photometric"
        return reconstruct(workspace, options, request, until=until)
