"""Places in two frames → the similarity between these, by COLMAP, with gross errors left out."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError

# Least median of squares [1]_: so many triples, which fail by chance in fewer than one case of a million where a
# third of the places is wrong; what lies beyond so many standard deviations is left out.
_TRIPLES = 400
_LEFT_OUT_BEYOND = 2.5
_FEWEST_FOR_CHOICE = 6
# Places on a line leave the rotation about it open: across it they must be spread by so many standard deviations.
_LEAST_SPREAD = 3.0
_EXACT = 1e-9


@dataclass(frozen=True, eq=False)
class Similarity:
    """Target = scale · rotation · source + translation.

    Attributes
    ----------
    scale : float
    rotation : (3, 3) float64 ndarray
    translation : (3,) float64 ndarray
    used : (n,) bool ndarray
        Which places it was estimated from.
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    used: NDArray[np.bool_]

    def __call__(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.scale * (places @ self.rotation.T) + self.translation)


def estimate_similarity(
    source: NDArray[np.float64], target: NDArray[np.float64], *, robust: bool = False
) -> Similarity:
    """Estimate the similarity that takes places of one frame to those of another, by least squares.

    Parameters
    ----------
    source, target : (n, 3) float64 ndarray
        Places in both frames, of any size; at least three.
    robust : bool
        Whether gross errors are found, and left out: by the least median of squares, where there are six or more.

    Raises
    ------
    NoResultError
        Fewer than three places, or all on one line, as far as their errors tell.

    References
    ----------
    .. [1] P. J. Rousseeuw, *Least median of squares regression*, JASA 79, 1984.
    """
    if len(source) < 3:
        raise NoResultError(f"{len(source)} places are known in both frames, and three are needed at least")
    near_source = source - source.mean(axis=0)
    near_target = target - target.mean(axis=0)
    used = np.ones(len(source), bool)
    if robust and len(source) >= _FEWEST_FOR_CHOICE:
        used = _without_gross_errors(near_source, near_target)
    near = _fitted(near_source[used], near_target[used])
    if near is None:
        raise NoResultError("the places all lie on one line, or at one point")
    _refuse_line(near_source[used], near_target[used], near)
    scale, rotation, translation = near
    shift = translation + target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    return Similarity(scale, rotation, shift, used)


_Fit = tuple[float, NDArray[np.float64], NDArray[np.float64]]


def _fitted(source: NDArray[np.float64], target: NDArray[np.float64]) -> _Fit | None:
    # COLMAP (4.2) takes places for degenerate whose plane contains the origin: they are moved off it.
    off = _away_from_plane(source)
    target_off = _away_from_plane(target)
    found = pycolmap.estimate_sim3d(source + off, target + target_off)
    if found is None or not np.isfinite(found.matrix()).all() or not found.scale > 0:
        return None
    rotation = np.array(found.rotation.matrix())
    return float(found.scale), rotation, found.translation + found.scale * rotation @ off - target_off


def _away_from_plane(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) shift of places off the origin, across the plane that fits them best, as far as they spread."""
    _, spread, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=True)
    return np.asarray(spread[0] * axes[2] - places.mean(axis=0))


def _distances(fit: _Fit, source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    scale, rotation, translation = fit
    return np.asarray(np.linalg.norm(scale * source @ rotation.T + translation - target, axis=1))


def _without_gross_errors(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which places agree with the similarity from three of them that leaves the least median distance."""
    generator = np.random.default_rng(0)
    number = len(source)
    least = np.inf
    agreed = np.ones(number, bool)
    for _ in range(_TRIPLES):
        three = generator.choice(number, 3, replace=False)
        fit = _fitted(source[three], target[three])
        if fit is None:
            continue
        distances = _distances(fit, source, target)
        middle = float(np.median(distances))
        if middle < least:
            least = middle
            sigma = 1.4826 * (1 + 5 / (number - 3)) * middle
            agreed = distances <= max(_LEFT_OUT_BEYOND * sigma, _EXACT * float(np.abs(target).max()))
    return agreed


def _refuse_line(source: NDArray[np.float64], target: NDArray[np.float64], fit: _Fit) -> None:
    spread = np.linalg.svd(source - source.mean(axis=0), compute_uv=False) / np.sqrt(len(source)) * fit[0]
    error = float(np.sqrt((_distances(fit, source, target) ** 2).mean()))
    if spread[1] <= max(_LEAST_SPREAD * error, 1e-6 * spread[0]):
        raise NoResultError(
            f"the places lie on one line, as far as their errors ({error:.3g} on average) tell: the rotation "
            "about it is not known"
        )
