"""Which of fusion's gates stops the pixels that do not become points: what to advise where the cloud is thin."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import percent
from colmap_sph.scene import Scene, View, pixel_transfer
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.partners.pairs import overlapping_views
from colmap_sph.stereo.partners.stations import OWN_STATION

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
    few : float
        All that have it agree, but they are fewer than must.
    depth, reprojection, normal : float
        The gate that most often stopped the agreement of a pixel which finds too few others.
    kept : float
        Enough other pixels agree.
    """

    unseen: float
    few: float
    depth: float
    reprojection: float
    normal: float
    kept: float

    def sentence(self, options: FusionOptions, *, poses_fit: bool = False, lacking: str = "") -> str:
        """What a user should know of it.

        Parameters
        ----------
        options : FusionOptions
            Those of the fusion.
        poses_fit : bool
            Whether the depth maps are known to agree with the sparse points, so that the poses are none to blame.
        lacking : str
            How many images are without maps, where most are, and why; else empty.
        """
        shares = (self.kept, self.unseen, self.few, self.depth, self.reprojection, self.normal)
        kept, unseen, few, depth, reprojection, normal = (percent(share, 0) for share in shares)
        return (
            f"Of the pixels with a depth {kept} find enough agreeing pixels, {unseen} are seen by no other depth "
            f"map, {few} by too few that agree, and the rest fail the gates of depth ({depth}), reprojection "
            f"({reprojection}) and normal ({normal}); "
            f"{self._remedy(options, poses_fit, lacking)}."
        )

    def _remedy(self, options: FusionOptions, poses_fit: bool, lacking: str) -> str:
        gates = {
            "--fusion.max-depth-error": self.depth,
            "--fusion.max-reproj-error": self.reprojection,
            "--fusion.max-normal-error": self.normal,
        }
        if lacking and self.few + self.unseen > sum(gates.values()):
            return f"mend first what left {lacking}"
        if self.few >= max(self.unseen, sum(gates.values())):
            return f"lower --fusion.min-num-pixels, which is {options.min_num_pixels}"
        if self.unseen <= sum(gates.values()):
            worst = max(gates, key=lambda name: gates[name])
            return f"loosen {worst} or --fusion.min-num-pixels first"
        remedies = [] if poses_fit else ["check the poses"]
        if options.input == "geometric":
            remedies.append("try --fusion.input photometric, whose maps cover more")
        return ", or ".join(remedies) or "add images that see the same, or give --fusion.min-num-pixels 1"


def explain_losses(
    maps_of: Callable[[str], DepthAndNormals],
    scene: Scene,
    options: FusionOptions,
    *,
    partners: Mapping[str, tuple[Sequence[str], Sequence[int]]] | None = None,
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
        Image name → its (H, W) depth and (3, H, W) normals. Asked for some images many times; those of two are in
        use at a time.
    scene : Scene
        Views with maps.
    options : FusionOptions
    partners : mapping, optional
        For each view those that it was fused with, and the numbers of their stations (see `Stations`). Without it
        those that share most points with it, each a station of its own.
    samples : int
        Pixels per view.
    max_views : int
        Views to sample, evenly spread.

    Returns
    -------
    GateLosses
    """
    most = min(options.check_num_images, max(_EXPLAINED_PARTNERS, 2 * options.min_num_pixels))
    if partners is None:
        partners = {name: (o, range(1, 1 + len(o))) for name, o in overlapping_views(scene, most).items()}
    counts = np.zeros(len(_Loss))
    for view in scene.views[:: -(-len(scene.views) // max_views)]:
        maps = maps_of(view.name)
        pixels = _sample_pixels(maps[0], samples)
        names, stations = partners[view.name]
        names = names[:most]
        found = np.full((len(names), len(pixels[0])), _Loss.UNSEEN)
        for k, name in enumerate(names):
            found[k] = _losses_in(view, maps, scene.view(name), maps_of(name), pixels, options)
        counts += np.bincount(_final_losses(found, stations[:most], options), minlength=len(_Loss))
    return GateLosses(*(counts / max(counts.sum(), 1)))


class _Loss(IntEnum):
    """What keeps a partner from agreeing with a pixel, in the order of `GateLosses`."""

    UNSEEN = 0
    FEW = 1
    DEPTH = 2
    REPROJECTION = 3
    NORMAL = 4
    NONE = 5


def _final_losses(found: NDArray[np.int64], stations: Sequence[int], options: FusionOptions) -> NDArray[np.int64]:
    """(n,): what keeps each pixel from becoming a point, from what each partner says of it, (partners, n)."""
    agreeing = np.zeros(found.shape[1], dtype=int)
    seen = np.zeros_like(agreeing)
    for station in sorted(set(stations) - {OWN_STATION}):
        verdicts = found[np.array(stations) == station]
        agreeing += (verdicts == _Loss.NONE).any(axis=0)
        seen += (verdicts != _Loss.UNSEEN).any(axis=0)
    gates = np.array([(found == gate).sum(axis=0) for gate in (_Loss.DEPTH, _Loss.REPROJECTION, _Loss.NORMAL)])
    failed = np.where(seen > 0, _Loss.FEW, _Loss.UNSEEN)
    by_gate = (agreeing < seen) & gates.any(axis=0)
    failed = np.where(by_gate, gates.argmax(axis=0) + _Loss.DEPTH, failed)
    return np.where(1 + agreeing >= options.min_num_pixels, _Loss.NONE, failed)


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
        losses[(losses > _Loss.DEPTH) & (distance > options.reprojection_error)] = _Loss.REPROJECTION
    return losses
