"""The geometry of a rectified pair, and what matching finds for it.

Rectified frame: x along the baseline from the left to the right centre, z towards the scene. On the sphere
(Elhashash & Qin, §3.2, after their swap of axes) the ray of a rectified pixel is

    (sin θ, cos θ sin λ, cos θ cos λ),   λ = row angle about the baseline, θ = angle inside the epipolar plane

and a point seen at θ_l and θ_r has the parallax angle δ = θ_l − θ_r > 0. Rows are equal steps of λ, columns equal
steps of tan(κθ) / κ, with κ the pair's flatness, see `columns_of_angles`. On the plane ("frame", §3.1) the ray is
(x, y, 1) and the parallax x_l − x_r = baseline / Z. Both are described by one record, `RectifiedPair`:
array coordinate = (what its steps are equal of) · scale − origin, with pixel centres at whole array coordinates.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View

Surface = Literal["spherical", "frame"]
"""What both images of a pair are resampled to: a sphere around the baseline, or a plane parallel to it."""

Side = Literal["left", "right"]

Float = NDArray[np.float64]
# Sharp images are sampled with about a column per pixel or more, soft ones with fewer.
_FINE = 0.7
# Farther from the perpendicular to the baseline, surfaces are stretched, and windows on them do not look alike.
_FARTHEST = math.radians(75)


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """Geometry of a rectified pair, without its pixels.

    Attributes
    ----------
    surface : {"spherical", "frame"}
        What its images are resampled to: the sphere, or the plane.
    rectified_from_world : (3, 3) float64 ndarray
        Rotation to the rectified frame.
    baseline : float
        Distance of the projection centres, model units.
    columns_per_radian, rows_per_radian : float
        Scale of the sphere, of columns at θ = 0; both the focal length in pixels on the plane.
    row_origin, left_origin, right_origin : float
        What rows, and each image's columns, are equal steps of, times scale, at array coordinate 0.
    height, left_width, right_width : int
        Sizes of the rectified images.
    min_disparity, max_disparity : float
        Range to search, in array coordinates: column in the left image minus column in the right image.
    flatness : float
        κ of the sphere's columns, 0 to 1; 0 on the plane.
    """

    surface: Surface
    rectified_from_world: Float
    baseline: float
    columns_per_radian: float
    rows_per_radian: float
    row_origin: float
    left_origin: float
    right_origin: float
    height: int
    left_width: int
    right_width: int
    min_disparity: float
    max_disparity: float
    flatness: float = 0.0

    def resampled(self, factor: float) -> "RectifiedPair":
        """The same pair with so many times the rows and columns."""
        return replace(
            self,
            columns_per_radian=self.columns_per_radian * factor,
            rows_per_radian=self.rows_per_radian * factor,
            row_origin=self.row_origin * factor,
            left_origin=self.left_origin * factor,
            right_origin=self.right_origin * factor,
            height=math.ceil((self.height - 1) * factor) + 1,
            left_width=math.ceil((self.left_width - 1) * factor) + 1,
            right_width=math.ceil((self.right_width - 1) * factor) + 1,
            min_disparity=self.min_disparity * factor,
            max_disparity=self.max_disparity * factor,
        )

    @property
    def scales(self) -> tuple[float, float]:
        """Columns and rows per radian half-way between the angles of the left image's first and last columns."""
        if self.surface == "frame":
            return self.columns_per_radian, self.rows_per_radian
        ends = np.array([self.left_origin, self.left_origin + self.left_width - 1]) / self.columns_per_radian
        angle = float(angles_of_columns(ends, self.flatness).mean())
        columns = self.columns_per_radian / math.cos(self.flatness * angle) ** 2
        return columns, self.rows_per_radian / math.cos(angle)

    @property
    def farthest_angle(self) -> float:
        """Largest angle between a ray of either image and the perpendicular to the baseline, radians.

        On the plane, which has no epipoles, zero.
        """
        if self.surface == "frame":
            return 0.0
        ends = [
            self.column_origin(side) + column for side in ("left", "right") for column in (0, self.width(side) - 1)
        ]
        angles = angles_of_columns(np.array(ends) / self.columns_per_radian, self.flatness)
        return float(np.abs(angles).max())

    @property
    def disparity_origin(self) -> float:
        """Parallax in pixels at disparity 0."""
        return self.left_origin - self.right_origin

    def width(self, side: Side) -> int:
        """Columns of one of the two images."""
        return self.left_width if side == "left" else self.right_width

    def column_origin(self, side: Side) -> float:
        """Column origin of one of the two images."""
        return self.left_origin if side == "left" else self.right_origin


def ray_angles(rays: Float) -> tuple[Float, Float]:
    """(n,) angles λ and θ, radians, of (n, 3) rays in the rectified frame."""
    return np.arctan2(rays[:, 1], rays[:, 2]), np.arctan2(rays[:, 0], np.hypot(rays[:, 1], rays[:, 2]))


def columns_of_angles(angles: Float, flatness: float) -> Float:
    """What the sphere's columns are equal steps of: tan(κθ) / κ of (n,) angles θ, radians, with κ the flatness.

    With 0 these are the angles themselves (Elhashash & Qin, §3.2). With 1 they are tangents, which go evenly along
    any surface that is parallel to the baseline. Half-way, with κ² = 1/2, they are about cos θ apart up
    to 60°, as rows are everywhere.
    """
    return np.asarray(np.tan(flatness * angles) / flatness) if flatness > 0 else angles


def angles_of_columns(along: Float, flatness: float) -> Float:
    """(n,) angles θ, radians: the inverse of `columns_of_angles`."""
    return np.asarray(np.arctan(flatness * along) / flatness) if flatness > 0 else along


def pixel_from_rectified_ray(view: View, pair: RectifiedPair) -> Float:
    """(3, 3) matrix from a ray in the rectified frame to the homogeneous pixel of `view`."""
    return np.asarray(view.K @ view.R @ pair.rectified_from_world.T)


def rectified_ray_from_pixel(view: View, pair: RectifiedPair) -> Float:
    """(3, 3) matrix from (col, row, 1) of `view` to the ray of depth 1 in the rectified frame."""
    return np.asarray(pair.rectified_from_world @ view.R.T @ view.inverse_K)


def is_fine(view: View, pair: RectifiedPair) -> bool:
    """Whether both images show fine texture alike: sampled about as finely as the left one, far from epipoles."""
    columns, _ = pair.scales
    return columns >= _FINE * float(view.K[0, 0]) and pair.farthest_angle <= _FARTHEST


def coordinates_of_rays(pair: RectifiedPair, side: Side, rays: Float) -> Float:
    """(n, 2) columns and rows, rectified array coordinates, of (n, 3) rays in the rectified frame."""
    if pair.surface == "spherical":
        across, angles = ray_angles(rays)
        along = columns_of_angles(angles, pair.flatness)
    else:
        along, across = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    return np.column_stack(
        [
            along * pair.columns_per_radian - pair.column_origin(side),
            across * pair.rows_per_radian - pair.row_origin,
        ]
    )


def rectified_coordinates(view: View, pair: RectifiedPair, side: Side, pixels: Float) -> Float:
    """(n, 2) columns and rows, rectified array coordinates, of (n, 2) image coordinates."""
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ rectified_ray_from_pixel(view, pair).T
    return coordinates_of_rays(pair, side, rays)


def rays_of_coordinates(pair: RectifiedPair, side: Side, places: NDArray[np.floating]) -> Float:
    """(3, n) rays in the rectified frame of (n, 2) columns and rows, rectified array coordinates."""
    along = (places[:, 0].astype(float) + pair.column_origin(side)) / pair.columns_per_radian
    across = (places[:, 1].astype(float) + pair.row_origin) / pair.rows_per_radian
    if pair.surface == "spherical":
        angles = angles_of_columns(along, pair.flatness)
        return np.stack([np.sin(angles), np.cos(angles) * np.sin(across), np.cos(angles) * np.cos(across)])
    return np.stack([along, across, np.ones_like(along)])


def image_coordinates(view: View, pair: RectifiedPair, side: Side, places: NDArray[np.floating]) -> Float:
    """(n, 2) image coordinates of (n, 2) columns and rows, rectified array coordinates."""
    pixels = pixel_from_rectified_ray(view, pair) @ rays_of_coordinates(pair, side, places)
    return np.asarray((pixels[:2] / pixels[2]).T)


@dataclass(frozen=True, eq=False)
class PairDisparity:
    """What matching found for a rectified pair.

    Attributes
    ----------
    left, right : str
        Image names; of a photograph that was cut into several views the name of the first of them.
    geometry : RectifiedPair
    disparity : (H, W_left) float32 ndarray
        Disparity of the left image's pixels; NaN = none.
    """

    left: str
    right: str
    geometry: RectifiedPair
    disparity: NDArray[np.float32]
