"""`colmap_sph mesh`: a mesh of a workspace."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from colmap_sph.app.display import Display
from colmap_sph.app.products.opening import opened_on_map
from colmap_sph.app.terminal import Terminal, print_result
from colmap_sph.pipeline.memory import budget, parse_memory
from colmap_sph.pipeline.options import num_cores
from colmap_sph.products.georeferencing import GeoreferenceOptions
from colmap_sph.products.mesh.options import MeshOptions


@dataclass(frozen=True)
class MeshCommand:
    """Make a mesh with the images' colours, mesh.ply and mesh.glb, of the depth maps or the cloud of a workspace.

    On a map, mesh.ply has its coordinates; mesh.glb is relative to its own middle, and upright.
    """

    workspace: Annotated[Path, tyro.conf.Positional]
    """Dense workspace, such as dense."""
    options: Annotated[MeshOptions, tyro.conf.arg(name="")] = field(default_factory=MeshOptions)
    georeference: Annotated[GeoreferenceOptions, tyro.conf.arg(name="")] = field(
        default_factory=GeoreferenceOptions
    )
    output: Path | None = None
    """Folder for what is made. Default: mesh in the workspace."""
    memory: str = ""
    """Memory to keep to while depth maps are averaged, such as 4GiB. Default: 70 % of what is free."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace what is there from before."""


def mesh_command(command: MeshCommand, terminal: Terminal) -> int:
    """`colmap_sph mesh`: paths of what was made on the standard output."""
    from colmap_sph.products.mesh.make import MeshRequest, make_mesh  # which no other command needs

    command.options.check()
    memory = budget(parse_memory(command.memory))
    with opened_on_map(command.workspace, command.georeference, terminal) as (workspace, georeference):
        folder = command.output or workspace.mesh_dir
        with Display(terminal) as display:
            request = MeshRequest(
                workspace, georeference, command.options, folder, memory, num_cores(), command.overwrite
            )
            paths, faces = make_mesh(request, display.start, display.advance)
    terminal.say(f"{faces:,} triangles", label="Mesh:", style="bold")
    for path in paths:
        print_result(str(path))
    return 0
