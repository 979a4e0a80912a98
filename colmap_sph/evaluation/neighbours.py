"""Nearest neighbours and voxels for millions of points in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from colmap_sph.errors import OptionError

Points = npt.NDArray[np.float64]
# What a thread searches for at a time: some hundredths of a second, which whoever interrupts has to wait.
_QUERY_CHUNK = 1 << 13
_ORDERING_CELLS = 512


class PointIndex:
    """Nearest-neighbour search in a cloud of (N, 3) points."""

    def __init__(self, points: Points) -> None:
        from scipy.spatial import cKDTree  # which takes long to load

        # Neighbours in space next to each other in memory make building and searching three times faster;
        # for such points the balanced tree is slower to build and no faster to search.
        self._order = spatial_order(points)
        self._tree = cKDTree(points[self._order], balanced_tree=False, compact_nodes=False)

    def distances(self, queries: Points, *, threads: int = 1, bound: float = np.inf) -> npt.NDArray[np.float64]:
        """Distance from each query to the nearest point.

        Parameters
        ----------
        queries : (n, 3) float64 ndarray
        threads : int
        bound : float
            In the unit of the points.

        Returns
        -------
        (n,) float64 ndarray
            In the unit of the points; infinite beyond `bound`.
        """
        result = np.empty(len(queries))
        order = spatial_order(queries)

        def search(chunk: slice) -> None:
            rows = order[chunk]
            result[rows], _ = self._tree.query(queries[rows], distance_upper_bound=bound)

        _in_chunks(search, len(queries), threads)
        return result

    def nearest(self, queries: Points, count: int, *, threads: int = 1) -> npt.NDArray[np.int64]:
        """The points nearest to each query.

        Parameters
        ----------
        queries : (n, 3) float64 ndarray
        count : int
            How many; there must be as many points.
        threads : int

        Returns
        -------
        (n, count) int64 ndarray
            Indices of points, the nearest first.
        """
        rows = np.empty((len(queries), count), np.int64)

        def search(chunk: slice) -> None:
            _, rows[chunk] = self._tree.query(queries[chunk], k=np.arange(1, count + 1))

        _in_chunks(search, len(queries), threads)
        return np.asarray(self._order[rows])


def _in_chunks(search: Callable[[slice], None], number: int, threads: int) -> None:
    """Search for so many queries in threads of our own.

    Whoever interrupts `cKDTree.query` does not wait for the threads that it has begun itself: these go on in
    memory that is freed meanwhile, and the process dies of them.
    """
    chunks = [slice(start, start + _QUERY_CHUNK) for start in range(0, number, _QUERY_CHUNK)]
    pool = ThreadPoolExecutor(threads)
    try:
        list(pool.map(search, chunks))
    finally:
        pool.shutdown(cancel_futures=True)  # interrupted, it begins no more, and waits for those under way


def bounds(points: Points) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Smallest and largest coordinates (3,), (3,) of (N, 3) points, N > 0."""
    # Column by column: NumPy's reduction along the first axis takes ten times as long.
    columns = [points[:, axis] for axis in range(3)]
    return np.array([column.min() for column in columns]), np.array([column.max() for column in columns])


def spatial_order(points: Points) -> npt.NDArray[np.int64]:
    """Order of (N, 3) points by cells of a regular grid, so that neighbours come close to each other."""
    if not len(points):
        return np.arange(0)
    low, high = bounds(points)
    extent = float((high - low).max())
    if extent == 0.0:
        return np.arange(len(points))
    return np.argsort(voxel_keys(points, extent / _ORDERING_CELLS), kind="stable")


def voxel_keys(points: Points, size: float, *, offset: float = 0.0) -> npt.NDArray[np.int64]:
    """One integer per point that is equal for the points of one voxel and orders voxels by x, y, z.

    Parameters
    ----------
    points : (N, 3) float64
        At least one point.
    size : float
        Edge of a voxel.
    offset : float
        The grid starts this many voxels before the smallest coordinates.

    Returns
    -------
    (N,) int64

    Raises
    ------
    OptionError
        More voxels than 64 bits can number.
    """
    low, high = bounds(points)
    counts = [int(span / size + offset) + 1 for span in high - low]
    if counts[0] * counts[1] * counts[2] >= 2**63:
        raise OptionError(
            f"voxels of {size:g} m are too small for points spread over {(high - low).max():g} m: "
            "use a larger tau, or remove far outliers from the cloud",
            "tau",
        )
    keys = np.zeros(len(points), np.int64)
    for axis in range(3):
        keys *= counts[axis]
        keys += np.floor((points[:, axis] - low[axis]) / size + offset).astype(np.int64)
    return keys


def thin(points: Points, size: float) -> npt.NDArray[np.int64]:
    """Indices of the points that remain when each voxel of edge `size` keeps its first point."""
    order, starts = _by_voxel(points, size, offset=0.0)
    return np.asarray(np.minimum.reduceat(order, starts))


def voxel_centroids(points: Points, size: float) -> Points:
    """Mean of the points of each voxel of edge `size`, on the grid Open3D's voxel_down_sample uses."""
    order, starts = _by_voxel(points, size, offset=0.5)
    low, _ = bounds(points)
    # Sums of coordinates relative to the corner keep all digits of map coordinates.
    sums = np.add.reduceat(points[order] - low, starts, axis=0)
    return np.asarray(sums / np.diff(starts, append=len(points))[:, None] + low)


def mean_voxel_shares(points: Points, hits: npt.NDArray[np.bool_], size: float) -> npt.NDArray[np.float64]:
    """Per column of hits: the share of hits among the points of a voxel, averaged over voxels.

    The voxels are those of two grids, the second shifted by half a voxel, so that it matters less where the
    grid happens to lie.

    Parameters
    ----------
    points : (n, 3) float64 ndarray
    hits : (n, T) bool ndarray
    size : float
        Edge of a voxel, in the unit of the points.

    Returns
    -------
    (T,) float64 ndarray
        0 to 1.

    Raises
    ------
    OptionError
        More voxels than 64 bits can number.
    """
    total = np.zeros(hits.shape[1])
    voxel_count = 0
    for offset in (0.0, 0.5):
        order, starts = _by_voxel(points, size, offset=offset)
        counts = np.diff(starts, append=len(points))
        for column in range(hits.shape[1]):
            total[column] += np.sum(np.add.reduceat(hits[order, column], starts, dtype=np.int64) / counts)
        voxel_count += len(starts)
    return total / voxel_count


def _by_voxel(
    points: Points, size: float, *, offset: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """An order of the points voxel by voxel, and where in it each voxel starts."""
    keys = voxel_keys(points, size, offset=offset)
    order = np.argsort(keys)
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    return order, starts
