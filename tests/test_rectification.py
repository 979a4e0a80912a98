"""Rectified pairs against projected points, analytic images and rendered scenes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from refusals import assert_refused
from rendered import (
    SIDES,
    array_coordinates,
    disparities,
    grey,
    pixel_rays,
    project,
    scene_of_pair,
    source_pixels,
    surface_points,
)

from colmap_sph import synthetic as syn
from colmap_sph.errors import RectificationError
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import (
    RectifiedPair,
    is_fine,
    pixel_from_rectified_ray,
    rectified_ray_from_pixel,
)
from colmap_sph.stereo.resampling import resample

SPHERE = RectificationOptions()
FRAME = RectificationOptions(surface="frame")
ANGLES = RectificationOptions(columns="angles")
SURFACES = {"spherical": SPHERE, "equal angles": ANGLES, "frame": FRAME}
every_surface = pytest.mark.parametrize("options", SURFACES.values(), ids=SURFACES)


# ---- pairs in front of a cloud of points -------------------------------------------------------------------


def camera(eye, target=(0, 0, 10), roll=0.0, size=(320, 240), focal=(300.0, 300.0), centre=(0.5, 0.5)):
    """R, t, K, size of a camera; the roll is about its axis, degrees."""
    R, t = syn.look_at(eye, target, up=(0, -1, 0))
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    K = np.array([[focal[0], 0, centre[0] * size[0]], [0, focal[1], centre[1] * size[1]], [0, 0, 1.0]])
    return turn @ R, turn @ t, K, size


PAIRS = {
    "parallel": (camera((-0.5, 0, 0), (-0.5, 0, 10)), camera((0.5, 0, 0), (0.5, 0, 10))),
    "convergent": (camera((-2, 0.3, 0)), camera((2.5, -0.4, 0.5))),
    "vertical": (camera((0, -1, 0)), camera((0.1, 1.2, 0))),
    "strongly convergent": (camera((-6, 0, 2)), camera((6, 1, 3))),
    "forward": (camera((0, 0, -2)), camera((0, 0, 0))),
    "backward": (camera((0, 0, 0)), camera((0, 0, -2))),
    "epipole inside": (camera((0, 0, -2), (0.3, 0.2, 10)), camera((0.3, -0.2, 0), (-0.4, 0, 10))),
    "epipole near the border": (camera((0, 0, -2)), camera((0.99, 0.2, 0), (1.2, 0, 10))),
    "epipole in one image only": (camera((-1, 0, -3), (1, 0, 10)), camera((0, 0, 0), (-2.8, 0, 10))),
    "rolled by 180 degrees": (camera((-1, 0, 0)), camera((1, 0.2, 0), roll=180)),
    "rolled by 90 degrees": (camera((-1, 0, 0), roll=90), camera((1, 0.2, 0), roll=-90)),
    "portrait and landscape": (camera((-1, 0, 0), size=(240, 320)), camera((1, 0.2, 0), roll=90)),
    "unlike cameras": (
        camera((-1, 0, 0), focal=(310, 285), centre=(0.45, 0.56)),
        camera((1, 0.5, 1), size=(401, 299), focal=(510, 530), centre=(0.52, 0.47)),
    ),
}
POINTS = np.random.default_rng(5).uniform([-4, -3, 7], [4, 3, 13], (500, 3))


def view_of(k, pose, points):
    R, t, K, size = pose
    view = View(k, f"{k}", size[0], size[1], K, R, t, np.zeros(0, dtype=np.int64))
    pixel, depth = project(view, points)
    seen = (depth > 0) & (pixel > 0).all(axis=1) & (pixel < size).all(axis=1)
    return replace(view, point_indices=np.flatnonzero(seen))


def scene_of(cameras, points=POINTS):
    views = tuple(view_of(k + 1, pose, points) for k, pose in enumerate(cameras))
    return Scene(views, points)


def rectify_views(scene, options):
    left, right = scene.views
    return rectify_pair(scene, left, right, options)


# One viewing ray at least runs along the baseline: no plane parallel to it holds these.
WITHOUT_PLANE = {
    "forward",
    "backward",
    "epipole inside",
    "epipole near the border",
    "epipole in one image only",
}
CASES = [
    (name, surface) for surface in SURFACES for name in PAIRS if surface != "frame" or name not in WITHOUT_PLANE
]


def rectified(name, surface, swapped=False):
    """(left, right, pair, points that both images hold)."""
    scene = scene_of(PAIRS[name])
    left, right = scene.views[::-1] if swapped else scene.views
    points = scene.points[np.intersect1d(left.point_indices, right.point_indices)]
    return left, right, rectify_pair(scene, left, right, SURFACES[surface]), points


every_case = pytest.mark.parametrize(("name", "surface"), CASES)
both_orders = pytest.mark.parametrize("swapped", [False, True], ids=["", "swapped"])


@every_case
@both_orders
def test_a_point_has_the_same_row_in_both_images(name, surface, swapped):
    """From a point's two pixels: the same row, and a disparity that is its parallax."""
    left, right, pair, points = rectified(name, surface, swapped)
    assert len(points) > 50
    positions = []
    for view, side in zip((left, right), SIDES, strict=True):
        pixel, depth = project(view, points)
        rays = np.column_stack([pixel, np.ones(len(pixel))]) @ rectified_ray_from_pixel(view, pair).T
        # The ray has depth 1 in its camera: times the depth it ends at the point.
        world = view.center + (rays * depth[:, None]) @ pair.rectified_from_world
        np.testing.assert_allclose(world, points, atol=1e-10)
        positions.append(array_coordinates(pair, side, rays @ pair.rectified_from_world))
    np.testing.assert_allclose(positions[0][1], positions[1][1], atol=1e-6)
    columns = [
        (position[0] + origin) / pair.columns_per_radian
        for position, origin in zip(positions, (pair.left_origin, pair.right_origin), strict=True)
    ]
    if pair.flatness:
        columns = [np.arctan(pair.flatness * column) / pair.flatness for column in columns]
    parallax = columns[0] - columns[1]
    to_left, to_right = points - left.center, points - right.center
    if surface != "frame":
        cosine = (to_left * to_right).sum(axis=1)
        sine = np.linalg.norm(np.cross(to_left, to_right), axis=1)
        np.testing.assert_allclose(parallax, np.arctan2(sine, cosine), atol=1e-9)
    else:
        depth = to_left @ pair.rectified_from_world[2]
        np.testing.assert_allclose(parallax, pair.baseline / depth, atol=1e-9)


@every_case
@both_orders
def test_every_common_point_lies_in_both_rectified_images(name, surface, swapped):
    left, right, pair, points = rectified(name, surface, swapped)
    disparity, columns, rows = disparities(pair, left, right, points)
    searched = (disparity >= pair.min_disparity) & (disparity <= pair.max_disparity)
    assert searched.mean() > 0.98
    x = (pair.rectified_from_world @ (points - left.center).T)[0] / np.linalg.norm(points - left.center, axis=1)
    x2 = (pair.rectified_from_world @ (points - right.center).T)[0] / np.linalg.norm(points - right.center, axis=1)
    off_epipole = np.maximum(np.abs(x), np.abs(x2)) < np.sqrt(1 - SPHERE.min_cosine**2)
    kept = searched & (off_epipole | (surface == "frame"))
    assert kept.mean() > 0.85
    columns, rows, right_columns = columns[kept], rows[kept], (columns - disparity)[kept]
    assert columns.min() >= -0.5 and columns.max() <= pair.left_width - 0.5
    assert right_columns.min() >= -0.5 and right_columns.max() <= pair.right_width - 0.5
    assert rows.min() >= -0.5 and rows.max() <= pair.height - 0.5


@every_case
def test_the_rectified_frame_is_a_rotation_along_the_baseline(name, surface):
    left, right, pair, _ = rectified(name, surface)
    rotation = pair.rectified_from_world
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    baseline = right.center - left.center
    assert pair.baseline == pytest.approx(np.linalg.norm(baseline))
    np.testing.assert_allclose(rotation @ baseline, [pair.baseline, 0, 0], atol=1e-12)


@every_case
def test_pixels_and_rays_are_each_others_inverse(name, surface):
    left, right, pair, _ = rectified(name, surface)
    for view in (left, right):
        identity = pixel_from_rectified_ray(view, pair) @ rectified_ray_from_pixel(view, pair)
        np.testing.assert_allclose(identity, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("name", ["parallel", "convergent", "vertical", "rolled by 180 degrees", "unlike cameras"])
@every_surface
def test_sampling_follows_the_finer_image(name, options):
    """In the middle of the overlap a rectified pixel is as large as a pixel of the finer image."""
    scene = scene_of(PAIRS[name])
    middle = POINTS.mean(axis=0)
    for sampling in (0.5, 1.0):
        pair = rectify_views(scene, replace(options, sampling=sampling))
        areas = []
        for view, side in zip(scene.views, ("left", "right"), strict=True):
            x, y = project(view, middle[None])[0][0]
            columns, rows = array_coordinates(
                pair, side, pixel_rays(view, [x - 0.5, x + 0.5, x, x], [y, y, y - 0.5, y + 0.5])
            )
            step = np.array([columns[1::2] - columns[::2], rows[1::2] - rows[::2]])
            areas.append(abs(np.linalg.det(step)))
        finest = min(areas)
        assert 0.7 * sampling**2 < finest < 1.7 * sampling**2


def stretched(surface, name, directions):
    """Columns in the right image to one in the left, of short steps from points in the directions, world frame."""
    left, right, pair, points = rectified(name, surface)
    angles = [np.arcsin(pair.rectified_from_world[0] @ unit.T) for unit in directions_to(points, left, right)]
    points = points[np.abs(angles).max(axis=0) < np.radians(50)]
    step = 1e-4 * directions(points, left, right)
    ends = [disparities(pair, left, right, points + side * step) for side in (-1, 1)]
    in_left, in_right = (np.subtract(*ends_of) for ends_of in zip(*((x, x - d) for d, x, _ in ends), strict=True))
    assert len(points) > 50
    return in_right / in_left


def directions_to(points, left, right):
    """Unit vectors from both centres to points."""
    away = [points - view.center for view in (left, right)]
    return [vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in away]


@pytest.mark.parametrize("name", ["convergent", "vertical", "strongly convergent"])
def test_what_faces_both_images_alike_looks_alike(name):
    """Columns are cos θ apart, within 4 % up to 50°."""

    def along_surface(points, left, right):
        to_left, to_right = directions_to(points, left, right)
        return to_left - to_right

    assert np.abs(stretched("spherical", name, along_surface) - 1).max() < 0.04


@pytest.mark.parametrize("name", ["convergent", "vertical", "strongly convergent"])
def test_surfaces_parallel_to_the_baseline_are_stretched_half_as_much_as_by_equal_angles(name):
    def along_baseline(points, left, right):
        return np.broadcast_to(right.center - left.center, points.shape)

    by_angles, flat = (
        np.log(stretched(surface, name, along_baseline)) for surface in ("equal angles", "spherical")
    )
    assert np.abs(flat - by_angles / 2).max() < 0.04


@pytest.mark.parametrize("name", PAIRS)
def test_flat_columns_cost_no_left_pixels(name):
    """The left image has as many as equal angles give what it shows, at as many pixels per radian."""
    _, _, pair, _ = rectified(name, "spherical")
    _, _, by_angles, _ = rectified(name, "equal angles")
    ends = [
        (np.array([0, width - 1]) + origin) / pair.columns_per_radian
        for width, origin in ((pair.left_width, pair.left_origin), (pair.right_width, pair.right_origin))
    ]
    angles = np.arctan(pair.flatness * np.array(ends)) / pair.flatness
    nearest = [0 if low < 0 < high else min(abs(low), abs(high)) for low, high in angles]
    scale = by_angles.columns_per_radian
    rows = (pair.height - 1) / pair.rows_per_radian * scale * np.cos(min(nearest))
    columns = np.ptp(angles[0]) * scale
    assert pair.height * pair.left_width == pytest.approx(rows * columns, rel=0.05)


@pytest.mark.parametrize("name", PAIRS)
def test_pairs_are_fine_where_they_are_sampled_so_and_no_epipole_is_near(name):
    left, right, pair, _ = rectified(name, "spherical")
    borders = []
    for view in (left, right):
        x, y = np.meshgrid(np.linspace(0, view.width, 50), np.linspace(0, view.height, 50))
        rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1) @ np.linalg.inv(view.K).T @ view.R
        borders.append(np.abs(rays @ (right.center - left.center)) / np.linalg.norm(rays, axis=1))
    farthest = np.degrees(np.arcsin(np.max(borders) / np.linalg.norm(right.center - left.center)))
    assert is_fine(left, pair) == (farthest < 75)
    assert not is_fine(left, pair.resampled(0.3))


def test_columns_go_by_angles_where_points_do_not_tell():
    scene = scene_of(PAIRS["convergent"], POINTS[:20])
    assert rectify_views(scene, SPHERE).flatness > 0
    for points in (POINTS[:7], POINTS[:0]):
        assert rectify_views(scene_of(PAIRS["convergent"], points), SPHERE).flatness == 0


# ---- resampling --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "surface"),
    [
        ("convergent", "spherical"),
        ("convergent", "frame"),
        ("epipole inside", "spherical"),
        ("rolled by 90 degrees", "frame"),
        ("portrait and landscape", "spherical"),
    ],
)
def test_resampling_reads_the_right_place(name, surface):
    """A picture whose grey value is its column (or row) shows where every rectified pixel comes from.

    The first pixel's centre is (0.5, 0.5): the grey value at x is x − 0.5. Half a pixel off would be seen.
    """
    left, right, pair, _ = rectified(name, surface)
    for view, side in zip((left, right), SIDES, strict=True):
        x, y, _ = source_pixels(view, pair, side)
        row_grid, column_grid = np.indices((view.height, view.width))
        for grid, place in ((column_grid, x), (row_grid, y)):
            picture = np.minimum(grid, 255).astype(np.uint8)
            rectified_picture, valid = resample(picture, view, pair, side)
            inner = (valid > 0) & (x > 1) & (x < view.width - 1) & (y > 1) & (y < view.height - 1)
            inner &= place < 255
            error = rectified_picture[inner].astype(float) - (place[inner] - 0.5)
            assert inner.sum() > 1000
            assert np.abs(error).max() < 0.001  # not rounded to grey values, nor to parts of pixels
            assert abs(error.mean()) < 0.02


@every_case
def test_valid_pixels_are_those_inside_the_image(name, surface):
    left, right, pair, _ = rectified(name, surface)
    for view, side in zip((left, right), SIDES, strict=True):
        _, valid = resample(np.zeros((view.height, view.width), np.uint8), view, pair, side)
        assert valid.shape == (pair.height, pair.width(side))
        assert set(np.unique(valid)) <= {0, 255} and valid.any()
        x, y, depth = source_pixels(view, pair, side)
        margin = np.minimum(np.minimum(x, view.width - x), np.minimum(y, view.height - y))
        inside = (depth > 0) & (margin > 0)
        clear = np.abs(margin) > 1e-3  # the maps are float32
        np.testing.assert_array_equal((valid > 0)[clear], inside[clear])


def test_the_back_of_the_sphere_shows_nothing():
    """Rays behind the camera project into the image too, but are not seen."""
    view = view_of(1, camera((0, 0, 0)), POINTS)
    scale = 40.0
    pair = RectifiedPair(
        "spherical", np.eye(3), 1.0, scale, scale, -np.pi * scale, -1.5 * scale, 0.0, 252, 121, 121, 0.0, 1.0
    )
    _, valid = resample(np.zeros((view.height, view.width), np.uint8), view, pair, "left")
    x, y, depth = source_pixels(view, pair, "left")
    in_rectangle = (x > 0) & (x < view.width) & (y > 0) & (y < view.height)
    assert (in_rectangle & (depth < 0)).sum() > 100
    np.testing.assert_array_equal(valid > 0, in_rectangle & (depth > 0))


def test_rows_go_on_past_the_seam():
    """With the epipole inside both images all epipolar planes are there, a band of them twice."""
    left, _, pair, _ = rectified("epipole inside", "spherical")
    turn = 2 * np.pi * pair.rows_per_radian
    assert pair.height > turn + 40
    x, y, depth = source_pixels(left, pair, "left")
    seam = (pair.height - turn) / 2
    picture = np.tile(np.minimum(np.arange(left.width), 255), (left.height, 1)).astype(np.uint8)
    image, valid = resample(picture, left, pair, "left")
    for row in range(2, int(2 * seam) - 3):
        again = row + turn
        below, share = int(again), again % 1
        both = (valid[[row, below, below + 1]] > 0).all(axis=0) & (depth[row] > 0)
        expected = (1 - share) * image[below].astype(float) + share * image[below + 1]
        assert np.abs(image[row] - expected)[both].max(initial=0) < 2
    assert np.isfinite(x[depth > 0]).all() and np.isfinite(y[depth > 0]).all()


# ---- what cannot be ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(WITHOUT_PLANE))
def test_the_plane_refuses_motion_along_the_view(name):
    scene = scene_of(PAIRS[name])
    with pytest.raises(RectificationError):
        rectify_views(scene, FRAME)


@every_surface
def test_identical_centres_are_refused(options):
    pair = (camera((0, 0, 0)), camera((0, 0, 0), (1, 0, 10)))
    with pytest.raises(RectificationError, match="same projection centre"):
        rectify_views(scene_of(pair), options)
    without_points = scene_of(pair, np.zeros((0, 3)))
    with pytest.raises(RectificationError, match="same projection centre"):
        rectify_views(without_points, options)


@every_surface
@pytest.mark.parametrize(
    "pair",
    [
        (camera((-1, 0, 0), (-9, 0, 4)), camera((1, 0, 0), (9, 0, 4))),
        (camera((-1, 0, 0), (0, -9, 4)), camera((1, 0, 0), (0, 9, 4))),
        (camera((0, 0, 1), (0, 0, 10)), camera((0, 0, 0), (0, 0, -10))),
    ],
    ids=["looking apart sideways", "looking apart up and down", "back to back"],
)
@pytest.mark.parametrize("points", [POINTS, np.zeros((0, 3))], ids=["points", "no points"])
def test_images_without_overlap_are_refused(pair, options, points):
    scene = scene_of(pair, points)
    with pytest.raises(RectificationError):
        rectify_views(scene, options)


@every_surface
def test_a_pair_without_sparse_points_searches_a_wide_range(options):
    scene = scene_of(PAIRS["convergent"], np.zeros((0, 3)))
    pair = rectify_views(scene, options)
    disparity, _, _ = disparities(pair, scene.views[0], scene.views[1], POINTS)
    assert ((disparity > pair.min_disparity) & (disparity < pair.max_disparity)).all()


@every_case
def test_sizes_are_bounded(name, surface):
    left, right, pair, _ = rectified(name, surface)
    pixels = pair.height * (pair.left_width + pair.right_width)
    originals = left.width * left.height + right.width * right.height
    assert pixels <= SPHERE.max_pixels_ratio * originals
    assert min(pair.height, pair.left_width, pair.right_width) >= 16


def test_images_beyond_the_bound_are_refused():
    scene = scene_of(PAIRS["convergent"])
    with pytest.raises(RectificationError, match="times the pixels"):
        rectify_views(scene, RectificationOptions(max_pixels_ratio=0.5))


def test_sides_beyond_what_can_be_resampled_are_refused():
    large = [camera(eye, size=(16000, 12000), focal=(8000, 8000)) for eye in ((0, 0, -2), (0.3, -0.2, 0))]
    scene = scene_of(large)
    with pytest.raises(RectificationError, match="rows or columns"):
        rectify_views(scene, SPHERE)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("surface", "cylindrical"),
        ("columns", "tangents"),
        *[("sampling", value) for value in (0.0, 0.04, 4.1, np.nan, np.inf, -1.0)],
        *[("min_cosine", value) for value in (0.0, 0.95, np.nan)],
        *[(name, value) for name in ("near_margin", "far_margin") for value in (0.9, 21.0, np.nan)],
        *[("max_pixels_ratio", value) for value in (0.5, 101.0, np.nan)],
    ],
)
def test_options_out_of_bounds_are_refused(name, value):
    RectificationOptions().check()
    assert_refused(RectificationOptions(**{name: value}), name)


# ---- rendered scenes ---------------------------------------------------------------------------------------

RENDERED = {
    "convergent": syn.convergent_pair(20.0, focal_length=200.0, size=(160, 120)),
    "widely convergent": syn.convergent_pair(60.0, focal_length=200.0, size=(160, 120)),
    "forward": syn.forward_motion_pair(1.0, focal_length=160.0, size=(160, 120)),
    "epipole inside": syn.epipole_inside_pair(1.0, focal_length=160.0, size=(160, 120)),
    "slanted": syn.slanted_plane_pair(50.0, 30.0, focal_length=200.0, size=(160, 120)),
}


def covisible_points(pair, scene):
    """Surface points at the left pixels' centres which the right camera sees too."""
    left, right = scene.views
    depth, _, _ = syn.exact_geometry(pair.surfaces, pair.left, origin=0.5)
    points = surface_points(left, depth, 0.5)[depth > 0]
    pixel, depth = project(right, points)
    seen = (depth > 0) & (pixel > 0).all(axis=1) & (pixel < [right.width, right.height]).all(axis=1)
    points, pixel, depth = points[seen], pixel[seen], depth[seen]
    nearest = syn.trace_points(pair.surfaces, pair.right, pixel).distance
    return points[np.abs(nearest - depth) < 1e-6 * depth]


@pytest.mark.parametrize("name", RENDERED)
def test_searched_disparities_cover_what_both_images_see(name):
    scene, left, right = scene_of_pair(RENDERED[name])
    pair = rectify_pair(scene, left, right, SPHERE)
    points = covisible_points(RENDERED[name], scene)
    assert len(points) > 5000
    disparity, columns, _ = disparities(pair, left, right, points)
    away_from_epipole = (columns > -0.5) & (columns < pair.left_width - 0.5)
    covered = (disparity >= pair.min_disparity) & (disparity <= pair.max_disparity)
    assert covered[away_from_epipole].mean() > 0.999


@pytest.mark.parametrize("name", RENDERED)
def test_the_two_rectified_images_show_the_same(name):
    """Grey values of corresponding rectified pixels agree, and agree less a pixel further."""
    scene, left, right = scene_of_pair(RENDERED[name])
    pair = rectify_pair(scene, left, right, SPHERE)
    points = covisible_points(RENDERED[name], scene)
    disparity, columns, rows = disparities(pair, left, right, points)
    images = [
        resample(grey(RENDERED[name].render(side)), view, pair, side)[0]
        for view, side in zip((left, right), SIDES, strict=True)
    ]

    def difference(shift):
        u, v = columns.astype(np.float32)[None], rows.astype(np.float32)[None]
        first = cv2.remap(images[0], u, v, cv2.INTER_LINEAR)
        moved = (columns - disparity + shift).astype(np.float32)[None]
        return np.median(np.abs(first - cv2.remap(images[1], moved, v, cv2.INTER_LINEAR)))

    assert difference(0) < 0.6 * min(difference(-1), difference(1))
    assert difference(0) < min(difference(-0.25), difference(0.25))
