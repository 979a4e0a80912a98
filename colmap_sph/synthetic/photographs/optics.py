"""A lens and a sensor: vignetting, defocus, shake, exposure, noise, on pictures (H, W, 3) float32 in 0 ... 255.

All of them act on displayed grey values; none moves what is seen.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from colmap_sph.synthetic.texture import Float32Array

# Samples of a pixel's side, in kernels.
_FINE = 8


def vignetted(picture: Float32Array, loss: float) -> Float32Array:
    """Darkened with the square of the distance from the middle, by the share `loss` in the corners."""
    height, width = picture.shape[:2]
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = (np.arange(height) + 0.5) / height * 2 - 1
    square = (x[None, :] * width) ** 2 + (y[:, None] * height) ** 2
    kept = 1.0 - loss * square / (width**2 + height**2)
    darker: Float32Array = picture * kept.astype(np.float32)[..., None]
    return darker


def defocused(picture: Float32Array, sigma: float, radius: float) -> Float32Array:
    """Blurred by a Gaussian (standard deviation `sigma`) and an evenly filled disc (`radius`), pixels."""
    if sigma > 0:
        soft = cv2.GaussianBlur(picture, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        picture = np.asarray(soft, np.float32)
    return _filtered(picture, disc_kernel(radius)) if radius > 0 else picture


def smeared(picture: Float32Array, length: float, direction: float) -> Float32Array:
    """Mean over a straight, even motion of `length` pixels about the middle of the exposure.

    `direction` is its angle in radians, from x to y.
    """
    return _filtered(picture, line_kernel(length, direction)) if length > 0 else picture


def sensor_readings(
    picture: Float32Array, read_noise: float, photon_noise: float, rng: np.random.Generator
) -> npt.NDArray[np.uint8]:
    """Grey values as read from a sensor, clipped and rounded.

    Parameters
    ----------
    picture : (H, W, 3) float32 ndarray
        Changed in place.
    read_noise : float
        Standard deviation that all pixels have, grey values.
    photon_noise : float
        Standard deviation at white, grey values; it grows with the root of the light.
    rng : numpy.random.Generator

    Returns
    -------
    (H, W, 3) uint8 ndarray
    """
    if photon_noise > 0:
        variance = read_noise**2 + photon_noise**2 * np.maximum(picture, 0.0) / 255.0
        picture += np.sqrt(variance, dtype=np.float32) * rng.standard_normal(picture.shape, dtype=np.float32)
    elif read_noise > 0:
        picture += np.float32(read_noise) * rng.standard_normal(picture.shape, dtype=np.float32)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def disc_kernel(radius: float) -> Float32Array:
    """(2k+1, 2k+1) share of every pixel in a disc about the middle one's centre, of sum 1; `radius` in pixels."""
    half = int(np.ceil(radius + 0.5))
    fine = (np.arange((2 * half + 1) * _FINE) + 0.5) / _FINE - half - 0.5
    inside = np.hypot(fine[None, :], fine[:, None]) <= radius
    size = 2 * half + 1
    share = inside.reshape(size, _FINE, size, _FINE).sum(axis=(1, 3))
    return np.asarray(share / share.sum(), np.float32)


def line_kernel(length: float, direction: float) -> Float32Array:
    """(2k+1, 2k+1) weights of an even motion along a line through the middle, of sum 1; pixels, radians."""
    half = int(np.ceil(length / 2 + 1))
    steps = (np.arange(64) + 0.5) / 64 - 0.5
    x = half + length * steps * np.cos(direction)
    y = half + length * steps * np.sin(direction)
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    for dx in (0, 1):
        for dy in (0, 1):
            i = np.floor(x).astype(int) + dx
            j = np.floor(y).astype(int) + dy
            np.add.at(kernel, (j, i), (1 - np.abs(x - i)) * (1 - np.abs(y - j)))
    return np.asarray(kernel / kernel.sum(), np.float32)


def _filtered(picture: Float32Array, kernel: Float32Array) -> Float32Array:
    # OpenCV correlates; the kernels are symmetric about their middle.
    return np.asarray(cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)
