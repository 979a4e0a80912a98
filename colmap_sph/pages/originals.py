"""Samples of the views cut from a wide image, one view after the other → samples of the image itself.

Of each pixel that view counts whose axis is nearest to its ray, of those with a depth there, as in its range map;
where none has one, of those that show it.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.pages.block_map import Ground
from colmap_sph.pages.image_facts import ImageFacts, Picture, make_pictures
from colmap_sph.pages.pictures import depth_picture, normal_picture, reason_picture, uncovered
from colmap_sph.pages.reasons import Reason
from colmap_sph.pages.samples import MapSamples, grid_of, nearest_in
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.projection import Lens, camera_rays, focal_length
from colmap_sph.scene import View

Bytes = NDArray[np.uint8]
Float = NDArray[np.float64]

# What a depth counts for beside the cosine between ray and axis.
_HAS_DEPTH = 2.0
# No view reaches farther off its axis.
_LEAST_COSINE = 1e-3
# It has more samples along its longer side than another image, as it shows more; pixels of its picture per sample.
_MORE_SAMPLES = 2
_PICTURE_SIDE = 0.8


@dataclass(eq=False)
class WideImage:
    """An image that was cut into views, at a grid of its pixels.

    Parameters
    ----------
    name : str
    lens : Lens
    per_side : int
        Samples along the longer side of another image of the page.
    with_pictures : bool
        Whether pictures are wanted of it.
    """

    name: str
    lens: Lens
    per_side: int
    with_pictures: bool
    _views: list[str] = field(init=False, default_factory=list)
    _has_maps: bool = field(init=False, default=False)
    _world: tuple[Float, Float] = field(init=False)

    def __post_init__(self) -> None:
        rows, columns = grid_of(self.lens, _MORE_SAMPLES * self.per_side)
        self._shape = len(rows), len(columns)
        self._rays = _rays(self.lens, tuple((columns + 0.5).tolist()), tuple((rows + 0.5).tolist()))
        number = len(self._rays)
        self._score = np.full(number, -np.inf)
        self._reasons = np.full(number, Reason.ONE_IMAGE, np.uint8)
        self._confirmed, self._drawn, self._assumed = (np.zeros(number, np.float32) for _ in range(3))
        self._found = np.zeros(number, bool)
        self._normals = np.zeros((3, number), np.float32) if self.with_pictures else None
        self._picture = _Painting(self.lens, _PICTURE_SIDE * max(self._shape)) if self.with_pictures else None

    def add(
        self,
        view: View,
        cut: Cut,
        samples: MapSamples,
        reasons: Bytes,
        depth: NDArray[np.float32],
        normals: NDArray[np.float32] | None,
        picture: Bytes | None,
    ) -> None:
        """Add what a view knows.

        Parameters
        ----------
        view : View
        cut : Cut
        samples : MapSamples
        reasons : (h, w) uint8 ndarray
        depth : (h, w) float32 ndarray
            As of `find_reasons`.
        normals : (3, h, w) float32 ndarray or None
        picture : (H, W, 3) uint8 ndarray or None
            Blue, green and red.
        """
        if not self._views:
            self._world = cut.face.R.T @ view.R, view.center
        self._views.append(view.name)
        self._has_maps |= samples.has_maps
        # A value of a map belongs to the ray through (column, row), see COLMAP's fusion.
        seen, cosines, places = _places(view, cut, self._rays, first=-0.5)
        columns, rows = np.rint(places).T
        which = nearest_in(samples.rows, rows), nearest_in(samples.columns, columns)
        self._found[seen] |= samples.photometric[which] > 0
        drawn = (samples.geometric if samples.has_geometric else samples.photometric)[which]
        score = cosines + np.where(drawn > 0, _HAS_DEPTH, 0.0)
        better = score > self._score[seen]
        own, cosines = seen[better], cosines[better].astype(np.float32)
        which = which[0][better], which[1][better]
        self._score[own] = score[better]
        self._reasons[own] = reasons[which]
        self._confirmed[own] = samples.geometric[which] / cosines
        self._drawn[own] = drawn[better] / cosines
        self._assumed[own] = depth[which] / cosines
        if self._normals is not None:
            there = None if normals is None else np.clip(np.nan_to_num(normals[:, which[0], which[1]]), -1, 1)
            self._normals[:, own] = 0 if there is None else cut.face.R.T @ there
        if self._picture is not None and picture is not None:
            self._picture.add(view, cut, picture)

    def put_on(self, ground: Ground) -> None:
        """Add what it shows to a map."""
        shown = self._score > -np.inf
        if not shown.any():
            return
        R, center = self._world
        assumed = self._assumed[shown]
        points = self._rays[shown] * assumed[:, None] @ R + center
        ground.add_points(points, self._reasons[shown], assumed, np.float64(_focal(self.lens)))

    def facts(self, images_shown: int) -> ImageFacts:
        """What is known of it, with the pictures of one of so many images; shares are of what its views show."""
        shown = self._score > -np.inf
        counts = np.bincount(self._reasons[shown], minlength=len(Reason))
        number = max(int(shown.sum()), 1)
        confirmed = self._confirmed[shown & (self._confirmed > 0)]
        return ImageFacts(
            self.name,
            tuple((counts / number).tolist()),
            int(self._found[shown].sum()) / max(number - int(counts[Reason.OUTSIDE]), 1),
            float(np.median(confirmed) / _focal(self.lens)) if len(confirmed) else None,
            self._has_maps,
            self._pictures(shown, images_shown) if self.with_pictures else (),
            None,
            self.lens.width,
            self.lens.height,
            tuple(self._views),
        )

    def _pictures(self, shown: NDArray[np.bool_], images_shown: int) -> tuple[Picture, ...]:
        parts: dict[str, Bytes] = {}
        note = ""
        if self._picture is not None and self._picture.is_begun:
            parts["picture"] = self._picture.pixels
        if self._has_maps:
            parts["depth"], ends = depth_picture(self._drawn.reshape(self._shape))
            note = "" if ends is None else f"range {ends[0]:.4g} (yellow) to {ends[1]:.4g} (blue)"
        if self._normals is not None and self._normals.any():
            parts["normals"] = normal_picture(self._normals.reshape(3, *self._shape))
        reasons = reason_picture(self._reasons.reshape(self._shape))
        parts["reasons"] = uncovered(reasons, ~shown.reshape(self._shape))
        return make_pictures(parts, self.lens, images_shown, note)


class _Painting:
    """The picture of a wide image, put together from those of its views."""

    def __init__(self, lens: Lens, longest: float) -> None:
        scale = min(longest / max(lens.width, lens.height), 1.0)
        height, width = (max(round(scale * side), 1) for side in (lens.height, lens.width))
        x = (np.arange(width) + 0.5) * lens.width / width
        y = (np.arange(height) + 0.5) * lens.height / height
        self._rays = _rays(lens, tuple(x.tolist()), tuple(y.tolist()))
        self._focal = scale * _focal(lens)
        self._cosine = np.full(height * width, -np.inf)
        self._pixels = uncovered(np.empty((height, width, 3), np.uint8), np.ones((height, width), bool))
        self.is_begun = False

    @property
    def pixels(self) -> Bytes:
        """(h, w, 3): red, green and blue; dark where no view shows anything."""
        return self._pixels

    def add(self, view: View, cut: Cut, picture: Bytes) -> None:
        """Add the pixels whose rays are nearest to a view's axis."""
        self.is_begun = True
        seen, cosines, places = _places(view, cut, self._rays)
        better = cosines > self._cosine[seen]
        own = seen[better]
        if not len(own):
            return
        self._cosine[own] = cosines[better]
        # Of as many pixels per degree, so that none of the view's is passed over.
        scale = np.clip(self._focal / (view.K[0, 0] * picture.shape[1] / view.width), 0.0, 1.0)
        size = [max(round(scale * side), 1) for side in picture.shape[1::-1]]
        small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)[:, :, ::-1]
        x, y = (places[better] * size / (view.width, view.height)).astype(np.int64).T
        self._pixels.reshape(-1, 3)[own] = small[np.minimum(y, size[1] - 1), np.minimum(x, size[0] - 1)]


def _places(view: View, cut: Cut, rays: Float, first: float = 0.0) -> tuple[NDArray[np.int64], Float, Float]:
    """Which rays (n, 3) of the image's camera a view shows; their cosines to its axis, and places (m, 2) in it.

    `first` is where its left and upper borders lie.
    """
    local = rays @ cut.face.R.T
    ahead = np.flatnonzero(local[:, 2] > _LEAST_COSINE)  # a ray that is not known (NaN) is not ahead
    local = local[ahead]
    places = (local @ view.K.T)[:, :2] / local[:, 2:]
    x, y = places.T
    inside = (x >= first) & (x <= view.width + first) & (y >= first) & (y <= view.height + first)
    return ahead[inside], local[inside, 2], places[inside]


def _focal(lens: Lens) -> float:
    """Pixels per radian in the middle of the image; 0 of what is no lens, as a stranger's table may say."""
    with np.errstate(all="ignore"):
        focal = focal_length(lens)
    return focal if np.isfinite(focal) and focal > 0 else 0.0


@lru_cache(maxsize=4)
def _rays(lens: Lens, x: tuple[float, ...], y: tuple[float, ...]) -> Float:
    """(h w, 3) unit rays of a grid of image coordinates; NaN where the lens shows nothing, or is none."""
    with np.errstate(all="ignore"):
        if not _focal(lens) > 0:
            return np.full((len(x) * len(y), 3), np.nan)
        grid = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
        rays = camera_rays(lens, grid)
    rays[~np.isfinite(rays).all(axis=1)] = np.nan
    return rays
