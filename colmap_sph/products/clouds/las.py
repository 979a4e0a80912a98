"""A cloud → one LAS or LAZ file, piece by piece."""

from pathlib import Path

import laspy
from lazrs import LazrsError

from colmap_sph.products.clouds.las_points import Extent, las_header, las_points
from colmap_sph.products.clouds.source import Cloud
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.publishing import published


def write_las(
    cloud: Cloud, extent: Extent, georeference: Georeference, path: Path, *, scale: float | None = None
) -> None:
    """Write a cloud as LAS, or, by the path's ending, as LAZ.

    Parameters
    ----------
    cloud : Cloud
    extent : Extent
        Of all its points, in map coordinates.
    georeference : Georeference
    path : Path
        Ends in ``.las`` or ``.laz``.
    scale : float, optional
        See `las_header`.

    Raises
    ------
    InputError
        The cloud cannot be read any more.
    OptionError
        The scale is too fine.
    OutputError
        The file cannot be written.
    """
    header = las_header(cloud, extent, georeference, scale)
    is_compressed = path.suffix == ".laz"
    backend = laspy.LazBackend.Lazrs if is_compressed else None
    with published(path) as temporary, temporary.open("xb") as file:
        try:
            with laspy.LasWriter(
                file, header, do_compress=is_compressed, laz_backend=backend, closefd=False
            ) as writer:
                for piece in cloud.measured_pieces():
                    writer.write_points(las_points(piece, header, georeference))
        except LazrsError as error:
            raise OSError(str(error)) from error
