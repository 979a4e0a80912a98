"""Blocks of any number of small vertical images over flat ground: dense workspaces with exact tracks, few or none.

Besides blocks of strips there are one long strip, and images that all see the same. Their images are crops of one
texture, so that they can be matched; poses, points and observations are exact. Names are in the order of the
flight, there and back, as cameras number them.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

LAYOUTS = ("block", "strip", "place")
WIDTH = 64
HEIGHT = 48
_FOCAL = 55.0
# Metres: height above ground; between exposures along a strip, and between strips (about 70 % and 65 % overlap).
_ALTITUDE = 100.0
_STEP = np.array([35.0, 31.0])
# Of the images in which a point lies so many find it; a track has three at least.
_FOUND = 0.6
_SHORTEST = 3
# Images on either side in which a point may lie.
_REACH = 3
# Where all images see the same, so many find a point.
_LONGEST = 20
_TEXTURE_SIDE = 2048
_TEXTURE_METRES = 2400.0
_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_ELEMENT = np.dtype([("image", "<u4"), ("place", "<u4")])


@dataclass(frozen=True)
class Block:
    """A block of images.

    Attributes
    ----------
    centres : (n, 3) float64 ndarray
        Where the cameras are, metres; they look down, with x along the image's columns.
    points : (m, 3) float64 ndarray
        Sparse points.
    image, point : (k,) int64 ndarray
        Of every observation, the image, ascending, and the point.
    xy : (k, 2) float64 ndarray
        Image coordinates of every observation.
    """

    centres: NDArray[np.float64]
    points: NDArray[np.float64]
    image: NDArray[np.int64]
    point: NDArray[np.int64]
    xy: NDArray[np.float64]

    def name(self, index: int) -> str:
        """File name of an image."""
        return f"DJI_{index + 1:06d}.jpg"


def make_block(images: int, observations: int, layout: str = "block") -> Block:
    """Lay out images.

    Parameters
    ----------
    images : int
    observations : int
        Of sparse points by each image, on average; the model has no points where that is 0.
    layout : "block", "strip" or "place"
        A block that is about square; one long strip; or images from one place, all of which see the same.
    """
    rng = np.random.default_rng(images)
    if layout == "place":
        return _make_place(images, observations, rng)
    columns = images if layout == "strip" else max(round((images * _STEP[1] / _STEP[0]) ** 0.5), 1)
    strips = np.arange(images) // columns
    places = np.arange(images) % columns
    places = np.where(strips % 2, columns - 1 - places, places)
    centres = np.column_stack([places * _STEP[0], strips * _STEP[1], np.full(images, _ALTITUDE)])
    per_point = _FOUND * np.prod(_ALTITUDE / _FOCAL * np.array([WIDTH, HEIGHT]) / _STEP)
    extent = centres[:, :2].max(axis=0) + _STEP
    share = images * np.prod(_STEP) / np.prod(extent)  # the last strip may be short
    ground = rng.uniform(-_STEP / 2, extent - _STEP / 2, (int(images * observations / per_point / share), 2))
    points = np.column_stack([ground, np.zeros(len(ground))])
    index_at = np.full((strips.max() + 1, columns), -1)
    index_at[strips, places] = np.arange(images)
    return _sorted(centres, points, *_observed(points, centres, index_at, rng))


def _make_place(images: int, observations: int, rng: np.random.Generator) -> Block:
    """Each point is found by the images that are nearest to some place."""
    from scipy.spatial import cKDTree

    centres = np.column_stack([rng.uniform(-_STEP / 2, _STEP / 2, (images, 2)), np.full(images, _ALTITUDE)])
    longest = min(_LONGEST, images)
    number = images * observations // longest
    points = np.column_stack([rng.uniform(-_STEP / 2, _STEP / 2, (number, 2)), np.zeros(number)])
    found = cKDTree(centres[:, :2]).query(rng.uniform(-_STEP / 2, _STEP / 2, (number, 2)), k=longest)[1]
    image, point = found.ravel(), np.repeat(np.arange(number), longest)
    return _sorted(centres, points, image, point, _project(points[point], centres[image]))


def _sorted(
    centres: NDArray[np.float64],
    points: NDArray[np.float64],
    image: NDArray[np.int64],
    point: NDArray[np.int64],
    xy: NDArray[np.float64],
) -> Block:
    """Leave out points that few images find, and sort observations."""
    long_enough = np.bincount(point, minlength=len(points)) >= _SHORTEST
    kept = long_enough[point]
    number = np.cumsum(long_enough) - 1
    image, point, xy = image[kept], number[point[kept]], xy[kept]
    order = np.lexsort((point, image))
    return Block(centres, points[long_enough], image[order], point[order], xy[order])


def _observed(
    points: NDArray[np.float64],
    centres: NDArray[np.float64],
    index_at: NDArray[np.int64],
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    nearest = np.rint(points[:, :2] / _STEP).astype(np.int64)
    found = []
    for down in range(-_REACH, _REACH + 1):
        for right in range(-_REACH, _REACH + 1):
            column, strip = (nearest + np.array([right, down])).T
            there = (column >= 0) & (strip >= 0) & (column < index_at.shape[1]) & (strip < index_at.shape[0])
            rows = np.flatnonzero(there)
            image = index_at[strip[rows], column[rows]]
            rows, image = rows[image >= 0], image[image >= 0]
            xy = _project(points[rows], centres[image])
            seen = ((xy > 0) & (xy < [WIDTH, HEIGHT])).all(axis=1) & (rng.random(len(rows)) < _FOUND)
            found.append((image[seen], rows[seen], xy[seen]))
    image, point, xy = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return image, point, xy


def _project(points: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cameras look down with x along the world's and y against it."""
    beside = (points - centres)[:, :2] * [1.0, -1.0]
    return np.asarray(_FOCAL * beside / _ALTITUDE + [WIDTH / 2, HEIGHT / 2])


def write_workspace(block: Block, folder: Path) -> None:
    """Write a dense workspace as COLMAP's ``image_undistorter`` leaves it: images and model."""
    (folder / "images").mkdir(parents=True)
    (folder / "sparse").mkdir()
    (folder / "stereo").mkdir()
    _write_images(block, folder / "images")
    write_model(block, folder / "sparse")


def _write_images(block: Block, folder: Path) -> None:
    texture = _texture()
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    scale = _TEXTURE_SIDE / _TEXTURE_METRES
    right = (columns - WIDTH / 2) * _ALTITUDE / _FOCAL * scale
    down = (rows - HEIGHT / 2) * _ALTITUDE / _FOCAL * scale
    for index, centre in enumerate(block.centres):
        x = np.mod(right + scale * centre[0], _TEXTURE_SIDE).astype(np.float32)
        y = np.mod(down - scale * centre[1], _TEXTURE_SIDE).astype(np.float32)
        crop = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        cv2.imwrite(str(folder / block.name(index)), crop, [cv2.IMWRITE_JPEG_QUALITY, 95])


def _texture() -> NDArray[np.uint8]:
    """Noise of many sizes, which repeats without a seam."""
    rng = np.random.default_rng(1)
    spectrum = np.fft.rfft2(rng.standard_normal((_TEXTURE_SIDE, _TEXTURE_SIDE, 3)), axes=(0, 1))
    down = np.fft.fftfreq(_TEXTURE_SIDE)[:, None]
    right = np.fft.rfftfreq(_TEXTURE_SIDE)
    distance = np.hypot(down, right) + 1 / _TEXTURE_SIDE
    spectrum *= (np.exp(-((distance / 0.2) ** 2)) / distance)[..., None]
    noise = np.fft.irfft2(spectrum, s=(_TEXTURE_SIDE, _TEXTURE_SIDE), axes=(0, 1))
    return np.asarray(np.clip(127 + 45 * noise / noise.std(), 0, 255), dtype=np.uint8)


def write_model(block: Block, folder: Path) -> None:
    """Write COLMAP's binary model, of one PINHOLE camera."""
    with (folder / "cameras.bin").open("wb") as file:
        np.array([1], "<u8").tofile(file)
        np.array([1, 1], "<i4").tofile(file)  # number; PINHOLE
        np.array([WIDTH, HEIGHT], "<u8").tofile(file)
        np.array([_FOCAL, _FOCAL, WIDTH / 2, HEIGHT / 2], "<f8").tofile(file)
    _write_poses(block, folder / "images.bin")
    _write_points(block, folder / "points3D.bin")


def _write_poses(block: Block, path: Path) -> None:
    observations = np.empty(len(block.point), _POINT2D)
    observations["xy"] = block.xy
    observations["point"] = block.point + 1
    first = np.searchsorted(block.image, np.arange(len(block.centres) + 1))
    rotation = np.array([0.0, 1.0, 0.0, 0.0])  # half a turn about x
    with path.open("wb") as file:
        file.write(np.uint64(len(block.centres)).tobytes())
        for index, (x, y, z) in enumerate(block.centres):
            file.write(np.uint32(index + 1).tobytes())
            file.write(np.concatenate([rotation, [-x, y, z]]).tobytes())
            file.write(np.uint32(1).tobytes() + block.name(index).encode() + b"\0")
            mine = observations[first[index] : first[index + 1]]
            file.write(np.uint64(len(mine)).tobytes() + mine.tobytes())


def _write_points(block: Block, path: Path) -> None:
    first = np.searchsorted(block.image, np.arange(len(block.centres) + 1))
    elements = np.empty(len(block.point), _ELEMENT)
    elements["image"] = block.image + 1
    elements["place"] = np.arange(len(block.point)) - first[block.image]
    order = np.argsort(block.point, kind="stable")
    elements = elements[order]
    start = np.searchsorted(block.point[order], np.arange(len(block.points) + 1))
    head = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
    heads = np.zeros(len(block.points), head)
    heads["id"] = np.arange(len(block.points)) + 1
    heads["xyz"] = block.points
    heads["rgb"] = 128
    heads["length"] = np.diff(start)
    with path.open("wb") as file:
        file.write(np.uint64(len(block.points)).tobytes())
        for index in range(len(block.points)):
            file.write(heads[index].tobytes() + elements[start[index] : start[index + 1]].tobytes())


def main() -> None:
    """Write a workspace."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("images", type=int)
    parser.add_argument("observations", type=int)
    parser.add_argument("layout", choices=LAYOUTS, nargs="?", default="block")
    arguments = parser.parse_args()
    block = make_block(arguments.images, arguments.observations, arguments.layout)
    write_workspace(block, arguments.folder)


if __name__ == "__main__":
    main()
