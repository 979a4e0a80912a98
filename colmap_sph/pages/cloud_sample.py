"""The cloud of a workspace, if it is that of the maps that are shown → some of its points."""

from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import numpy as np

from colmap_sph.errors import InputError
from colmap_sph.pages.content import CloudSample
from colmap_sph.pages.samples import MapSamples
from colmap_sph.project.cloud_reader import read_some_of_tiles, read_some_points
from colmap_sph.project.cloud_tiles import INDEX, index_of
from colmap_sph.project.state.cloud_marks import is_cloud_of
from colmap_sph.project.workspace import MapKind, Workspace
from colmap_sph.scene import Scene

# Points to look at.
_SAMPLE = 800_000


def read_cloud(workspace: Workspace, scene: Scene, samples: Mapping[str, MapSamples]) -> CloudSample:
    """Read a sample of the cloud.

    Parameters
    ----------
    workspace : Workspace
    scene : Scene
        In whose coordinates the points are returned.
    samples : mapping of str to MapSamples
        Of the depth maps that are shown.

    Returns
    -------
    CloudSample
        Without points, and with the reason in words, where there is no cloud, or one of other maps.
    """
    index = index_of(workspace)
    path = workspace.fused_path if index is None else workspace.tiles_dir / INDEX
    if not path.exists():
        return _none("There is no cloud yet: colmap_sph run makes one, and stereo_fusion fuses maps.")
    maps = [(name, kind) for name, each in samples.items() for kind in get_args(MapKind) if each.has(kind)]
    is_known = is_cloud_of(workspace, maps)
    if maps and is_known is False:
        return _none(
            f"{path.name} was made of other depth maps than those that are there now, and is not shown: "
            "colmap_sph run, or stereo_fusion, fuses these.",
            is_of_others=True,
        )
    try:
        if index is None:
            points, colours, total = read_some_points(path, _SAMPLE)
        else:
            points, colours, total = read_some_of_tiles(path.parent, index, _SAMPLE)
    except InputError as error:
        return _none(str(error))
    doubt = ""
    if is_known is None and _is_older(workspace, path, maps):
        doubt = f"{path.name} is older than depth maps that are shown here, and may be of earlier ones."
    return CloudSample(points - scene.origin, colours, total, "" if total else "The cloud has no points.", doubt)


def _none(lack: str, *, is_of_others: bool = False) -> CloudSample:
    return CloudSample(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), 0, lack, is_of_others=is_of_others)


def _is_older(workspace: Workspace, cloud: Path, maps: list[tuple[str, MapKind]]) -> bool:
    made = cloud.stat().st_mtime_ns
    return any(workspace.depth_map_path(name, kind).stat().st_mtime_ns > made for name, kind in maps)
