"""A workspace as typed → what every product is made from: the workspace, and where its model lies on the map."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from colmap_sph.app.report_command import opened
from colmap_sph.app.terminal import Terminal
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.georeferencing import GeoreferenceOptions, georeferenced, report_lines
from colmap_sph.products.maps.reading import check_maps
from colmap_sph.project.claim import shared
from colmap_sph.project.workspace import Workspace


@contextmanager
def opened_on_map(
    path: Path, options: GeoreferenceOptions, terminal: Terminal
) -> Iterator[tuple[Workspace, Georeference]]:
    """The workspace and its place on the map; tells what an alignment has left over.

    No run begins there before the product is made.

    Raises
    ------
    OutputError
        A run is at work there: some of the maps are of before it, and some are not.
    """
    workspace = opened(path)
    with ExitStack() as held:
        if workspace.state_dir.is_dir():
            held.enter_context(shared(workspace))
        check_maps(workspace)
        georeference = georeferenced(workspace, options)
        if options.align is not None:
            terminal.say_lines("\n".join(report_lines(georeference)))
        yield workspace, georeference
