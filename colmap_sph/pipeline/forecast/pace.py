"""How fast this machine is: what an estimated processor second takes on it."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.matching import MatchingOptions, match_pair

# What is left of the trust in earlier stages' speed with each stage: others may use the machine, too.
_FADING = 0.5
# Rows and columns of noise, and how far it moves, pixels.
_NOISE = (400, 500, 20)
# Seconds of one processor to match it where estimates come true.
_NOISE_SECONDS = 0.024


class Pace:
    """Seconds that an estimated processor second takes on this machine, all workers at work.

    Parameters
    ----------
    first_guess : float
        Of them, before anything is noted.
    """

    def __init__(self, first_guess: float) -> None:
        self._first_guess = first_guess
        self._worked = 0.0
        self._taken = 0.0

    def note(self, worked: float, taken: float) -> None:
        """So much work was done in so many seconds, since what was noted before."""
        self._worked = _FADING * self._worked + worked
        self._taken = _FADING * self._taken + taken

    @property
    def is_known(self) -> bool:
        """Whether anything was noted."""
        return self._worked > 0

    def speed(self, worked: float = 0.0, taken: float = 0.0) -> float:
        """Of all work so far, and of some that is under way."""
        done = self._worked + worked
        return (self._taken + taken) / done if done else self._first_guess


def measured_speed(workers: int) -> float:
    """The speed of `Pace` before there is an image to match: by matching noise; twice, as the first is slower.

    Parameters
    ----------
    workers : int
    """
    height, width, shift = _NOISE
    texture = np.random.default_rng(0).uniform(0, 255, (height, width + shift)).astype(np.float32)
    valid = np.full((height, width), 255, np.uint8)
    left = RectifiedImage(np.ascontiguousarray(texture[:, :width]), valid)
    right = RectifiedImage(np.ascontiguousarray(texture[:, shift:]), valid)

    def match(_: int) -> None:
        match_pair(left, right, 0.0, 2.0 * shift, MatchingOptions())

    with ThreadPoolExecutor(workers) as pool:
        for _ in range(2):
            started = time.perf_counter()
            list(pool.map(match, range(workers)))
            taken = time.perf_counter() - started
    return taken / (workers * _NOISE_SECONDS)
