"""`colmap_sph export`: cloud, depth maps and cameras of a workspace for other programs."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from colmap_sph.app.products.opening import opened_on_map
from colmap_sph.app.terminal import Terminal, print_result
from colmap_sph.products.export import Exporter, ExportOptions, export
from colmap_sph.products.georeferencing import GeoreferenceOptions


@dataclass(frozen=True)
class ExportCommand:
    """Write the cloud of a dense workspace, its depth maps and its cameras for other programs."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Dense workspace, such as dense."""
    options: Annotated[ExportOptions, tyro.conf.arg(name="")] = field(default_factory=ExportOptions)
    georeference: Annotated[GeoreferenceOptions, tyro.conf.arg(name="")] = field(
        default_factory=GeoreferenceOptions
    )
    output: Path | None = None
    """Folder for what is written. Default: export in the workspace."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace what an earlier export has written there."""


def export_command(command: ExportCommand, terminal: Terminal) -> int:
    """`colmap_sph export`: paths of what was made on the standard output."""
    command.options.check()
    with opened_on_map(command.workspace, command.georeference, terminal) as (workspace, georeference):
        folder = command.output or workspace.export_dir
        exporter = Exporter(workspace, command.options, georeference, folder)
        for path in export(exporter, terminal.status, overwrite=command.overwrite):
            print_result(str(path))
    return 0
