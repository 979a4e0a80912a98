"""Dense reconstruction for COLMAP without a GPU."""

__version__ = "0.1.0"
