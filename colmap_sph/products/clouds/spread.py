"""Points of a cloud and the depth maps they come from → how far the images disagree about each point."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, percent
from colmap_sph.products.clouds.source import UNKNOWN, Cloud, CloudPiece, open_cloud
from colmap_sph.products.maps.reading import at_map_size
from colmap_sph.project.map_files import depth_on_disk, is_map_there
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import View

# Depth beyond that, relative, is of another surface: fusion's own bound.
_SAME_SURFACE = 0.01
_OPEN_MAPS = 256
# Of the images that see a point, as a cloud itself says, nearly all have its surface in their maps; next to none
# has where the cloud is of other poses. So many points are asked; fewer sightings say nothing.
_ASKED = 4096
_FEWEST_SIGHTINGS = 100
_LEAST_SHOWN = 0.1


def measured_cloud(workspace: Workspace) -> Cloud:
    """The fused cloud of a workspace; what its maps say of the points is measured where there are maps.

    Raises
    ------
    InputError, NoResultError
        As of `open_cloud`; or the cloud is of other poses than the model, which was moved after the fusion.
    """
    cloud, spread = open_cloud(workspace), DepthSpread(workspace)
    if not cloud.has_images or not spread.has_maps:
        return cloud
    piece = next(cloud.pieces())
    number = len(piece.xyz)
    sightings, shown = spread.shown(piece.only(np.arange(number) % -(-number // _ASKED or 1) == 0))
    if sightings >= _FEWEST_SIGHTINGS and shown < _LEAST_SHOWN * sightings:
        raise InputError(
            f"The cloud in {workspace.root} is not of the model in {workspace.sparse_dir}: only "
            f"{percent(shown / sightings)} of the images that see a point have its surface there. Was the model "
            "moved, aligned or replaced after the fusion? Fuse again."
        )
    return replace(cloud, measure=spread.of)


class DepthSpread:
    """What the geometric maps of a workspace say about points of its cloud.

    Raises
    ------
    InputError
        The model cannot be read.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._scene = read_scene(workspace.sparse_dir)
        by_id = {view.image_id: view for view in self._scene.views}
        # As visibility counts images.
        self._views = [by_id.get(image_id) for image_id in self._scene.image_ids]
        self._map_of = lru_cache(_OPEN_MAPS)(self._open)

    @property
    def has_maps(self) -> bool:
        """Whether there is any map to look at."""
        return any(self._map_of(index) is not None for index in range(len(self._views)))

    def of(self, piece: CloudPiece) -> NDArray[np.float32]:
        """Standard deviation of what the images that see a point say of its surface.

        Parameters
        ----------
        piece : CloudPiece
            With the images that see each point.

        Returns
        -------
        (n,) float32 ndarray
            Along the normal, or the ray where there is none, in model units; `UNKNOWN` for fewer than two maps.

        Raises
        ------
        InputError
            A map is damaged.
        """
        number = len(piece.xyz)
        sums = np.zeros((3, number))
        for _, kept, distances in self._sightings(piece):
            for power in range(3):
                sums[power] += np.bincount(kept, distances**power, number)
        count, total, squares = sums
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = (squares - total**2 / count) / (count - 1)
        return np.where(count >= 2, np.sqrt(np.maximum(variance, 0)), UNKNOWN).astype(np.float32)

    def shown(self, piece: CloudPiece) -> tuple[int, int]:
        """How many times images that have maps see points, and how many times the map has their surface there."""
        counts = [(len(rows), len(kept)) for rows, kept, _ in self._sightings(piece)]
        return sum(all_of for all_of, _ in counts), sum(shown for _, shown in counts)

    def _sightings(
        self, piece: CloudPiece
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
        """Of each image that has a map: the points it sees, those the map shows, and how far it is from these."""
        if piece.counts is None or piece.images is None:
            return
        owners = np.repeat(np.arange(len(piece.xyz)), piece.counts)
        for index in np.unique(piece.images).tolist():
            rows = owners[piece.images == index]
            known = self._map_of(index)
            if known is not None:
                yield rows, *self._distances(piece, rows, *known)

    def _open(self, index: int) -> tuple[View, NDArray[np.float32]] | None:
        """An image's view and depth map, where it has both."""
        view = self._views[index] if index < len(self._views) else None
        path = None if view is None else self._workspace.depth_map_path(view.name, "geometric")
        if view is None or path is None or not is_map_there(path):
            return None
        return at_map_size(view, path), depth_on_disk(path)

    def _distances(
        self, piece: CloudPiece, rows: NDArray[np.int64], view: View, depth_map: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Which of these points a map shows, and how far its surface is from each, along the normal."""
        places = piece.xyz[rows] - self._scene.origin
        projected = places @ (view.K @ view.R).T + view.K @ view.t
        depth = projected[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            # Where COLMAP's maps have their depth; what is not finite lies outside.
            columns = np.rint(projected[:, 0] / depth)
            lines = np.rint(projected[:, 1] / depth)
        inside = (columns >= 0) & (columns < view.width) & (lines >= 0) & (lines < view.height)
        columns = np.where(inside, columns, 0)
        lines = np.where(inside, lines, 0)
        there = depth_map[lines.astype(np.int32), columns.astype(np.int32)].astype(np.float64)
        shown = inside & (np.abs(there - depth) <= _SAME_SURFACE * depth)
        rays = np.stack([columns * there, lines * there, there], axis=1) @ (view.inverse_K.T @ view.R)
        away = rays + view.center - places
        if piece.normals is None:
            normals = places - view.center
            distances = np.einsum("ij,ij->i", away, normals) / np.linalg.norm(normals, axis=1)
        else:
            distances = np.einsum("ij,ij->i", away, piece.normals[rows])
        return rows[shown], distances[shown]
