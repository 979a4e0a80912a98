"""Scene and options → the pairs to match, and the views that are asked for."""

import itertools
from pathlib import Path

from colmap_sph.pipeline.digests import digest
from colmap_sph.pipeline.known.selection import read_selection, write_selection
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.database import read_verified_matches
from colmap_sph.project.pair_lists import read_patch_match_cfg
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene
from colmap_sph.stereo.partners.covisibility import has_enough_tracks
from colmap_sph.stereo.partners.pairs import PairSelection, report_selection, select_pairs


def choose_pairs(
    workspace: Workspace | None,
    scene: Scene,
    options: RunOptions,
    database: Path | None,
    pair_list: Path | None = None,
    *,
    scene_key: str = "",
    keep: bool = False,
) -> PairSelection:
    """Select the pairs of a scene, as the user's ``patch-match.cfg`` says where there is one.

    Parameters
    ----------
    workspace : Workspace or None
        None: it is not there yet, and so no such file.
    scene : Scene
    options : RunOptions
    database, pair_list : Path, optional
        See `reconstruct`.
    scene_key : str
        Digest of the scene and of the code that chooses. Where the workspace has what an earlier run chose for the
        same, that is taken. Empty: it is not looked for.
    keep : bool
        Whether to leave the selection there for later runs.

    Returns
    -------
    PairSelection
    """
    pair_list = pair_list or _users_list(workspace)
    among = scene.index_of if options.region else None  # images elsewhere are named in vain
    written = None if pair_list is None else read_patch_match_cfg(pair_list, among)
    matches = None if database is None or has_enough_tracks(scene) else read_verified_matches(database)
    path = None if workspace is None or not scene_key else workspace.known_path("selection")
    key = "" if path is None else digest(scene_key, options.pairs, written, matches)
    known = None if path is None else read_selection(path, key)
    if known is not None:
        report_selection(known, options.pairs)
        return known
    selection = select_pairs(scene, options.pairs, explicit=written, matches=matches)
    if keep and path is not None:
        write_selection(path, key, selection)
    return selection


def _users_list(workspace: Workspace | None) -> Path | None:
    there = workspace is not None and workspace.patch_match_cfg_path.exists()
    return workspace.patch_match_cfg_path if workspace is not None and there else None


def wanted_scene(scene: Scene, selection: PairSelection) -> Scene:
    """Return the scene without the views that are not asked for."""
    names = {*selection.partners, *itertools.chain(*selection.unique_pairs())}
    return scene.only({view.name for name in names for view in scene.photograph(name).views})
