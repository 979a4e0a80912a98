"""Dense workspace → fused cloud, by COLMAP's own fusion of the depth and normal maps.

COLMAP's default gates suit its own patch match; ours keep one point per surface element instead of merging
neighbours two pixels away, which thins a cloud several times.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.colmap_log import quiet_colmap
from colmap_sph.errors import OptionError, OutputError
from colmap_sph.scene import Scene, View
from colmap_sph.workspace import MapKind, Workspace, read_depth_map, read_normal_map

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class FusionOptions:
    """COLMAP's fusion options, under COLMAP's names, with defaults for our maps."""

    min_num_pixels: int = 2
    """Pixels, of different images, that must agree on a point (COLMAP: 5)."""
    max_num_pixels: int = 10000
    """Most pixels to merge into one point."""
    max_traversal_depth: int = 100
    """Longest chain of pixels, from image to image, that makes one point."""
    max_reproj_error: float = 0.5
    """Pixels within this distance of a point's projection are merged into it (COLMAP: 2)."""
    max_depth_error: float = 0.01
    """Largest relative difference of depths that agree."""
    max_normal_error: float = 30.0
    """Largest angle, degrees, of normals that agree (COLMAP: 10)."""
    check_num_images: int = 50
    """Overlapping images to look for agreement in."""
    mask_path: Path | None = None
    """Folder of NAME.png masks in undistorted geometry, black = excluded."""
    use_cache: bool = False
    """Keep only part of the maps in memory, `cache_size` of them."""
    cache_size: float = 32.0
    """Gigabytes of maps to keep in memory with `use_cache`."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        for name in ("min_num_pixels", "max_num_pixels", "max_traversal_depth", "check_num_images"):
            if getattr(self, name) < 1:
                raise OptionError(f"fusion {name} must be at least 1, not {getattr(self, name)}.")
        if self.max_num_pixels < self.min_num_pixels:
            raise OptionError(
                f"fusion max_num_pixels ({self.max_num_pixels}) must not be less than "
                f"min_num_pixels ({self.min_num_pixels})."
            )
        for name in ("max_reproj_error", "max_depth_error", "max_normal_error", "cache_size"):
            if not getattr(self, name) > 0:
                raise OptionError(f"fusion {name} must be positive, not {getattr(self, name)}.")
        if self.mask_path is not None and not self.mask_path.is_dir():
            raise OptionError(f"the fusion mask folder {self.mask_path} does not exist.")


@dataclass(frozen=True)
class GateLosses:
    """Why sampled depth map pixels did not become points: shares of the sampled pixels, 0 to 1.

    Attributes
    ----------
    unseen : float
        No other image has the point in view with a depth there.
    depth, reprojection, normal : float
        The gate that most often stopped the agreement of a pixel which finds too few others.
    kept : float
        Enough other pixels agree.
    """

    unseen: float
    depth: float
    reprojection: float
    normal: float
    kept: float

    def sentence(self) -> str:
        """What a user should know of it."""
        gates = {
            "max_depth_error": self.depth,
            "max_reproj_error": self.reprojection,
            "max_normal_error": self.normal,
        }
        worst = max(gates, key=lambda name: gates[name])
        return (
            f"Of the pixels with a depth {self.kept:.0%} find enough agreeing pixels, {self.unseen:.0%} are seen "
            f"by no other depth map, and the rest fail the gates of depth ({self.depth:.0%}), reprojection "
            f"({self.reprojection:.0%}) and normal ({self.normal:.0%}); loosen {worst} or min_num_pixels first."
        )


def fuse(workspace: Workspace, options: FusionOptions, *, threads: int = -1, kind: MapKind = "geometric") -> int:
    """Fuse the workspace's maps with COLMAP's `stereo_fusion` into ``fused.ply`` and ``fused.ply.vis``.

    Parameters
    ----------
    workspace : Workspace
        With images, model, maps and ``fusion.cfg``.
    options : FusionOptions
    threads : int
        Threads of COLMAP's fusion; -1: all cores.
    kind : {"geometric", "photometric"}
        Which maps to fuse.

    Returns
    -------
    int
        Number of points.

    Raises
    ------
    OutputError
        The cloud cannot be written.
    """
    colmap_options = pycolmap.StereoFusionOptions()
    for name in FusionOptions.__dataclass_fields__:
        value = getattr(options, name)
        if name != "mask_path" or value is not None:
            setattr(colmap_options, name, value)
    colmap_options.num_threads = threads
    # COLMAP derives the name of the visibility file from the cloud's: both go to temporary names first.
    temporary = workspace.state_dir / "fused.ply"
    visibility = temporary.with_name(temporary.name + ".vis")
    try:
        with quiet_colmap():
            cloud = pycolmap.stereo_fusion(
                temporary, workspace.root, input_type=kind, options=colmap_options, output_type="PLY"
            )
        temporary.replace(workspace.fused_path)
        visibility.replace(workspace.fused_path.with_name(workspace.fused_path.name + ".vis"))
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(
            f"COLMAP's fusion of {workspace.root} failed ({error}); check space and permissions."
        ) from error
    return int(cloud.num_points3D())


def explain_losses(
    workspace: Workspace,
    scene: Scene,
    options: FusionOptions,
    *,
    kind: MapKind = "geometric",
    samples: int = 2000,
    max_views: int = 30,
) -> GateLosses:
    """Find which of fusion's gates stops a sample of depth map pixels.

    Every sampled pixel is projected into the other views, as COLMAP's fusion does for the first pixel of a
    point; a pixel that too few others confirm is charged to the gate that most of its comparisons failed.

    Parameters
    ----------
    workspace : Workspace
    scene : Scene
    options : FusionOptions
    kind : {"geometric", "photometric"}
    samples : int
        Pixels per view.
    max_views : int
        Views to sample, evenly spread.

    Returns
    -------
    GateLosses
    """
    maps = {
        view.name: (
            read_depth_map(workspace.depth_map_path(view.name, kind)),
            read_normal_map(workspace.normal_map_path(view.name, kind)),
        )
        for view in scene.views[:: max(1, len(scene.views) // max_views)]
    }
    views = [view for view in scene.views if view.name in maps]
    counts = np.zeros(5)
    for view in views:
        points, normals = _sample_points(view, *maps[view.name], samples)
        verdicts = np.stack(
            [_verdicts(points, normals, other, *maps[other.name], options) for other in views if other is not view]
            or [np.zeros((len(points), 4), dtype=bool)]
        ).sum(axis=0)
        enough = 1 + verdicts[:, 3] >= options.min_num_pixels
        failed = np.where(verdicts[:, :3].any(axis=1), verdicts[:, :3].argmax(axis=1) + 1, 0)
        counts += np.bincount(np.where(enough, 4, failed), minlength=5)
    return GateLosses(*(counts / max(counts.sum(), 1)))


def _sample_points(
    view: View, depth: NDArray[np.float32], normals: NDArray[np.float32], samples: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World points and world normals of evenly spread pixels with a depth."""
    rows, columns = np.nonzero(depth > 0)
    chosen = np.linspace(0, len(rows) - 1, min(samples, len(rows))).astype(int)
    rows, columns = rows[chosen], columns[chosen]
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=1) @ np.linalg.inv(view.K).T
    points = (rays * depth[rows, columns, None] - view.t) @ view.R
    return points, normals[rows, columns] @ view.R


def _verdicts(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    view: View,
    depth: NDArray[np.float32],
    view_normals: NDArray[np.float32],
    options: FusionOptions,
) -> NDArray[np.bool_]:
    """(n, 4): stopped by depth, by reprojection, by normal; agrees. All false where the view has no depth."""
    in_camera = points @ view.R.T + view.t
    pixel = in_camera @ view.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = pixel[:, :2] / pixel[:, 2:]
    inside = (pixel[:, 2] > 0) & (uv > -0.5).all(axis=1)
    inside &= (uv < np.array([view.width, view.height]) - 0.5).all(axis=1)
    columns, rows = (np.rint(np.where(inside[:, None], uv, 0)).astype(int)).T
    z = depth[rows, columns].astype(np.float64)
    seen = inside & (z > 0)
    far = seen & (np.abs(in_camera[:, 2] - z) > options.max_depth_error * z)
    off = seen & ~far & (np.hypot(*(uv - np.stack([columns, rows], axis=1)).T) > options.max_reproj_error)
    cosine = (normals * (view_normals[rows, columns] @ view.R)).sum(axis=1)
    turned = seen & ~far & ~off & (cosine < np.cos(np.radians(options.max_normal_error)))
    return np.stack([far, off, turned, seen & ~far & ~off & ~turned], axis=1)
