"""Sampled maps of a view and its partners → at each sample a confirmed depth, or why there is none."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.pages.samples import MapSamples, nearest_in
from colmap_sph.scene import Region, View, pixel_transfer
from colmap_sph.stereo.region.inside import is_inside
from colmap_sph.stereo.region.shown import filled
from colmap_sph.stereo.region.window import outline_on, turned

# Between two samples depth may change by more than among those around.
_SLACK = 0.02


class Reason(IntEnum):
    """Why a pixel has no geometric depth, in the order of the gates; or that it has one."""

    CONFIRMED = 0
    OUTSIDE = 1
    MASKED = 2
    ONE_IMAGE = 3
    NO_PARALLAX = 4
    BLANK = 5
    NOT_FOUND = 6
    CONTRADICTED = 7
    ALONE = 8


WORDS = {
    Reason.CONFIRMED: ("confirmed", "depth confirmed by other images: what is fused"),
    Reason.OUTSIDE: ("outside the region", "not asked for: what it shows lies outside the region"),
    Reason.MASKED: ("masked", "ignored under the mask"),
    Reason.ONE_IMAGE: ("one image only", "no partner of the image has the place in view"),
    Reason.NO_PARALLAX: ("no parallax", "partners see it from nearly the same place"),
    Reason.BLANK: ("blank", "nothing to match: sky, still water, bare or overexposed surfaces"),
    Reason.NOT_FOUND: (
        "not matched",
        "in view of partners, but no depth was found: hidden, moving, repeated, fine",
    ),
    Reason.CONTRADICTED: ("contradicted", "a depth was found, and other images' depths disagree with it"),
    Reason.ALONE: ("unconfirmed", "a depth was found, and no other image has a depth there"),
}
"""Name and meaning of each."""


@dataclass(frozen=True, eq=False)
class Partner:
    """A view's partner, and its samples."""

    view: View
    samples: MapSamples

    @cached_property
    def depths_around(self) -> NDArray[np.float32]:
        """(h, w): the largest depth at each sample and those around it; 0 where there is none."""
        found = np.where(self.samples.photometric > 0, self.samples.photometric, self.samples.geometric)
        return np.asarray(cv2.dilate(found, np.ones((3, 3), np.uint8)), np.float32)


def find_reasons(
    view: View,
    samples: MapSamples,
    partners: Sequence[Partner],
    *,
    blank: NDArray[np.bool_],
    min_angle: float,
    region: Region | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Say of each sample of a view what became of it.

    A place without a depth of its own is taken to be as far away as the nearest sample with one.

    Parameters
    ----------
    view : View
    samples : MapSamples
    partners : sequence of Partner
    blank : (h, w) bool ndarray
        Where the image shows nothing that could be matched.
    min_angle : float
        Less parallax tells no depth, degrees.
    region : Region, optional
        Where depth was asked for, finite, in the view's world frame.

    Returns
    -------
    reasons : (h, w) uint8 ndarray
        `Reason` of each sample.
    depth : (h, w) float32 ndarray
        How far away each is, or is taken to be; 0 where the view has no depth at all.
    """
    found = np.where(samples.geometric > 0, samples.geometric, samples.photometric)
    depth = filled(found)
    seen, apart, met = _look_from(view, samples, partners, depth, min_angle)
    unseen = ~seen & (depth > 0) if partners else ~seen
    reasons = np.full(depth.shape, Reason.NOT_FOUND, np.uint8)
    reasons[blank] = Reason.BLANK
    reasons[seen & ~apart] = Reason.NO_PARALLAX
    reasons[unseen] = Reason.ONE_IMAGE
    has_own = samples.photometric > 0
    reasons[has_own] = Reason.ALONE
    reasons[has_own & met] = Reason.CONTRADICTED
    reasons[has_own & unseen] = Reason.ONE_IMAGE
    reasons[samples.ignored] = Reason.MASKED
    if region is not None:
        reasons[~_shows(region, view, samples, depth)] = Reason.OUTSIDE
    reasons[samples.geometric > 0] = Reason.CONFIRMED
    return reasons, depth


def _shows(region: Region, view: View, samples: MapSamples, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(h, w): does the sample show a region? Where no depth of the view is known, it may."""
    columns, rows = (grid.ravel() for grid in np.meshgrid(samples.columns, samples.rows))
    outline = outline_on(turned(view, region), region.box)
    if outline is None:
        return np.zeros(depth.shape, bool)
    # A convex outline: inside is on the same side of each of its edges.
    along = np.roll(outline, -1, axis=0) - outline
    across = along[:, :1] * (rows + 0.5 - outline[:, 1:]) - along[:, 1:] * (columns + 0.5 - outline[:, :1])
    shows: NDArray[np.bool_] = np.asarray((across >= 0).all(axis=0))
    known = depth.ravel() > 0
    pixels = np.stack([columns, rows, np.ones_like(rows)])[:, known].astype(np.float64)
    points = (view.R.T @ np.linalg.inv(view.K) @ pixels * depth.ravel()[known]).T + view.center
    shows[known] &= is_inside(region, points)
    return shows.reshape(depth.shape)


def _look_from(
    view: View,
    samples: MapSamples,
    partners: Sequence[Partner],
    depth: NDArray[np.float32],
    min_angle: float,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """(h, w) each: does any partner have it in view; and from another place; and has it a depth there?

    Of samples without a confirmed depth, for which alone it matters; the others are in nobody's view.
    """
    rows, columns = np.nonzero((depth > 0) & (samples.geometric == 0))
    pixels = np.stack([samples.columns[columns], samples.rows[rows], np.ones_like(rows)])
    points = depth[rows, columns].astype(np.float64) * pixels
    rays = view.R.T @ np.linalg.inv(view.K) @ points
    found = np.zeros((3, len(rows)), bool)
    seen, apart, met = found
    for partner in partners:
        transfer = pixel_transfer(view, partner.view)
        moved = transfer[:, :3] @ points + transfer[:, 3:]
        in_view, places = _in_view(partner, moved)
        seen[in_view] = True
        unsure = in_view[~apart[in_view]]
        angles = _angles(rays[:, unsure], partner.view.center - view.center)
        apart[unsure] = angles >= min_angle
        # What lies behind the surface that the partner sees is hidden from it.
        most = partner.depths_around[places]
        met[in_view] |= (most > 0) & (moved[2, in_view] <= (1 + _SLACK) * most)
    maps = np.zeros((3, *depth.shape), bool)
    maps[:, rows, columns] = found
    return maps[0], maps[1], maps[2]


def _in_view(
    partner: Partner, moved: NDArray[np.float64]
) -> tuple[NDArray[np.int64], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """(m,) homogeneous pixels, of (3, n), that lie in a partner's image; row and column of the sample there."""
    x, y, depth = moved
    view = partner.view
    inside = (x >= 0) & (y >= 0) & (x <= (view.width - 1) * depth) & (y <= (view.height - 1) * depth)
    which = np.flatnonzero(inside & (depth > 0))
    rows = nearest_in(partner.samples.rows, y[which] / depth[which])
    columns = nearest_in(partner.samples.columns, x[which] / depth[which])
    return which, (rows, columns)


def _angles(rays: NDArray[np.float64], baseline: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) degrees at the points (3, n), relative to the view's centre, between it and one `baseline` away."""
    sines = np.linalg.norm(np.cross(rays, baseline, axisa=0, axisc=0), axis=0)
    return np.asarray(np.degrees(np.arctan2(sines, (rays**2).sum(axis=0) - baseline @ rays)))
