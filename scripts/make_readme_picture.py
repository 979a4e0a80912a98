"""The picture in the README: image, depth, normals and fused cloud of a demo block.

    colmap_sph demo --output /tmp/demo
    python scripts/make_readme_picture.py /tmp/demo docs/demo.png

Black in the depth and normal map: no depth.
"""

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.workspace import Workspace
from colmap_sph.synthetic import Camera, look_at, pinhole

Picture = NDArray[np.uint8]

IMAGE = "N_0_2.jpg"
PANEL = (264, 198)
CLOUD = (740, 3 * PANEL[1] + 12)
GAP = 6
SUPERSAMPLE = 2
# Half the size in metres of the ground below the vertical images.
EXTENT = (50.0, 42.0)
# The last bits of a texture's colour cost three quarters of a PNG and are not seen.
COLOUR_STEP = 16


def without_last_bits(picture: Picture) -> Picture:
    """Colours in steps of `COLOUR_STEP`, white still white."""
    steps = picture.astype(np.float32) // COLOUR_STEP
    return np.asarray(steps * (255 / (255 // COLOUR_STEP)), dtype=np.uint8)


def depth_picture(depth: NDArray[np.float32]) -> Picture:
    """Near is bright; no depth is black."""
    low, high = np.percentile(depth[depth > 0], (1, 99))
    grey = np.clip(255 * (high - depth) / (high - low), 0, 255).astype(np.uint8)
    picture = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)
    picture[depth <= 0] = 0
    return np.asarray(picture, dtype=np.uint8)


def normal_picture(normals: NDArray[np.float32]) -> Picture:
    """Red right, green up, blue towards the camera; no normal is black."""
    picture = np.clip(127.5 + 127.5 * normals * (1, -1, -1), 0, 255).astype(np.uint8)
    picture[~normals.any(axis=-1)] = 0
    return np.ascontiguousarray(picture[..., ::-1])


def cloud_picture(cloud: Any, width: int, height: int) -> Picture:
    """The coloured cloud from the air, on white, with hidden points hidden."""
    size = (SUPERSAMPLE * width, SUPERSAMPLE * height)
    R, t = look_at((30.0, -94.0, 92.0), (0.0, 1.0, 0.0))
    camera = Camera(pinhole(1.18 * size[0], *size), R, t, *size)
    near_middle = (np.abs(cloud.vertices[:, :2]) < EXTENT).all(axis=1)
    image, depth = camera.project(np.asarray(cloud.vertices)[near_middle])
    column, row = np.floor(image).astype(np.int64).T
    far_first = np.argsort(-depth)
    picture = np.full((size[1], size[0], 3), 255, dtype=np.uint8)
    colours = np.asarray(cloud.visual.vertex_colors)[near_middle][far_first, 2::-1]
    offsets = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    # All nine pixels of a point before the next, nearer point: the last one written stays.
    columns = np.stack([column[far_first] + x for x, _ in offsets], axis=1).ravel()
    rows = np.stack([row[far_first] + y for _, y in offsets], axis=1).ravel()
    inside = (columns >= 0) & (columns < size[0]) & (rows >= 0) & (rows < size[1])
    picture[rows[inside], columns[inside]] = np.repeat(colours, len(offsets), axis=0)[inside]
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return without_last_bits(np.asarray(small, dtype=np.uint8))


def main() -> None:
    """Compose the panels: three small ones above each other, the cloud beside them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path, help="output folder of `colmap_sph demo`")
    parser.add_argument("picture", type=Path, help="PNG to write")
    arguments = parser.parse_args()
    workspace = Workspace(arguments.demo / "dense")
    panels = [
        np.asarray(cv2.imread(str(workspace.image_path(IMAGE))), dtype=np.uint8),
        depth_picture(read_depth_map(workspace.depth_map_path(IMAGE, "geometric"))),
        normal_picture(read_normal_map(workspace.normal_map_path(IMAGE, "geometric"))),
    ]
    cloud = trimesh.load(workspace.fused_path)
    page = np.full((CLOUD[1], PANEL[0] + GAP + CLOUD[0], 3), 255, dtype=np.uint8)
    for number, panel in enumerate(panels):
        top = number * (PANEL[1] + GAP)
        small = np.asarray(cv2.resize(panel, PANEL, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        page[top : top + PANEL[1], : PANEL[0]] = small if number else without_last_bits(small)
    page[:, PANEL[0] + GAP :] = cloud_picture(cloud, *CLOUD)
    cv2.imwrite(str(arguments.picture), page, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
