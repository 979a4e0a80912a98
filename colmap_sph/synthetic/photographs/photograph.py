"""A picture of a scene as a camera takes it, with the exact depth of what each of its pixels sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from colmap_sph.synthetic.light import Light
from colmap_sph.synthetic.photographs import optics
from colmap_sph.synthetic.photographs.imperfections import Imperfections
from colmap_sph.synthetic.photographs.sky import Sky
from colmap_sph.synthetic.primitives import Surface
from colmap_sph.synthetic.rays import Camera
from colmap_sph.synthetic.render import Rendering, exact_geometry, exact_picture
from colmap_sph.synthetic.texture import Float32Array

_EXPOSURE = 101
_SHAKE = 102


def photograph(
    surfaces: Sequence[Surface],
    camera: Camera,
    effects: Imperfections,
    *,
    origin: float = 0.5,
    supersample: int = 2,
    light: Light | None = None,
    read_noise: float = 0.0,
    seed: int = 0,
    number: int = 0,
) -> Rendering:
    """Take one picture.

    Parameters
    ----------
    surfaces : sequence of Surface
        All that stands before the camera, moving things included.
    camera : Camera
        As it really is: bent and moving where the effects say so (`real_camera`).
    effects : Imperfections
        What acts on light and grey values; the rest is done by others.
    origin, supersample, light
        As for `render`.
    read_noise : float
        Standard deviation of the noise that all pixels have, grey values.
    seed, number : int
        Seed of the block and the picture's number in it.

    Returns
    -------
    Rendering
    """
    light = light or Light()
    light = replace(light, specular=effects.specular) if effects.specular > 0 else light
    sky = Sky(effects.clouds, seed) if effects.sky else None
    picture = exact_picture(surfaces, camera, supersample=supersample, light=light, sky=sky)
    picture = _through_lens(picture, effects, seed, number)
    rng = np.random.default_rng((seed, number))
    image = optics.sensor_readings(picture, read_noise, effects.photon_noise, rng)
    return Rendering(image, *exact_geometry(surfaces, camera, origin=origin))


def exposure_gain(effects: Imperfections, seed: int, number: int) -> float:
    """Factor of a picture's grey values."""
    stops = np.random.default_rng((seed, number, _EXPOSURE)).uniform(-1, 1) * effects.exposure
    return float(2.0**stops)


def _through_lens(picture: Float32Array, effects: Imperfections, seed: int, number: int) -> Float32Array:
    picture = optics.defocused(picture, effects.blur, effects.defocus)
    direction = np.random.default_rng((seed, number, _SHAKE)).uniform(0, np.pi)
    picture = optics.smeared(picture, effects.motion_blur, direction)
    if effects.vignetting > 0:
        picture = optics.vignetted(picture, effects.vignetting)
    if effects.exposure > 0:
        picture = picture * np.float32(exposure_gain(effects, seed, number))
    return picture
