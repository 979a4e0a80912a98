"""Which of fusion's gates stops the pixels that do not become points: what to advise where the cloud is thin."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Scene, View
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.pairs import overlapping_views

DepthAndNormals = tuple[NDArray[np.float32], NDArray[np.float32]]

# Partners of a view to look at.
_EXPLAINED_PARTNERS = 20


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
            "--fusion.max-depth-error": self.depth,
            "--fusion.max-reproj-error": self.reprojection,
            "--fusion.max-normal-error": self.normal,
        }
        worst = max(gates, key=lambda name: gates[name])
        remedy = f"loosen {worst} or --fusion.min-num-pixels first"
        if self.unseen > sum(gates.values()):
            remedy = "check the poses, or try --fusion.input photometric, whose maps cover more"
        return (
            f"Of the pixels with a depth {self.kept:.0%} find enough agreeing pixels, {self.unseen:.0%} are seen "
            f"by no other depth map, and the rest fail the gates of depth ({self.depth:.0%}), reprojection "
            f"({self.reprojection:.0%}) and normal ({self.normal:.0%}); {remedy}."
        )


def explain_losses(
    maps_of: Callable[[str], DepthAndNormals],
    scene: Scene,
    options: FusionOptions,
    *,
    samples: int = 2000,
    max_views: int = 10,
) -> GateLosses:
    """Find which of fusion's gates stops a sample of depth map pixels.

    Every sampled pixel is projected into the views that share most points with its own, as COLMAP's fusion does
    for the first pixel of a point; a pixel that too few others confirm is charged to the gate that most of its
    comparisons failed.

    Parameters
    ----------
    maps_of : callable
        Image name → its (H, W) depth and (H, W, 3) normals. Asked for some images many times.
    scene : Scene
        Views with maps.
    options : FusionOptions
    samples : int
        Pixels per view.
    max_views : int
        Views to sample, evenly spread.

    Returns
    -------
    GateLosses
    """
    overlapping = overlapping_views(scene, min(options.check_num_images, _EXPLAINED_PARTNERS))
    counts = np.zeros(5)
    for view in scene.views[:: -(-len(scene.views) // max_views)]:
        points, normals = _sample_points(view, *maps_of(view.name), samples)
        verdicts = np.zeros((len(points), 4), dtype=int)
        for name in overlapping[view.name]:
            verdicts += _verdicts(points, normals, scene.view(name), *maps_of(name), options)
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
    pixels, distance = view.project(points)
    # Depth maps count integer pixels, the first one 0: a point is inside where the pixel next to it is in the map.
    last = np.array([view.width, view.height]) - 0.5
    inside = (distance > 0) & (pixels > -0.5).all(axis=1) & (pixels < last).all(axis=1)
    columns, rows = (np.rint(np.where(inside[:, None], pixels, 0)).astype(int)).T
    z = depth[rows, columns].astype(np.float64)
    seen = inside & (z > 0)
    far = seen & (np.abs(distance - z) > options.max_depth_error * z)
    off = seen & ~far & (np.hypot(*(pixels - np.stack([columns, rows], axis=1)).T) > options.max_reproj_error)
    if options.method != "colmap":  # what is farther away agrees all the same, and becomes a point of its own
        off[:] = False
    cosine = (normals * (view_normals[rows, columns] @ view.R)).sum(axis=1)
    turned = seen & ~far & ~off & (cosine < np.cos(np.radians(options.max_normal_error)))
    return np.stack([far, off, turned, seen & ~far & ~off & ~turned], axis=1)
