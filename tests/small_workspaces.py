"""Finished dense workspaces without a run: a flat ground seen from above, in files as COLMAP has them."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from colmap_sph.project.map_files import write_depth_map, write_normal_map
from colmap_sph.project.workspace import Workspace

WIDTH, HEIGHT, FOCAL = 160, 120, 100.0
ALTITUDE, SPACING = 50.0, 20.0
# x right, y down in the image; z of the world is up.
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])


def ground_workspace(root: Path, names: Sequence[str], *, report: Mapping[str, Any] | None = None) -> Workspace:
    """Images in a row above the plane z = 0, `SPACING` apart along x, whose maps cover all but their first rows.

    The upper 20 rows have no depth at all, the next 20 a photometric one only. A point of the cloud stands for
    every 25th pixel with a geometric depth. Without a `report` it is as if no run had come to its end.
    """
    workspace = Workspace(root)
    workspace.sparse_dir.mkdir(parents=True)
    workspace.create_stereo_dirs(names)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    )
    model.add_camera_with_trivial_rig(camera)
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (400, 2000, 3), dtype=np.uint8), (0, 0), 2)
    points = []
    for number, name in enumerate(names):
        center = np.array([number * SPACING, 0.0, ALTITUDE])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(LOOKING_DOWN), -LOOKING_DOWN @ center)
        model.add_image_with_trivial_frame(pycolmap.Image(name, np.empty((0, 2)), 1, number + 1), pose)
        shift = int(number * SPACING * FOCAL / ALTITUDE) % 1800
        path = workspace.image_path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".png", texture[:HEIGHT, shift : shift + WIDTH])[1].tobytes())
        points.append(_write_maps(workspace, name, center))
    model.write_binary(workspace.sparse_dir)
    write_cloud(workspace.fused_path, np.vstack(points))
    workspace.state_dir.mkdir(exist_ok=True)
    if report is not None:
        workspace.report_path.write_text(json.dumps(dict(report)))
    return workspace


def _write_maps(workspace: Workspace, name: str, center: np.ndarray) -> np.ndarray:
    depth = np.full((HEIGHT, WIDTH), ALTITUDE, np.float32)
    depth[:20] = 0
    write_depth_map(workspace.depth_map_path(name, "photometric"), depth)
    depth[:40] = 0
    write_depth_map(workspace.depth_map_path(name, "geometric"), depth)
    normals = np.where(depth[..., None] > 0, np.array([0, 0, -1], np.float32), np.float32(0))
    write_normal_map(workspace.normal_map_path(name, "geometric"), normals)
    rows, columns = np.mgrid[40:HEIGHT:5, 0:WIDTH:5]
    x = center[0] + (columns - WIDTH / 2) * ALTITUDE / FOCAL
    y = center[1] - (rows - HEIGHT / 2) * ALTITUDE / FOCAL
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


def write_cloud(path: Path, points: np.ndarray, colours: np.ndarray | None = None) -> None:
    """A PLY file as COLMAP's fusion writes it; green where no (n, 3) uint8 `colours` are given."""
    kind = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    cloud = np.zeros(len(points), kind)
    cloud["xyz"] = points
    cloud["rgb"] = (40, 160, 60) if colours is None else colours
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + cloud.tobytes())


HOSTILE_NAMES = [
    "</script><script>document.title='taken'</script>.png",
    '"onmouseover="document.title=1" x=".png',
    "'--><img src=x onerror=document.title=1>.png",
    "{{ 7 * 7 }} &lt;b&gt; \u202egnp.exe.png",
    "日本/Köln\u2028 \x1b]0;taken\x07.png",
]
"""Names of images that a page must show, and do nothing of what they say."""
