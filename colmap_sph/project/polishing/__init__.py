"""A sparse model and measured tracks → its poses, or its cameras, adjusted; and where the result is kept."""

from colmap_sph.project.polishing.options import PolishOptions

__all__ = ["PolishOptions"]
