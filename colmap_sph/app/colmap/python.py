"""COLMAP's dense stereo as pycolmap has it: the same functions with the same arguments, without a GPU."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_sph.app.colmap.fusion import make_cloud, output_of
from colmap_sph.app.colmap.options import PATCH_MATCH_STEREO, STEREO_FUSION, Value, differing
from colmap_sph.app.colmap.patch_match import make_maps
from colmap_sph.project.cloud_output import read_back
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Region

if TYPE_CHECKING:
    from os import PathLike

    AnyPath = str | bytes | PathLike[str] | PathLike[bytes]


def patch_match_stereo(
    workspace_path: "AnyPath",
    workspace_format: str = "COLMAP",
    pmvs_option_name: str = "option-all",
    options: Any = None,
    config_path: "AnyPath" = "",
    cancellation_token: Any = None,
) -> None:
    """Make depth and normal maps of a dense workspace, in the place of `pycolmap.patch_match_stereo`.

    Parameters
    ----------
    workspace_path : path
        As COLMAP's image undistorter makes it.
    workspace_format : str
        "COLMAP".
    pmvs_option_name : str
        Without effect.
    options : pycolmap.PatchMatchOptions, optional
        Values that are not pycolmap's defaults are taken; docs/usage.md says which have an effect.
    config_path : path
        Pairs to match, instead of the workspace's ``stereo/patch-match.cfg``.
    cancellation_token : optional
        Without effect.

    Raises
    ------
    ColmapSphError
    """
    plain = _plain(workspace_path, workspace_format) | {"config_path": os.fsdecode(config_path)}
    make_maps(plain, {} if options is None else differing(options, PATCH_MATCH_STEREO))


def stereo_fusion(
    output_path: "AnyPath",
    workspace_path: "AnyPath",
    workspace_format: str = "COLMAP",
    pmvs_option_name: str = "option-all",
    input_type: str = "geometric",
    options: Any = None,
    output_type: str = "bin",
    cancellation_token: Any = None,
) -> Any:
    """Fuse the maps of a dense workspace, in the place of `pycolmap.stereo_fusion`.

    Parameters
    ----------
    output_path : path
        Of a PLY file, or of the folder of a model.
    workspace_path, workspace_format, pmvs_option_name, cancellation_token
        See `patch_match_stereo`.
    input_type : {"geometric", "photometric"}
    options : pycolmap.StereoFusionOptions, optional
        Values that are not pycolmap's defaults are taken; docs/usage.md says which have an effect.
    output_type : {"bin", "txt", "ply"}

    Returns
    -------
    pycolmap.Reconstruction
        Cameras, images, and the points of the cloud with their tracks.

    Raises
    ------
    ColmapSphError
    """
    plain = _plain(workspace_path, workspace_format) | {
        "output_path": os.fsdecode(output_path),
        "output_type": output_type,
        "input_type": input_type,
    }
    chosen: dict[str, Value] = {} if options is None else differing(options, STEREO_FUSION)
    make_cloud(plain, chosen, region=_region(options))
    return read_back(output_of(plain), Workspace(Path(str(plain["workspace_path"]))))


def _plain(workspace_path: "AnyPath", workspace_format: str) -> dict[str, Value]:
    return {"workspace_path": os.fsdecode(workspace_path), "workspace_format": workspace_format}


def _region(options: Any) -> Region | None:
    """The bounding box of fusion options; None where it holds everything, as it does by default."""
    corners = getattr(options, "bounding_box", None)
    if corners is None:
        return None
    box = np.array(corners, dtype=np.float64)
    everything = float(np.finfo(np.float32).max)
    return None if (np.abs(box) >= everything).all() else Region(box)
