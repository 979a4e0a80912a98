"""Depth map → normal map, by robust local planes.

On a plane the inverse depth is affine in pixel coordinates. A weighted least-squares fit over the pixel's own
surface gives the plane, hence the normal and a denoised depth.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import OptionError
from colmap_sph.scene import View
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.search.idle import at_once

# Rows that are fitted at a time, which bounds the memory for it.
_BAND_ROWS = 256
# Depths that differ from their plane's by less are noise.
_SHIFT_SIGMAS = 2
# What so many support may be seen under any angle, and lie off its neighbours' plane.
_WELL_SUPPORTED = 3


@dataclass(frozen=True)
class NormalOptions:
    """How normals are fitted to a depth map."""

    radius: int = 4
    """Radius of the window, pixels."""
    tolerance: float = 3.0
    """Neighbours further from the plane than this many standard deviations hardly count."""
    max_shift: float = 2.0
    """A depth that fewer than three others support is dropped where it differs from its plane's by more than this
    many times the size of its pixel, or the plane's change of depth to the next pixel where that is more, and by
    more than two standard deviations. What more support is rough, as foliage is, or has poses that are not exact:
    it gets its plane's depth."""
    max_incidence: float = 80.0
    """Largest angle, degrees, between the ray and the normal of a pixel whose depth fewer than three others
    support: what few see at a glance is rarely right."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        if not 1 <= self.radius <= 16:
            raise OptionError(f"radius must lie in 1..16, not {self.radius}.", "radius")
        for name in ("tolerance", "max_shift"):
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} must be positive, not {getattr(self, name)}.", name)
        if not 0 < self.max_incidence <= 90:
            message = f"max_incidence must lie above 0 and up to 90 degrees, not {self.max_incidence}."
            raise OptionError(message, "max_incidence")


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
        Depth of each plane at its pixel, and where planes bend, at ridges and steps, nearer to the pixel's own;
        0 where no plane fits.

    Examples
    --------
    A plane that faces the camera:

    >>> K = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    >>> view = View(1, "a", 64, 48, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))
    >>> shape = (48, 64)
    >>> depth = np.full(shape, 5, np.float32)
    >>> estimate = DepthEstimate(depth, sigma=depth / 500, support=np.full(shape, 3, np.uint8))
    >>> normals, fitted = fit_normals(view, estimate, NormalOptions())
    >>> np.allclose(normals, [0, 0, -1], atol=1e-6), np.allclose(fitted, 5)
    (True, True)
    """
    normals = np.zeros((*estimate.depth.shape, 3), dtype=np.float32)
    return normals, fit_normals_anew(view, estimate, options, normals)


def fit_normals_anew(
    view: View, estimate: DepthEstimate, options: NormalOptions, normals: NDArray[np.float32]
) -> NDArray[np.float32]:
    """As `fit_normals`; changes normals, in place, where a plane fits, and returns the depth of these planes."""
    fitted = np.empty_like(estimate.depth)

    def fit(first: int) -> None:
        end = min(first + _BAND_ROWS, view.height)
        low, high = max(first - options.radius, 0), min(end + options.radius, view.height)
        kept = slice(first - low, end - low)
        band_normals, band_fitted = _fit_rows(view, estimate, low, high, options)
        fitted[first:end] = band_fitted[kept]
        np.copyto(normals[first:end], band_normals[kept], where=fitted[first:end, :, None] != 0)

    at_once(*(partial(fit, first) for first in range(0, view.height, _BAND_ROWS)))
    _native.add_relief(estimate.depth, estimate.sigma, fitted)
    return fitted


def _fit_rows(
    view: View, estimate: DepthEstimate, first: int, end: int, options: NormalOptions
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    depth = estimate.depth[first:end]
    sigma = estimate.sigma[first:end]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depth > 0, 1 / depth, 0).astype(np.float32)
    inverse_sigma = (sigma * inverse * inverse).astype(np.float32)
    normals = np.empty((*inverse.shape, 3), dtype=np.float32)
    fitted = np.empty_like(inverse)
    K = view.K.copy()
    K[1, 2] -= first  # the rows of a band count from its first
    _native.fit_planes(
        backend(),
        inverse,
        inverse_sigma,
        estimate.support[first:end],
        K,
        options.radius,
        options.tolerance,
        options.max_shift,
        _SHIFT_SIGMAS,
        np.cos(np.radians(options.max_incidence)),
        _WELL_SUPPORTED,
        normals,
        fitted,
    )
    return normals, fitted
