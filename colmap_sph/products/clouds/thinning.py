"""A cloud → one point of each voxel, that which most images see, with the images that see it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.clouds.source import Cloud, CloudPiece

# From one size of voxels to the next: half as many of a surface.
_COARSER = 2**0.5
# To begin with: cells along the longest side of the first points.
_FINEST = 1 << 19


@dataclass(frozen=True, eq=False)
class ThinCloud:
    """Some points of a cloud, as they are in it.

    Attributes
    ----------
    xyz : (n, 3) float64 ndarray
        The model's coordinates.
    normals : (n, 3) float32 ndarray
        0 where the cloud has none.
    rgb : (n, 3) uint8 ndarray
        Grey where the cloud has none.
    counts : (n,) uint32 ndarray
        Number of images that see each point; 0 where that is not known.
    images : (sum of counts,) uint32 ndarray
        Places of these among the model's registered images.
    voxel : float
        Side of the voxels, model units; 0: nothing was left out.
    """

    xyz: NDArray[np.float64]
    normals: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    counts: NDArray[np.uint32]
    images: NDArray[np.uint32]
    voxel: float = 0.0


def thinned(cloud: Cloud, most: int) -> ThinCloud:
    """Thin a cloud, of any size, to at most so many points, about evenly.

    Parameters
    ----------
    cloud : Cloud
    most : int

    Returns
    -------
    ThinCloud
        At least about half as many points, where the cloud has them.
    """
    kept = _complete(None)
    voxel = 0.0
    for piece in cloud.pieces():
        kept = _joined(kept, _complete(piece))
        while len(kept.xyz) > most:
            voxel = _first_voxel(kept.xyz) if voxel == 0 else voxel * _COARSER
            kept = _one_of_each(kept, voxel)
        if voxel > 0:
            kept = _one_of_each(kept, voxel)
    return ThinCloud(kept.xyz, kept.normals, kept.rgb, kept.counts, kept.images, voxel)


def _first_voxel(xyz: NDArray[np.float64]) -> float:
    return max(float(np.ptp(xyz, axis=0).max()), np.finfo(np.float64).tiny) / _FINEST


def _one_of_each(cloud: ThinCloud, voxel: float) -> ThinCloud:
    """Of each voxel the point that most images see, the first among equals."""
    cells = np.floor(cloud.xyz / voxel)
    order = np.lexsort((-cloud.counts.astype(np.int64), *cells.T))
    ordered = cells[order]
    is_first = np.ones(len(order), bool)
    is_first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    kept = np.zeros(len(order), bool)
    kept[order[is_first]] = True
    seen = np.repeat(kept, cloud.counts)
    return ThinCloud(
        cloud.xyz[kept], cloud.normals[kept], cloud.rgb[kept], cloud.counts[kept], cloud.images[seen], voxel
    )


def _complete(piece: CloudPiece | None) -> ThinCloud:
    number = 0 if piece is None else len(piece.xyz)
    xyz = np.empty((0, 3)) if piece is None else piece.xyz
    normals = None if piece is None else piece.normals
    rgb = None if piece is None else piece.rgb
    counts = None if piece is None else piece.counts
    images = None if piece is None else piece.images
    return ThinCloud(
        xyz,
        np.zeros((number, 3), np.float32) if normals is None else normals,
        np.full((number, 3), 128, np.uint8) if rgb is None else rgb,
        np.zeros(number, np.uint32) if counts is None else counts,
        np.empty(0, np.uint32) if images is None else images,
    )


def _joined(first: ThinCloud, second: ThinCloud) -> ThinCloud:
    return ThinCloud(
        np.concatenate([first.xyz, second.xyz]),
        np.concatenate([first.normals, second.normals]),
        np.concatenate([first.rgb, second.rgb]),
        np.concatenate([first.counts, second.counts]),
        np.concatenate([first.images, second.images]),
    )
