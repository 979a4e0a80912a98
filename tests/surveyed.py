"""A dense workspace of a box on level ground, with exact maps: its roof is red, its walls are blue, and the ground
is green."""

import functools
from pathlib import Path

import cv2
import numpy as np

from colmap_sph import synthetic as syn
from colmap_sph.project.map_files import write_depth_map, write_normal_map
from colmap_sph.project.workspace import Workspace

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
ALTITUDE = 30.0
GSD = ALTITUDE / FOCAL
ROOF = 4.0
BOX = np.array([[-4.0, -3.0], [4.0, 3.0]])
RED, GREEN, BLUE = (200, 40, 40), (40, 160, 60), (30, 60, 220)
STONE = syn.Mottled(syn.Noise(0.5, seed=1))


def surfaces() -> list[syn.Surface]:
    middle, size = BOX.mean(axis=0), BOX[1] - BOX[0]
    ground = syn.Plane((0, 0, 0), (0, 0, 1), STONE)
    return [ground, syn.box((*middle, 0.0), (size[0], size[1], ROOF), [STONE])]


def cameras() -> list[syn.Camera]:
    """Nine looking down in a grid, and four from the sides."""
    places = [((x, y, ALTITUDE), (x, y, 0.0), (0, 1, 0)) for x in (-8.0, 0.0, 8.0) for y in (-6.0, 0.0, 6.0)]
    for x, y in ((30.0, 0.0), (-30.0, 0.0), (0.0, 30.0), (0.0, -30.0)):
        places.append(((x, y, ALTITUDE), (0.0, 0.0, 1.0), (0, 0, 1)))
    made = []
    for eye, target, up in places:
        R, t = syn.look_at(eye, target, up=up)
        made.append(syn.Camera(syn.pinhole(FOCAL, WIDTH, HEIGHT), R, t, WIDTH, HEIGHT))
    return made


def picture(camera: syn.Camera, scene: list[syn.Surface]) -> np.ndarray:
    """(H, W, 3) red, green and blue."""
    depth, _, _ = syn.exact_geometry(scene, camera, origin=0.5)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K).T
    height = ((rays * depth[..., None] - camera.t) @ camera.R)[..., 2]
    colours = np.empty((HEIGHT, WIDTH, 3))
    colours[:] = BLUE
    colours[height > ROOF - 1e-3] = RED
    colours[height < 1e-3] = GREEN
    return colours


@functools.cache
def rendered() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Picture, depth and normals of each camera."""
    scene = surfaces()
    return [(picture(each, scene), *syn.exact_geometry(scene, each, origin=0.0)[:2]) for each in cameras()]


def surveyed_workspace(
    root: Path,
    *,
    turn: np.ndarray | None = None,
    shift: np.ndarray | None = None,
    brightness: dict[int, float] | None = None,
    noise: float = 0.0,
) -> Workspace:
    """Exact maps and a model, turned and shifted as asked; depths in error by so many pixels on the ground."""
    scene, taken = surfaces(), cameras()
    names = [f"{number:02d}.png" for number in range(len(taken))]
    rng = np.random.default_rng(0)
    workspace = Workspace(root)
    workspace.create_stereo_dirs(names)
    workspace.images_dir.mkdir()
    for number, (name, (rgb, depth, normals)) in enumerate(zip(names, rendered(), strict=True)):
        seen = np.clip(rgb * (brightness or {}).get(number, 1.0), 0, 255).astype(np.uint8)
        cv2.imwrite(str(workspace.image_path(name)), seen[..., ::-1])
        depth = depth + noise * GSD * rng.standard_normal(depth.shape)
        write_depth_map(workspace.depth_map_path(name, "geometric"), depth.astype(np.float32))
        write_normal_map(workspace.normal_map_path(name, "geometric"), normals.astype(np.float32))
    sparse = syn.sample_sparse_points(scene, taken, 300, rng)
    turn = np.eye(3) if turn is None else turn
    shift = np.zeros(3) if shift is None else shift
    moved = [
        syn.Camera(each.K, each.R @ turn.T, each.t - each.R @ turn.T @ shift, each.width, each.height)
        for each in taken
    ]
    points = syn.SparsePoints(sparse.points @ turn.T + shift, sparse.observations, sparse.point_indices)
    syn.write_reconstruction(syn.build_reconstruction(names, moved, points), workspace.sparse_dir)
    return workspace
