"""The commands that make products: name → options, and what answers them."""

from collections.abc import Callable
from typing import Any

from colmap_sph.app.products.export_command import ExportCommand, export_command
from colmap_sph.app.products.mesh_command import MeshCommand, mesh_command
from colmap_sph.app.products.surface_command import SurfaceCommand, surface_command
from colmap_sph.app.terminal import Terminal

PRODUCTS: dict[str, tuple[type, Callable[[Any, Terminal], int]]] = {
    "export": (ExportCommand, export_command),
    "surface": (SurfaceCommand, surface_command),
    "mesh": (MeshCommand, mesh_command),
}
"""By the command's name: the record of its options, and the function that does it and returns the exit code."""
