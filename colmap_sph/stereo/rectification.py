"""Image pair → rectified pair: rows are epipolar planes, on a sphere around the baseline or on a plane.

The frame and the layout are those of `rectified_pair` (Elhashash & Qin, §3.1, §3.2): the rotation comes from the
baseline and the viewing directions, the rows from what both images see, the columns from the disparity range.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from colmap_sph.errors import OptionError, RectificationError
from colmap_sph.scene import Photograph, Scene, View, observed_by
from colmap_sph.stereo.disparity_range import (
    MIN_POINTS,
    Range,
    bounded_range,
    columns_with_counterparts,
    few_digits,
    limited_range,
    parallax_range,
    plane_parallaxes,
    sphere_parallaxes,
)
from colmap_sph.stereo.extent import Extent, extent_on_plane, extent_on_sphere, outline_of
from colmap_sph.stereo.partners.frusta import any_sees
from colmap_sph.stereo.photographs.extent import extent_of_photographs, nearer_half
from colmap_sph.stereo.rectified_pair import (
    Float,
    RectifiedPair,
    Surface,
    angles_of_columns,
    columns_of_angles,
    ray_angles,
)

# In units of the depth: a parallax of some hundredths of a pixel, and more than centres on a grid are off.
_LEAST_BASELINE = 1e-5
# In units of the centres' coordinates: some thousands of their last digits.
_ROUNDED_BASELINE = 1e-12
# Of the direction that shall point to the scene so much must be across the baseline, or it tells no roll about it.
_LEAST_ACROSS = 0.2
# cv2.remap takes no more rows or columns.
_MAX_SIDE = 32766
# Rectified pixels per sample that an image's detail asks for, as bilinear resampling takes some of it away and
# windows are of whole pixels; and as many per pixel at most.
_OVERSAMPLING = 1.45
_MOST_SAMPLING = 1.3
# Rays of a view along each side, and depths along each of them, that stand for all between two depths: as many at
# least, and so many that each is at most so many times the one before, but for ranges that mean no limit.
_DEPTH_SAMPLES = 17
_DEPTH_STEP = 1.1
_MOST_DEPTHS = 400
# Of flat columns. With 1 the ground below a flight line looks alike in both images of a pair, and walls do not;
# with this one what faces both images alike does, and pixels are about square wherever they are.
_FLATNESS = math.sqrt(0.5)
# Rows to a column of these amid the points: with 1.25 more is found, and more is wrong, with 1 less (measured).
_ROWS_PER_COLUMN = 1.12
# Fewer rows or columns than this are not worth matching.
_MIN_SIDE = 16


@dataclass(frozen=True)
class RectificationOptions:
    """How pairs are rectified."""

    surface: Surface = "spherical"
    """Surface the images are resampled to: a sphere around the baseline, or a plane (the classic "frame")."""
    sampling: float = 1.0
    """Rectified pixels, as a factor on what the images' detail asks for: 1.3 per pixel where they are sharp, 0.5
    where they are soft."""
    columns: Literal["flat", "angles"] = "flat"
    """How the sphere's columns are spaced: so that surfaces which face both images of a pair alike look the same
    in them, or by equal angles, as in the paper."""
    min_cosine: float = 0.1
    """Rays whose angle with the baseline has a smaller sine than this are left out: at 0.1, within 5.7° of the
    epipole."""
    near_margin: float = 2.0
    """Surfaces are looked for down to the distance of the nearest sparse points divided by this: treetops and
    roofs often carry no sparse point."""
    far_margin: float = 1.5
    """Surfaces are looked for up to the distance of the farthest sparse points times this."""
    min_depth: float = -1.0
    """Least depth to look for, model units, instead of what the sparse points tell; -1: these. Where limits are
    far beyond what these tell, four times as far as they tell is searched."""
    max_depth: float = -1.0
    """Largest depth to look for; goes with `min_depth`. Maps have no other depths then."""
    max_pixels_ratio: float = 8.0
    """A pair is given up when its rectified images have more pixels than this times the originals."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        if self.surface not in ("spherical", "frame"):
            raise OptionError(f"surface must be 'spherical' or 'frame', not {self.surface!r}.", "surface")
        if not 0.05 <= self.sampling <= 4:
            raise OptionError(f"sampling must lie in 0.05..4, not {self.sampling}.", "sampling")
        if self.columns not in ("flat", "angles"):
            raise OptionError(f"columns must be 'flat' or 'angles', not {self.columns!r}.", "columns")
        if not 0.01 <= self.min_cosine <= 0.9:
            raise OptionError(f"min_cosine must lie in 0.01..0.9, not {self.min_cosine}.", "min_cosine")
        for name in ("near_margin", "far_margin"):
            if not 1 <= getattr(self, name) <= 20:
                raise OptionError(f"{name} must lie in 1..20, not {getattr(self, name)}.", name)
        if (self.min_depth, self.max_depth) != (-1.0, -1.0) and not 0 < self.min_depth < self.max_depth < np.inf:
            raise OptionError(
                f"min_depth must be above 0 and less than max_depth, or both must be -1, not {self.min_depth} "
                f"and {self.max_depth}.",
                "min_depth",
                "max_depth",
            )
        if not 1 <= self.max_pixels_ratio <= 100:
            raise OptionError(
                f"max_pixels_ratio must lie in 1..100, not {self.max_pixels_ratio}.", "max_pixels_ratio"
            )

    @property
    def depths(self) -> tuple[float, float] | None:
        """Least and largest depth to look for; None where the sparse points tell."""
        return None if self.max_depth <= 0 else (self.min_depth, self.max_depth)


def sampling_of(detail: float) -> float:
    """Rectified pixels per pixel of an image with this detail, see `image_detail`."""
    return min(_OVERSAMPLING * detail, _MOST_SAMPLING)


def rectify_pair(
    scene: Scene,
    left: View | Photograph,
    right: View | Photograph,
    options: RectificationOptions,
    details: tuple[float, float] | None = None,
    outlines: tuple[Sequence[Float], Sequence[Float]] | None = None,
) -> RectifiedPair:
    """Lay out the rectified images of a pair.

    Parameters
    ----------
    scene : Scene
        For the sparse points, which give the range of parallaxes.
    left, right : View or Photograph
        The pair; which one is called left is free. Where one was cut into several views, the pair has only what
        the left one may see finer.
    options : RectificationOptions
    details : (float, float), optional
        What `image_detail` finds in the left and in the right image. Without it there is a rectified pixel, times
        `sampling`, to a pixel.
    outlines : pair of sequence of (n, 2) float64 ndarray, optional
        Of what is wanted of each view of the left and of the right image, see `extent_on_sphere`.

    Returns
    -------
    RectifiedPair

    Raises
    ------
    RectificationError
        The centres coincide, the images do not overlap, or the chosen surface cannot hold the pair.

    Examples
    --------
    Parallel cameras, 1 unit apart, and points 10 to 20 units away: surfaces at half to one and a half times these
    distances are looked for. On the plane the parallax is baseline over distance.

    >>> import numpy as np
    >>> K = np.array([[500.0, 0, 200], [0, 500, 150], [0, 0, 1]])
    >>> points = np.column_stack([np.zeros((101, 2)), np.linspace(10, 20, 101)])
    >>> left, right = (
    ...     View(k, "ab"[k], 400, 300, K, np.eye(3), np.array([-k, 0, 0]), np.arange(101)) for k in range(2)
    ... )
    >>> pair = rectify_pair(Scene((left, right), points), left, right, RectificationOptions(surface="frame"))
    >>> parallax = np.array([pair.max_disparity, pair.min_disparity]) + pair.disparity_origin
    >>> np.round(pair.baseline / (parallax / pair.columns_per_radian)).tolist()
    [5.0, 30.0]
    """
    baseline = float(np.linalg.norm(right.center - left.center))
    distance = _median_depth(scene, left)
    if not baseline > max(_LEAST_BASELINE * distance, _ROUNDED_BASELINE * float(np.abs(left.center).max())):
        raise RectificationError("the two images have the same projection centre")
    rotation = _rectifying_rotation(left, right)
    points = _points_in_both(scene, left, right)
    extent = _extent(rotation, left, right, options, outlines)
    is_sphere = options.surface == "spherical"
    # A whole sphere goes from epipole to epipole, and without points nobody knows what lies where.
    is_flat = is_sphere and options.columns == "flat" and not _is_cut(left, right) and len(points) >= MIN_POINTS
    flatness = _FLATNESS if is_flat else 0.0

    def parallaxes(of: Float) -> Float:
        if is_sphere:
            return sphere_parallaxes(left, right, extent.rotation, of, flatness)
        return plane_parallaxes(left.views[0], extent.rotation, of, baseline)

    samplings = (1.0, 1.0) if details is None else (sampling_of(details[0]), sampling_of(details[1]))
    scales = _scale(left, points), _scale(right, points)
    scale = options.sampling * max(samplings[0] * scales[0], samplings[1] * scales[1])
    scale = few_digits(scale, np.round)
    margins = options.far_margin, 1 / options.near_margin
    moved = [left.center + margin * (points - left.center) for margin in margins]
    searched = parallax_range(*map(parallaxes, moved))
    if options.depths is not None:
        searched = limited_range(_range_of_depths(left, right, options.depths, parallaxes), searched)
    if _is_cut(left, right):
        extent = replace(extent, columns=(nearer_half(extent.columns[0], searched[1]), extent.columns[1]))
    rays = (points - left.center) @ extent.rotation.T
    pair = _laid_out(options.surface, extent, baseline, scale, searched, flatness, rays)
    _check_size(pair, left, right, options.max_pixels_ratio * max(1.0, scale / max(scales)) ** 2)
    return pair


def _is_cut(left: View | Photograph, right: View | Photograph) -> bool:
    """Whether one of them was cut into several views, so that they may see all around their baseline."""
    return len(left.views) > 1 or len(right.views) > 1


def _median_depth(scene: Scene, photograph: View | Photograph) -> float:
    """Median depth of the points that it observes; their distance, where it was cut up. 0 without any."""
    rays = scene.points[photograph.point_indices] - photograph.center
    is_whole = len(photograph.views) == 1
    depths = rays @ photograph.viewing_direction if is_whole else np.linalg.norm(rays, axis=1)
    return float(np.median(depths)) if len(depths) else 0.0


def _extent(
    rotation: Float,
    left: View | Photograph,
    right: View | Photograph,
    options: RectificationOptions,
    outlines: tuple[Sequence[Float], Sequence[Float]] | None,
) -> Extent:
    """What the images cover of the surface."""
    if outlines is None:
        outlines = ([outline_of(view) for view in left.views], [outline_of(view) for view in right.views])
    if _is_cut(left, right) and options.surface == "spherical":
        return extent_of_photographs(rotation, left, right, options.min_cosine, outlines)
    if _is_cut(left, right):
        raise RectificationError("a plane cannot hold an image that was cut into several views")
    views = (left.views[0], right.views[0])
    if options.surface == "spherical":
        return extent_on_sphere(rotation, *views, options.min_cosine, (outlines[0][0], outlines[1][0]))
    return extent_on_plane(rotation, *views, (outlines[0][0], outlines[1][0]))


def _rectifying_rotation(left: View | Photograph, right: View | Photograph) -> Float:
    """Rotation to the rectified frame (Elhashash & Qin, §3.1, in photogrammetric axes)."""
    r1 = right.center - left.center
    r1 /= np.linalg.norm(r1)
    reference = left.viewing_direction + right.viewing_direction
    across = reference - r1 * (r1 @ reference)
    if np.linalg.norm(across) < _LEAST_ACROSS:
        # Forward motion, or opposite views: the roll about the baseline is free, so take any camera axis.
        axes = left.views[0].R
        across = axes[1] - r1 * (r1 @ axes[1])
        if np.linalg.norm(across) < _LEAST_ACROSS:
            across = axes[0] - r1 * (r1 @ axes[0])
    r3 = across / np.linalg.norm(across)
    return np.stack([r1, np.cross(r3, r1), r3])


def _points_in_both(scene: Scene, left: View | Photograph, right: View | Photograph) -> Float:
    """Sparse points that one of the views observes and both have in view."""
    points = scene.points[observed_by(left, right)[0]]
    for photograph in (left, right):
        points = points[any_sees(photograph, points)]
    return points


def _scale(photograph: View | Photograph, points: Float) -> float:
    """Pixels per radian of an image, averaged over the overlap.

    A pixel at the angle α off axis has the solid angle cos³ α / f², so its mean side is cos^1.5 α / f. Of several
    views a point belongs to the one whose axis is nearest.
    """
    cosine = np.ones(1)
    if len(points):
        cosines = []
        for view in photograph.views:
            rays = points @ view.R.T + view.t
            cosines.append(rays[:, 2] / np.linalg.norm(rays, axis=1))
        cosine = np.max(cosines, axis=0)
    K = photograph.views[0].K
    return float(np.sqrt(K[0, 0] * K[1, 1]) * np.mean(cosine**-1.5))


def _range_of_depths(
    left: View | Photograph,
    right: View | Photograph,
    depths: tuple[float, float],
    parallaxes: Callable[[Float], Float],
) -> Range:
    """Parallaxes of what either view sees between two depths in it, and the other has in view."""
    grid = np.linspace(0, 1, _DEPTH_SAMPLES)
    steps = np.log(depths[1] / depths[0]) / np.log(_DEPTH_STEP)
    number = int(np.clip(np.ceil(steps) + 1, _DEPTH_SAMPLES, _MOST_DEPTHS))
    x, y, depth = np.meshgrid(grid, grid, np.geomspace(*depths, number))
    seen = []
    sights = [(view, other) for own, other in ((left, right), (right, left)) for view in own.views]
    for view, other in sights:
        pixels = np.stack([x.ravel() * view.width, y.ravel() * view.height, np.ones(x.size)], axis=1)
        camera = depth.reshape(-1, 1) * (pixels @ view.inverse_K.T)
        points = (camera - view.t) @ view.R
        seen.append(points[any_sees(other, points)])
    found = parallaxes(np.concatenate(seen))
    if not len(found):
        raise RectificationError("the two images do not overlap at the depths that are asked for")
    return bounded_range(found)


def _scales_on_sphere(
    ends: tuple[Range, Range], scale: float, flatness: float, rays: Float
) -> tuple[float, float]:
    """Columns and rows per radian of images with `scale` pixels per radian.

    `ends` are those of their columns, and `rays` go from the left centre to the sparse points.
    """
    angles = angles_of_columns(np.array(ends), flatness)
    # Meridians are widest apart on the equator: where the images come nearest to it a pixel is a pixel high.
    widest = float(np.cos(min(map(_off_zero, angles.tolist()))))
    if flatness == 0:
        return scale, scale * widest
    seen = ray_angles(rays)[1]
    rows = _ROWS_PER_COLUMN * float(np.median(np.cos(seen) / np.cos(flatness * seen) ** 2))
    rows = few_digits(rows, np.round)
    # As many pixels of the left image, whose matches are searched, as by equal angles.
    shrunk = float(np.ptp(angles[0]) / np.ptp(ends[0]))
    columns = scale * few_digits(float(np.sqrt(widest * shrunk / rows)), np.round)
    return columns, columns * rows


def _laid_out(
    surface: Surface,
    extent: Extent,
    baseline: float,
    scale: float,
    searched: Range,
    flatness: float,
    rays: Float,
) -> RectifiedPair:
    """The rectified images of what can have a counterpart, see `_scales_on_sphere`."""
    least, most = searched
    along = columns_of_angles(np.array(extent.columns), flatness).tolist()
    left, right = columns_with_counterparts(tuple(along[0]), tuple(along[1]), least, most)
    low, high = extent.rows
    rows_per_radian = scale
    if surface == "spherical":
        scale, rows_per_radian = _scales_on_sphere((left, right), scale, flatness, rays)
    return RectifiedPair(
        surface=surface,
        flatness=flatness,
        rectified_from_world=extent.rotation,
        baseline=baseline,
        columns_per_radian=scale,
        rows_per_radian=rows_per_radian,
        row_origin=low * rows_per_radian - extent.seam,
        left_origin=left[0] * scale,
        right_origin=right[0] * scale,
        height=int(np.ceil((high - low) * rows_per_radian)) + 1 + 2 * extent.seam,
        left_width=int(np.ceil((left[1] - left[0]) * scale)) + 1,
        right_width=int(np.ceil((right[1] - right[0]) * scale)) + 1,
        min_disparity=(least - left[0] + right[0]) * scale,
        max_disparity=(most - left[0] + right[0]) * scale,
    )


def _off_zero(values: Range) -> float:
    """Distance of a range from zero."""
    return max(0.0, values[0], -values[1])


def _check_size(pair: RectifiedPair, left: View | Photograph, right: View | Photograph, max_ratio: float) -> None:
    """Raise `RectificationError` where the rectified images are too large or too small."""
    sides = (pair.height, pair.left_width, pair.right_width)
    pixels = pair.height * (pair.left_width + pair.right_width)
    originals = left.num_pixels + right.num_pixels
    if max(sides) > _MAX_SIDE:
        raise RectificationError(f"its rectified images would have more than {_MAX_SIDE} rows or columns")
    if pixels > max_ratio * originals:
        raise RectificationError(
            f"its rectified images would have {pixels / originals:.1f} times the pixels of the originals"
        )
    if min(sides) < _MIN_SIDE:
        raise RectificationError(f"the overlap is less than {_MIN_SIDE} pixels wide")
