"""Things that stand at other places in each picture: boxes of a car's size on the ground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from colmap_sph.synthetic.primitives import Surface
from colmap_sph.synthetic.rays import Camera, trace_points
from colmap_sph.synthetic.solids import box
from colmap_sph.synthetic.texture import Mottled, Noise

_MOVING = 301
_SIZE = (4.3, 1.8, 1.5)
_PLACES_TRIED = 40


def moving_things(
    surfaces: Sequence[Surface], camera: Camera, count: int, *, gsd: float, seed: int, number: int
) -> tuple[Surface, ...]:
    """Boxes where a picture shows the ground, at random; they cast no shadow.

    Parameters
    ----------
    surfaces : sequence of Surface
        The ground first.
    camera : Camera
    count : int
        How many; fewer where little ground is seen.
    gsd : float
        Size of a pixel that the texture is made for, metres.
    seed, number : int
        Seed of the block and the picture's number in it.

    Returns
    -------
    tuple of Surface
    """
    if count == 0:
        return ()
    rng = np.random.default_rng((seed, number, _MOVING))
    image = rng.uniform([0.0, 0.0], [camera.width, camera.height], (_PLACES_TRIED * count, 2))
    hits = trace_points(surfaces, camera, image)
    on_ground = np.flatnonzero(hits.surface == 0)[:count]
    noise = Noise(gsd, seed)
    things = []
    for place in camera.back_project(image[on_ground], hits.distance[on_ground]):
        paint = Mottled(noise, tuple(rng.uniform(0.15, 0.85, 3)), 0.12, tuple(rng.uniform(0, 60, 2)))
        things.append(box(place - [0.0, 0.0, 0.1], _SIZE, (paint,), rng.uniform(0, np.pi)))
    return tuple(things)
