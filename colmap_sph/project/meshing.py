"""COLMAP's meshing: a cloud → a mesh by Poisson reconstruction, and a mesh → one with fewer faces."""

from pathlib import Path

import pycolmap

from colmap_sph.errors import NoResultError, reason_of
from colmap_sph.project.colmap_library import quiet_colmap


def poisson_mesh(cloud: Path, mesh: Path, *, depth: int, trim: float, threads: int) -> None:
    """Reconstruct the surface of a cloud with normals (Kazhdan & Hoppe 2013); written as PLY.

    Parameters
    ----------
    cloud, mesh : Path
    depth : int
        The octree has up to 2^depth cells along each side.
    trim : float
        What has fewer than 2^trim points to a cell is cut off; 0: nothing.
    threads : int

    Raises
    ------
    NoResultError
        There is no surface.
    """
    options = pycolmap.PoissonMeshingOptions()
    options.depth = depth
    options.trim = trim
    options.num_threads = threads
    try:
        with quiet_colmap():
            pycolmap.poisson_meshing(cloud, mesh, options)
    except (RuntimeError, ValueError) as error:
        raise NoResultError(f"{cloud} cannot be meshed ({reason_of(error)}); try --method tsdf.") from error
    if not mesh.exists():
        raise NoResultError(f"{cloud} has no surface to mesh; try --method tsdf.")


def simplify(source: Path, target: Path, *, ratio: float, threads: int) -> None:
    """Write a mesh with a share of its faces, chosen by quadric error metrics (Garland & Heckbert 1997)."""
    options = pycolmap.MeshSimplificationOptions()
    options.target_face_ratio = ratio
    options.num_threads = threads
    try:
        with quiet_colmap():
            pycolmap.simplify_mesh(source, target, options)
    except (RuntimeError, ValueError) as error:
        raise NoResultError(
            f"The mesh cannot be simplified ({reason_of(error)}); leave out --simplify."
        ) from error
