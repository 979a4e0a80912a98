"""What the figures are made from: a finished `colmap_sph demo`, and its stages taken one at a time."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.pipeline.stages.pair_files import read_estimate
from colmap_sph.project.images.reading import read_colours, read_grey
from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import MapKind, Workspace
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.matching import MatchingOptions, match_pair
from colmap_sph.stereo.partners.pairs import PairOptions, PairSelection, select_pairs
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import (
    PairDisparity,
    RectifiedPair,
    Side,
    angles_of_columns,
    columns_of_angles,
    pixel_from_rectified_ray,
)
from colmap_sph.stereo.resampling import resample
from colmap_sph.stereo.search.seeds import Seeds, seeds_of_points, shared_points
from colmap_sph.synthetic import read_truth


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """A pair with its rectified images, the seeds of its sparse points and the disparity map of the left one."""

    left: View
    right: View
    geometry: RectifiedPair
    seeds: Seeds
    left_image: RectifiedImage
    right_image: RectifiedImage

    @cached_property
    def disparity(self) -> NDArray[np.float32]:
        """(H, W_left) pixels, NaN = none."""
        images = self.left_image, self.right_image
        least, most = self.geometry.min_disparity, self.geometry.max_disparity
        return match_pair(*images, least, most, MatchingOptions(), seeds=self.seeds)

    @property
    def as_voter(self) -> PairDisparity:
        """What the vote takes of the pair."""
        return PairDisparity(self.left.name, self.right.name, self.geometry, self.disparity)


@dataclass(frozen=True, eq=False)
class Demo:
    """The folder that ``colmap_sph demo --output`` made."""

    folder: Path

    @cached_property
    def workspace(self) -> Workspace:
        """Its dense workspace."""
        return Workspace(self.folder / "dense")

    @cached_property
    def scene(self) -> Scene:
        """The scene as a run works in it."""
        return anchored(read_scene(self.workspace.sparse_dir))

    @cached_property
    def selection(self) -> PairSelection:
        """Partners of every image, with default options."""
        return select_pairs(self.scene, PairOptions())

    def matched_with(self, name: str) -> list[str]:
        """Sorted names of the images that an image shares a pair with: its partners, and those it is one of."""
        return sorted({n for pair in self.selection.unique_pairs() if name in pair for n in pair} - {name})

    def picture(self, name: str) -> NDArray[np.uint8]:
        """(H, W, 3) red, green, blue."""
        bgr = read_colours(self.workspace.image_path(name))
        return np.ascontiguousarray(bgr[..., ::-1])

    def truth(self, name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Exact depth and normals at COLMAP's pixel origin."""
        return read_truth(self.folder / "truth" / f"{name}.npz")

    def maps(self, name: str, kind: MapKind) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depth and normals as the demo wrote them."""
        workspace = self.workspace
        depth = read_depth_map(workspace.depth_map_path(name, kind))
        return depth, read_normal_map(workspace.normal_map_path(name, kind))

    def voted(self, name: str) -> DepthEstimate:
        """The photometric depth with its standard deviation and support, before planes are fitted to it."""
        return read_estimate(self.workspace.photometric_dir / f"{name}.sph", self.scene.view(name))

    def rectified(self, left: str, right: str, options: RectificationOptions | None = None) -> MatchedPair:
        """Rectify a pair; its disparity map comes when it is asked for."""
        views = self.scene.view(left), self.scene.view(right)
        geometry = rectify_pair(self.scene, *views, options or RectificationOptions(columns="angles"))
        sides: tuple[Side, Side] = ("left", "right")
        images = (
            resample(read_grey(self.workspace.image_path(view.name)), view, geometry, side)
            for view, side in zip(views, sides, strict=True)
        )
        seeds = seeds_of_points(*views, geometry, shared_points(self.scene, *views))
        return MatchedPair(*views, geometry, seeds, *(RectifiedImage(*image) for image in images))

    def exact_disparity(self, pair: MatchedPair) -> NDArray[np.float64]:
        """Disparity of the left rectified pixels on the sphere, from the exact depth; NaN outside the image."""
        geometry = pair.geometry
        left = pair.left
        rays = sphere_rays(geometry, "left")
        pixel = rays @ pixel_from_rectified_ray(left, geometry).T
        with np.errstate(divide="ignore", invalid="ignore"):
            columns, rows = (pixel[..., k] / pixel[..., 2] for k in (0, 1))
        depth = cv2.remap(
            self.truth(left.name)[0],
            columns.astype(np.float32),
            rows.astype(np.float32),
            cv2.INTER_NEAREST,
            borderValue=0,
        )
        # A ray's depth in the camera is the third coordinate of its pixel.
        points = rays * (depth / pixel[..., 2])[..., None] - [geometry.baseline, 0, 0]
        angles = np.arctan2(points[..., 0], np.hypot(points[..., 1], points[..., 2]))
        right = columns_of_angles(angles, geometry.flatness)
        column = right * geometry.columns_per_radian - geometry.right_origin
        disparity = np.arange(geometry.left_width) - column
        return np.where((depth > 0) & (pair.left_image.valid > 0), disparity, np.nan)


def sphere_rays(geometry: RectifiedPair, side: Side) -> NDArray[np.float64]:
    """(H, W, 3) unit rays of a side's rectified pixels in the rectified frame."""
    along = (
        np.arange(geometry.width(side), dtype=np.float64) + geometry.column_origin(side)
    ) / geometry.columns_per_radian
    across = (np.arange(geometry.height) + geometry.row_origin) / geometry.rows_per_radian
    angles = angles_of_columns(along, geometry.flatness)
    sine, cosine = np.sin(angles), np.cos(angles)
    rays = (
        np.outer(np.ones_like(across), sine),
        np.outer(np.sin(across), cosine),
        np.outer(np.cos(across), cosine),
    )
    return np.stack(rays, axis=-1)
