"""The cloud of a workspace, if it is that of the maps that are shown → some of its points."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

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


@dataclass(frozen=True, eq=False)
class FoundCloud:
    """The cloud's file as it was found.

    Attributes
    ----------
    path : Path or None
        Of the cloud, or of the index of its tiles; None where there is no cloud.
    points : (n, 3) float64 ndarray
        Some of its points, in the frame of the file.
    colours : (n, 3) uint8 ndarray
    total : int
        Points of the whole cloud.
    problem : str
        Why it cannot be read.
    """

    path: Path | None
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    colours: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    total: int = 0
    problem: str = ""


def find_cloud(workspace: Workspace) -> FoundCloud:
    """Read some points of the cloud of a workspace, whatever it was made of."""
    index = index_of(workspace)
    path = workspace.fused_path if index is None else workspace.tiles_dir / INDEX
    if not path.exists():
        return FoundCloud(None)
    try:
        if index is None:
            return FoundCloud(path, *read_some_points(path, _SAMPLE))
        return FoundCloud(path, *read_some_of_tiles(path.parent, index, _SAMPLE))
    except InputError as error:
        return FoundCloud(path, problem=str(error))


def cloud_of_maps(
    workspace: Workspace, scene: Scene, samples: Mapping[str, MapSamples], found: FoundCloud
) -> CloudSample:
    """Take the cloud that was found, if it is that of the maps.

    Parameters
    ----------
    workspace : Workspace
    scene : Scene
        In whose coordinates the points are returned.
    samples : mapping of str to MapSamples
        Of the depth maps that are shown.
    found : FoundCloud

    Returns
    -------
    CloudSample
        Without points, and with the reason in words, where there is no cloud, or one of other maps.
    """
    path = found.path
    if path is None:
        return _none("There is no cloud yet: colmap_sph run makes one, and stereo_fusion fuses maps.")
    maps = [(name, kind) for name, each in samples.items() for kind in get_args(MapKind) if each.has(kind)]
    is_known = is_cloud_of(workspace, maps)
    if maps and is_known is False:
        return _none(
            f"{path.name} was made of other depth maps than those that are there now, and is not shown: "
            "colmap_sph run, or stereo_fusion, fuses these.",
            is_of_others=True,
        )
    if found.problem:
        return _none(found.problem)
    doubt = ""
    if is_known is None and _is_older(workspace, path, maps):
        doubt = f"{path.name} is older than depth maps that are shown here, and may be of earlier ones."
    lack = "" if found.total else "The cloud has no points."
    return CloudSample(found.points - scene.origin, found.colours, found.total, lack, doubt)


def _none(lack: str, *, is_of_others: bool = False) -> CloudSample:
    return CloudSample(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), 0, lack, is_of_others=is_of_others)


def _is_older(workspace: Workspace, cloud: Path, maps: list[tuple[str, MapKind]]) -> bool:
    made = cloud.stat().st_mtime_ns
    return any(workspace.depth_map_path(name, kind).stat().st_mtime_ns > made for name, kind in maps)
