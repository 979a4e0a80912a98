"""Scene and options → the pairs to match, and the views that are asked for."""

import itertools
from pathlib import Path

from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.database import read_verified_matches
from colmap_sph.project.pair_lists import read_patch_match_cfg
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene
from colmap_sph.stereo.partners.pairs import PairSelection, select_pairs


def choose_pairs(
    workspace: Workspace | None,
    scene: Scene,
    options: RunOptions,
    database: Path | None,
    pair_list: Path | None = None,
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

    Returns
    -------
    PairSelection
    """
    path = pair_list
    if path is None and workspace is not None and workspace.patch_match_cfg_path.exists():
        path = workspace.patch_match_cfg_path
    among = scene.index_of if options.region else None  # images elsewhere are named in vain
    written = None if path is None else read_patch_match_cfg(path, among)
    matches = None if database is None or scene.has_tracks else read_verified_matches(database)
    return select_pairs(scene, options.pairs, explicit=written, matches=matches)


def wanted_scene(scene: Scene, selection: PairSelection) -> Scene:
    """Return the scene without the views that are not asked for."""
    return scene.only({*selection.partners, *itertools.chain(*selection.unique_pairs())})
