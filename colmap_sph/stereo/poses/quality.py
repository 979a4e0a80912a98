"""Tracks and poses → whether there is anything to polish, and whether polished poses are better."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import counted
from colmap_sph.scene import Scene
from colmap_sph.stereo.poses.tracks import (
    Tracks,
    parallax_angles,
    reprojection_errors,
    thickness,
    track_errors,
    triangulated,
    views_together,
)
from colmap_sph.stereo.rectified_pair import Float

# Degrees: points farther away tell little but of rotations, and their distance nothing.
_LEAST_PARALLAX = 1.0
# Tracks that miss by so many times the median are mismatches; what is below so many pixels never is.
_OUTLIER = 5.0
_USUAL_ERROR = 1.5
# Tracks per image that tell its pose, and ties that connect a pair.
_TRACKS_PER_IMAGE = 15
_CONNECTING_TIES = 10
_LEAST_TOGETHER = 0.9
# Ties and sparse points are one plane where their thickness is below this share of their extent.
_PLANE = 0.005
# Pixels: poses alone leave less than this, of a camera that is right.
_MOST_LEFT = 1.0
_MOST_MOVEMENT = 30.0
# Pixels by which images may still be off, as far as ties alone can tell.
_MOST_HIDDEN = 0.5
# The model's own tracks may fit worse by this share: a rounding.
_RISE = 0.02
# Pixels: no bundle adjustment leaves so much.
_BROKEN = 3.0
# A field common to a camera's images: cells along each side, observations in one that give it a mean, images, and
# observations in all.
_BENT_CELLS = 6
_BENT_PER_CELL = 10
_BENT_IMAGES = 4
_BENT_TIES = 400
# Standard deviations by which more ties must fit better than worse.
_SURE = 3.0


def sound_tracks(tracks: Tracks, scene: Scene) -> Tracks:
    """Tracks whose points lie in front of their cameras, not at infinity, and are no mismatches.

    Parameters
    ----------
    tracks : Tracks
    scene : Scene

    Returns
    -------
    Tracks
    """
    if not len(tracks):
        return tracks
    points = triangulated(tracks, scene.views)
    errors = track_errors(tracks, points, scene.views)
    angles = parallax_angles(tracks, points, scene.views)
    there = np.isfinite(errors) & (angles >= _LEAST_PARALLAX)
    if not there.any():
        return tracks.only(there)
    limit = max(_OUTLIER * float(np.median(errors[there])), _USUAL_ERROR)
    return tracks.only(there & (np.nan_to_num(errors, nan=np.inf) <= limit))


def refusal(tracks: Tracks, scene: Scene, least_residual: float) -> str:
    """Why poses cannot or need not be polished by these tracks; empty where they may be.

    Parameters
    ----------
    tracks : Tracks
        Sound ones.
    scene : Scene
    least_residual : float
        Pixels.

    Returns
    -------
    str
        The end of a sentence.
    """
    number = len(scene.views)
    if len(tracks) < _TRACKS_PER_IMAGE * number:
        return f"there are too few ties between the images ({counted(len(tracks), 'track')} for {number} images)"
    together = views_together(tracks, number, _CONNECTING_TIES)
    if together.mean() < _LEAST_TOGETHER:
        return f"ties connect only {together.sum()} of the {number} images with each other"
    sparse = _sparse_error(scene)
    if sparse > _BROKEN:
        return (
            f"its sparse points lie {sparse:.1f} px from where images observe them, so that not only poses are "
            "wrong; check cameras and images of the model"
        )
    error = _median_error(tracks, scene)
    if error < least_residual:
        return f"they are good already: the rays of ties miss each other by {error:.2f} px"
    return ""


@dataclass(frozen=True)
class Judgement:
    """How given and polished poses fit, all in pixels.

    Attributes
    ----------
    before, after : float
        Median error of tracks that had no part in the polishing.
    sureness : float
        Standard deviations by which more of these fit better than worse.
    sparse_before, sparse_after : float
        Reprojection error of the model's own tracks; 0 where it has none.
    movement : float
        Median over the images.
    thickness : float
        Of the points of ties and of the sparse points, whichever is more, in units of their extent.
    """

    before: float
    after: float
    sureness: float
    sparse_before: float
    sparse_after: float
    movement: float
    thickness: float

    @property
    def words(self) -> str:
        """What changed, as a sentence."""
        words = f"Ties that had no part in it fit to {self.after:.2f} px, before {self.before:.2f} px"
        if not self.sparse_before:
            return f"{words}."
        return f"{words}; the sparse points to {self.sparse_after:.2f} px, before {self.sparse_before:.2f} px."

    def refusal(self, least_gain: float) -> str:
        """Why the polished poses are not used, as the end of a sentence; empty where they are."""
        if self.thickness < _PLANE:
            return "all that the images have in common lies on one plane, which leaves directions open"
        if self.after > (1 - least_gain) * self.before or self.sureness < _SURE:
            return (
                "polished ones are not clearly better (ties that had no part in the adjustment fit to "
                f"{self.after:.2f} px, before {self.before:.2f} px)"
            )
        if self.sparse_after > (1 + _RISE) * self.sparse_before:
            return (
                f"polished ones fit the sparse points worse ({self.sparse_after:.2f} px, before "
                f"{self.sparse_before:.2f} px)"
            )
        if max(self.after, self.sparse_after) > _MOST_LEFT or self.movement > _MOST_MOVEMENT:
            return (
                f"other poses do not explain what is wrong (images would move by {self.movement:.1f} px, and "
                f"{max(self.after, self.sparse_after):.2f} px would be left); check the cameras of the model"
            )
        # Of what is left ties show no larger a part than of the movement; tracks of the model's own would.
        hidden = self.after * self.movement / self.before
        if not self.sparse_before and hidden > _MOST_HIDDEN:
            return (
                f"ties do not tell them (images would move by {self.movement:.1f} px, though ties miss by "
                f"{self.before:.2f} px, and could still be off by {hidden:.1f} px); triangulate points and adjust "
                "the model (COLMAP: point_triangulator, bundle_adjuster)"
            )
        return ""


def judged(held_out: Tracks, before: Scene, after: Scene) -> Judgement:
    """Compare poses by tracks that had no part in their adjustment, and by the model's own.

    Parameters
    ----------
    held_out : Tracks
    before, after : Scene
        With the same views.

    Returns
    -------
    Judgement
    """
    errors = [_errors(held_out, scene) for scene in (before, after)]
    better = int((errors[1] < errors[0]).sum())
    # As often better as worse by chance: binomial.
    sureness = (2 * better - len(held_out)) / np.sqrt(max(len(held_out), 1))
    sparse = [_sparse_error(scene) for scene in (before, after)]
    moved = movements(before, after, held_out)
    return Judgement(
        before=float(np.nanmedian(errors[0])),
        after=float(np.nanmedian(errors[1])),
        sureness=float(sureness),
        sparse_before=sparse[0],
        sparse_after=sparse[1],
        movement=float(np.median(list(moved.values()))) if moved else 0.0,
        thickness=max(thickness(triangulated(held_out, after.views)), thickness(after.points)),
    )


@dataclass(frozen=True)
class Bend:
    """What all images of one camera are bent by alike.

    Attributes
    ----------
    views : tuple of int
        Indices of its images.
    pixels : float
        Root mean square of the field that residuals of ties have in common.
    share : float
        Of their variance, by images that had no part in the field.
    """

    views: tuple[int, ...]
    pixels: float
    share: float


def common_bends(tracks: Tracks, scene: Scene) -> list[Bend]:
    """Look for fields of residuals that the images of a camera have in common: what its model does not know.

    Poses take up what they can of a bend, so that it is larger than what is found here. The field of every other
    image is compared with the residuals of those between, so that what is common to none has no share.

    Parameters
    ----------
    tracks : Tracks
    scene : Scene

    Returns
    -------
    list of Bend
        One for each camera (size and calibration) with enough images and ties.
    """
    points = triangulated(tracks, scene.views)
    residuals = reprojection_errors(tracks, points, scene.views)
    lengths = np.linalg.norm(residuals, axis=1)
    good = lengths < _OUTLIER * np.nanmedian(lengths)
    cameras: dict[tuple[object, ...], list[int]] = {}
    for index, view in enumerate(scene.views):
        cameras.setdefault((view.width, view.height, *view.K.ravel()), []).append(index)
    bends = []
    for views in cameras.values():
        halves = [good & np.isin(tracks.view, views[start::2]) for start in (0, 1)]
        if len(views) < _BENT_IMAGES or min(half.sum() for half in halves) < _BENT_TIES:
            continue
        cells = _cells(tracks, scene, views[0])
        fields = [_field(cells[half], residuals[half]) for half in halves]
        left = [residuals[halves[k]] - fields[1 - k][cells[halves[k]]] for k in (0, 1)]
        rest = np.sum([(part**2).sum() for part in left])
        total = np.sum([(residuals[half] ** 2).sum() for half in halves])
        both = (fields[0] + fields[1]) / 2
        bends.append(Bend(tuple(views), float(np.sqrt((both**2).sum(axis=1).mean())), float(1 - rest / total)))
    return bends


def _cells(tracks: Tracks, scene: Scene, view: int) -> NDArray[np.int64]:
    """(m,) cell of the image in which each observation lies."""
    size = np.array([scene.views[view].width, scene.views[view].height])
    cell = np.clip((tracks.pixels / size * _BENT_CELLS).astype(np.int64), 0, _BENT_CELLS - 1)
    return np.asarray(cell[:, 1] * _BENT_CELLS + cell[:, 0])


def _field(cells: NDArray[np.int64], residuals: Float) -> Float:
    """(cells, 2) mean residual of each cell; 0 where there are few."""
    number = np.bincount(cells, minlength=_BENT_CELLS**2)
    sums = [np.bincount(cells, residuals[:, axis], _BENT_CELLS**2) for axis in (0, 1)]
    return np.where(number[:, None] >= _BENT_PER_CELL, np.stack(sums, axis=1) / np.maximum(number, 1)[:, None], 0)


def movements(before: Scene, after: Scene, tracks: Tracks) -> dict[str, float]:
    """How far points move in each image, pixels (median), by its pose alone.

    Sparse points that the image observes, or those of tracks where it observes none; an image with neither is left
    out.
    """
    corners = triangulated(tracks, before.views)[tracks.track]
    moved = {}
    for index, (view, other) in enumerate(zip(before.views, after.views, strict=True)):
        points = before.points[view.point_indices]
        if not len(points):
            points = corners[tracks.view == index]
        if len(points):
            distance = np.linalg.norm(other.project(points)[0] - view.project(points)[0], axis=1)
            moved[view.name] = float(np.nanmedian(distance))
    return moved


def _errors(tracks: Tracks, scene: Scene) -> Float:
    return track_errors(tracks, triangulated(tracks, scene.views), scene.views)


def usual_error(tracks: Tracks, scene: Scene) -> float:
    """What tracks, or the model's own where they are less precise, miss by, pixels."""
    return max(_median_error(tracks, scene), _sparse_error(scene))


def _median_error(tracks: Tracks, scene: Scene) -> float:
    return float(np.median(_errors(tracks, scene)))


def _sparse_error(scene: Scene) -> float:
    """Mean over the views of the median reprojection error of the sparse points; 0 without any."""
    errors = [view.reprojection_error for view in scene.views if np.isfinite(view.reprojection_error)]
    return float(np.mean(errors)) if errors else 0.0
