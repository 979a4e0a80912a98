"""The geometric maps of a workspace → depth at the centres of pixels, with the camera that has these."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, NoResultError, shell_word
from colmap_sph.project.map_files import (
    depth_if_readable,
    has_depth,
    is_depth,
    is_map_there,
    map_size,
    read_depth_map,
    read_normal_planes,
)
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.state.cloud_marks import images_of_cloud
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.agreement import check_some_maps
from colmap_sph.stereo.map_sizes import at_pixel_centres

logger = logging.getLogger(__name__)

_Mapped = tuple[int, View, Path]


@dataclass(frozen=True, eq=False)
class DepthAtCentres:
    """Depth of a view where its pixels' centres are.

    Attributes
    ----------
    view : View
        With as many pixels as the maps have.
    depth : (H, W) float32 ndarray
        z-depth along K⁻¹ (col + 0.5, row + 0.5, 1), model units; 0 = none.
    normals : (H, W, 3) float32 ndarray
        Unit vectors in the camera's frame, towards the camera; 0 = none.
    """

    view: View
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class MappedScene:
    """The scene of a workspace, of views that have geometric maps, each with as many pixels as these."""

    workspace: Workspace
    scene: Scene

    def maps(self) -> Iterator[DepthAtCentres]:
        """The maps of one view after the other."""
        for view in self.scene.views:
            yield self.maps_of(view)

    def maps_of(self, view: View) -> DepthAtCentres:
        """The maps of a view; `InputError` where they are damaged."""
        depth = read_depth_map(self.workspace.depth_map_path(view.name, "geometric"))
        path = self.workspace.normal_map_path(view.name, "geometric")
        if is_map_there(path):
            if map_size(path, 3) != (view.width, view.height):
                raise InputError(f"{path} is not of its depth map's size; delete it and compute it again.")
            normals = read_normal_planes(path)
        else:
            normals = np.zeros((3, *depth.shape), np.float32)
        depth = np.where(is_depth(depth), depth, np.float32(0))
        centred = at_pixel_centres(depth, normals, view)
        return DepthAtCentres(view, centred, np.ascontiguousarray(normals.transpose(1, 2, 0)))


def mapped_scene(workspace: Workspace) -> MappedScene:
    """Read the scene of a workspace, without views that have no geometric depth.

    Raises
    ------
    InputError
        There are no maps, or the model cannot be read.
    NoResultError
        No map has any depth.
    """
    scene, mapped = views_with_maps(workspace)
    views = [at_map_size(view, path) for _, view, path in mapped if has_depth(path, possible=True)]
    if not views:
        raise no_depth(workspace)
    if empty := len(mapped) - len(views):
        logger.warning("%d of %d depth maps have no depth; left out", empty, len(mapped))
    return MappedScene(workspace, replace(scene, views=tuple(views)))


def views_with_maps(workspace: Workspace) -> tuple[Scene, list[_Mapped]]:
    """A workspace's scene, and number, view and depth map of those of whose geometric maps products are made.

    These are the maps that the cloud was made of, where that is known: others may be of earlier runs, or of runs
    that were ended. What is left out is told.

    Raises
    ------
    InputError
        There is none, the model cannot be read, or a map is damaged.
    """
    scene = read_scene(workspace.sparse_dir)
    paths = (workspace.depth_map_path(view.name, "geometric") for view in scene.views)
    numbered = zip(range(len(scene.views)), scene.views, paths, strict=True)
    mapped = [each for each in numbered if is_map_there(each[2])]
    if not mapped:
        raise InputError(f"{workspace.root} has no geometric depth map; run {_command(workspace)} first.")
    if missing := len(scene.views) - len(mapped):
        logger.warning("%d of %d images have no geometric depth map; left out", missing, len(scene.views))
    return scene, _of_last_cloud(workspace, mapped)


def _of_last_cloud(workspace: Workspace, mapped: list[_Mapped]) -> list[_Mapped]:
    """Those of some maps that the cloud was made of; all where that is not known, or none is."""
    fused = images_of_cloud(workspace, [view.name for _, view, _ in mapped])
    if fused is None:
        return mapped
    # Those that are empty had no part in it either, and are no others.
    others = {view.name for _, view, path in mapped if view.name not in fused and has_depth(path, possible=True)}
    if not others:
        return mapped
    if not fused:
        logger.warning(
            "The cloud in %s was made of other depth maps than are there, of which this is made; %s makes it anew",
            workspace.root,
            _command(workspace),
        )
        return mapped
    logger.warning(
        "The cloud in %s was not made of %d of the %d depth maps there, such as that of %s; left out",
        workspace.root,
        len(others),
        len(mapped),
        min(others),
    )
    return [each for each in mapped if each[1].name not in others]


def no_depth(workspace: Workspace) -> NoResultError:
    """The error of a workspace whose geometric maps have no depth."""
    return NoResultError(
        f"{workspace.root} has no depth in any geometric depth map; {_command(workspace)} says why."
    )


def _command(workspace: Workspace) -> str:
    return f"`colmap_sph run --workspace {shell_word(workspace.root)}`"


def at_map_size(view: View, path: Path) -> View:
    """A view with as many pixels as its depth map has; `InputError` where that has another shape."""
    width, height = map_size(path)
    if not view.may_be_reduced_to(width, height):
        raise InputError(f"{path} has another shape than its image; delete it and compute it again.")
    return view.resized(width, height)


def check_maps(workspace: Workspace) -> None:
    """Raise `InputError` where the geometric maps of a workspace are there, and of another model than its own."""
    scene = read_scene(workspace.sparse_dir)
    paths = {view.name: workspace.depth_map_path(view.name, "geometric") for view in scene.views}
    check_some_maps(
        scene,
        [name for name, path in paths.items() if is_map_there(path)],
        lambda name: depth_if_readable(paths[name]),
        maps=str(workspace.stereo_dir),
        model=str(workspace.sparse_dir),
    )
