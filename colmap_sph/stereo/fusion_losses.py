"""Which of fusion's gates stops the pixels that do not become points: what to advise where the cloud is thin."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.scene import Scene, View, pixel_transfer
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.partners.pairs import overlapping_views

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
        Image name → its (H, W) depth and (3, H, W) normals. Asked for some images many times.
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
    counts = np.zeros(len(_Loss))
    for view in scene.views[:: -(-len(scene.views) // max_views)]:
        pixels = _sample_pixels(maps_of(view.name)[0], samples)
        losses = np.zeros((len(pixels[0]), len(_Loss)), dtype=int)
        for name in overlapping[view.name]:
            found = _losses_in(view, maps_of(view.name), scene.view(name), maps_of(name), pixels, options)
            losses += np.eye(len(_Loss), dtype=int)[found]
        enough = 1 + losses[:, _Loss.NONE] >= options.min_num_pixels
        gates = losses[:, _Loss.DEPTH : _Loss.NONE]
        failed = np.where(gates.any(axis=1), gates.argmax(axis=1) + _Loss.DEPTH, _Loss.UNSEEN)
        counts += np.bincount(np.where(enough, _Loss.NONE, failed), minlength=len(_Loss))
    return GateLosses(*(counts / max(counts.sum(), 1)))


class _Loss(IntEnum):
    """What keeps a partner from agreeing with a pixel, in the order of `GateLosses`."""

    UNSEEN = 0
    DEPTH = 1
    REPROJECTION = 2
    NORMAL = 3
    NONE = 4


# Of the codes that the kernel gives.
_LOSS_OF_GATE = np.array([_Loss.UNSEEN, _Loss.DEPTH, _Loss.NORMAL, _Loss.NONE])


def _sample_pixels(depth: NDArray[np.float32], samples: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Rows and columns of evenly spread pixels with a depth."""
    rows, columns = np.nonzero(depth > 0)
    chosen = np.linspace(0, len(rows) - 1, min(samples, len(rows))).astype(int)
    return rows[chosen].astype(np.int32), columns[chosen].astype(np.int32)


def _losses_in(
    view: View,
    maps: DepthAndNormals,
    partner: View,
    partner_maps: DepthAndNormals,
    pixels: tuple[NDArray[np.int32], NDArray[np.int32]],
    options: FusionOptions,
) -> NDArray[np.int64]:
    """(n,): what keeps a partner from agreeing with pixels of a view, as `_Loss`."""
    gate = np.empty(len(pixels[0]), np.uint8)
    distance = np.empty(len(pixels[0]), np.float32)
    _native.find_gates(
        *maps,
        *partner_maps,
        pixel_transfer(view, partner),
        view.R @ partner.R.T,
        options.max_depth_error,
        np.cos(np.radians(options.max_normal_error)),
        *pixels,
        gate,
        distance,
    )
    losses = _LOSS_OF_GATE[gate]
    if options.method == "colmap":  # for ours, what is farther away agrees all the same, as a point of its own
        losses[(losses > _Loss.DEPTH) & (distance > options.max_reproj_error)] = _Loss.REPROJECTION
    return losses
