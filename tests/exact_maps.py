"""A dense workspace with exact maps: six views of a slanted plane."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from colmap_sph import synthetic as syn
from colmap_sph.project.map_files import read_depth_map, read_normal_planes, write_depth_map, write_normal_map
from colmap_sph.project.pair_lists import write_fusion_cfg
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.fusion_losses import DepthAndNormals

WIDTH, HEIGHT, FOCAL = 120, 90, 150.0
FLYING_HEIGHT = 10.0
GSD = FLYING_HEIGHT / FOCAL
NORMAL = np.array([-0.35, 0.25, 0.9]) / np.linalg.norm([-0.35, 0.25, 0.9])
NAMES = [f"{name}.png" for name in "abcdef"]


def slanted_plane() -> syn.Plane:
    return syn.Plane((0, 0, 0), NORMAL, syn.Mottled(syn.Noise(GSD, seed=1)))


def cameras_above() -> list[syn.Camera]:
    """Six cameras in two strips, tilted towards the origin."""
    cameras = []
    for x, y in [(-1.2, -0.7), (0.1, -0.8), (1.3, -0.6), (-1.1, 0.7), (-0.1, 0.9), (1.2, 0.6)]:
        R, t = syn.look_at((x, y, FLYING_HEIGHT), (0.4 * x, 0.4 * y, 0), up=(0, 1, 0))
        cameras.append(syn.Camera(syn.pinhole(FOCAL, WIDTH, HEIGHT), R, t, WIDTH, HEIGHT))
    return cameras


def make_workspace(
    root: Path, *, names: list[str] = NAMES, origin: float = 0.0, tracks: bool = True, kind: str = "geometric"
) -> Workspace:
    """Pictures of noise, exact maps, and a model whose image ids are in the order of `names`."""
    plane = slanted_plane()
    cameras = cameras_above()
    rng = np.random.default_rng(0)
    sparse = syn.sample_sparse_points([plane], cameras, 100, rng)
    if not tracks:
        none = tuple(np.empty(0, np.int64) for _ in cameras)
        sparse = syn.SparsePoints(np.empty((0, 3)), tuple(np.empty((0, 2)) for _ in cameras), none)
    workspace = Workspace(root)
    workspace.create_stereo_dirs(names)
    workspace.images_dir.mkdir()
    syn.write_reconstruction(syn.build_reconstruction(names, cameras, sparse), workspace.sparse_dir)
    for name, camera in zip(names, cameras, strict=True):
        cv2.imwrite(str(workspace.image_path(name)), rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
        depth, normals, _ = syn.exact_geometry([plane], camera, origin=origin)
        write_maps(workspace, name, depth, normals, kind=kind)
    write_fusion_cfg(workspace.fusion_cfg_path, names)
    return workspace


def write_maps(workspace, name, depth=None, normals=None, *, kind="geometric"):
    if depth is not None:
        write_depth_map(workspace.depth_map_path(name, kind), depth.astype(np.float32))
    if normals is not None:
        write_normal_map(workspace.normal_map_path(name, kind), normals.astype(np.float32))


def stored_maps(workspace: Workspace) -> Callable[[str], DepthAndNormals]:
    """The geometric maps of a workspace, for `explain_losses`."""

    def maps_of(name: str) -> DepthAndNormals:
        depth, normals = (of(name, "geometric") for of in (workspace.depth_map_path, workspace.normal_map_path))
        return read_depth_map(depth), read_normal_planes(normals)

    return maps_of
