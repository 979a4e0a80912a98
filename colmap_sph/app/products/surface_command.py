"""`colmap_sph surface`: surface model, hillshade and true orthophoto of a workspace."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from colmap_sph.app.display import Display
from colmap_sph.app.products.opening import opened_on_map
from colmap_sph.app.terminal import Terminal, print_result
from colmap_sph.errors import percent
from colmap_sph.pipeline.memory import budget, parse_memory
from colmap_sph.products.georeferencing import GeoreferenceOptions
from colmap_sph.products.surface.options import SurfaceOptions


@dataclass(frozen=True)
class SurfaceCommand:
    """Make a surface model (DSM), its hillshade and a true orthophoto from the depth maps of a dense workspace.

    All are cloud-optimised GeoTIFFs: dsm.tif (height, its standard deviation, number of images), hillshade.tif,
    orthophoto.tif, and orthophoto_images.tif, which says from which image each colour is; surface.json has their
    names.
    """

    workspace: Annotated[Path, tyro.conf.Positional]
    """Dense workspace, such as dense."""
    options: Annotated[SurfaceOptions, tyro.conf.arg(name="")] = field(default_factory=SurfaceOptions)
    georeference: Annotated[GeoreferenceOptions, tyro.conf.arg(name="")] = field(
        default_factory=GeoreferenceOptions
    )
    output: Path | None = None
    """Folder for what is made. Default: surface in the workspace."""
    memory: str = ""
    """Memory to keep to, such as 2GiB. Default: 70 % of what is free."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace what is there from before."""


def surface_command(command: SurfaceCommand, terminal: Terminal) -> int:
    """`colmap_sph surface`: paths of what was made on the standard output."""
    from colmap_sph.products.surface.make import SurfaceRequest, make_surface  # which no other command needs

    command.options.check()
    memory = budget(parse_memory(command.memory))
    with opened_on_map(command.workspace, command.georeference, terminal) as (workspace, georeference):
        folder = command.output or workspace.surface_dir
        with Display(terminal) as display:
            request = SurfaceRequest(workspace, georeference, command.options, folder, memory, command.overwrite)
            paths, summary = make_surface(request, display.start, display.advance)
    size = f"{summary.width} x {summary.height} cells of {summary.cell:g}"
    filled = f", {percent(summary.filled)} filled" if summary.filled else ""
    covered = f"{percent(summary.covered)} with a measured height"
    terminal.say(f"{size}, {covered}{filled}", label="Surface:", style="bold")
    for path in paths:
        print_result(str(path))
    return 0
