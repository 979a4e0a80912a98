"""Sparse model and original images → undistorted images and their model, as COLMAP's undistorter makes them."""

from colmap_sph.project.undistortion.options import UndistortionOptions

__all__ = ["UndistortionOptions"]
