"""Depth map → normal map, by robust local planes.

On a plane the inverse depth is affine in pixel coordinates. A weighted least-squares fit over the pixel's own
surface gives the plane, hence the normal and a denoised depth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.depth import DepthEstimate
from colmap_sph.errors import OptionError
from colmap_sph.kernels import backend
from colmap_sph.scene import View


@dataclass(frozen=True)
class NormalOptions:
    """How normals are fitted to a depth map."""

    radius: int = 4
    """Radius of the window, pixels."""
    tolerance: float = 3.0
    """Neighbours further from the plane than this many standard deviations hardly count."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        if not 1 <= self.radius <= 16:
            raise OptionError(f"the normals' radius must lie in 1..16, not {self.radius}.")
        if not self.tolerance > 0:
            raise OptionError(f"the normals' tolerance must be positive, not {self.tolerance}.")


def fit_normals(
    view: View, estimate: DepthEstimate, options: NormalOptions
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fit a plane to every pixel's neighbourhood.

    Parameters
    ----------
    view : View
    estimate : DepthEstimate
        (H, W) depth and standard deviation.
    options : NormalOptions

    Returns
    -------
    normals : (H, W, 3) float32 ndarray
        Unit vectors in the camera frame, towards the camera; (0, 0, 0) where no plane fits.
    depth : (H, W) float32 ndarray
        Depth of each plane at its pixel; 0 where no plane fits.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(estimate.depth > 0, 1 / estimate.depth, 0).astype(np.float32)
    inverse_sigma = (estimate.sigma * inverse * inverse).astype(np.float32)
    normals = np.empty((*inverse.shape, 3), dtype=np.float32)
    fitted = np.empty_like(inverse)
    _native.fit_planes(
        backend(), inverse, inverse_sigma, view.K.copy(), options.radius, options.tolerance, normals, fitted
    )
    return normals, fitted
