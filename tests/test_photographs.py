"""What camera and world do to rendered pictures, against closed formulas and measured on the pictures."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_sph import synthetic as syn
from colmap_sph.errors import OptionError
from colmap_sph.synthetic.photographs import optics
from colmap_sph.synthetic.photographs.moving_things import moving_things
from colmap_sph.synthetic.photographs.structure_from_motion import disturb

WIDTH, HEIGHT = 160, 120
K = np.array([[150.0, 0, 83.0], [0, 150.0, 57.0], [0, 0, 1]])
NOISE = syn.Noise(0.05, seed=3)
GREY = syn.Mottled(NOISE)
UNIFORM = syn.Mottled(NOISE, (0.5, 0.5, 0.5), 0.0)
# The sun stands where it lights what the camera sees.
LIGHT = syn.Light((0.2, -0.3, -1.0))
WALL_DEPTH = 7.0


def wall(material=GREY, half_size=None, x=0.0):
    return syn.Plane((x, 0, WALL_DEPTH), (0, 0, -1), material, half_size)


def camera(centre=(0.0, 0.0, 0.0), R=None):
    R = np.eye(3) if R is None else R
    return syn.Camera(K, R, -R @ np.asarray(centre, float), WIDTH, HEIGHT)


def picture(surfaces, effects=None, number=0, **options):
    effects = effects or syn.Imperfections()
    return syn.photograph(surfaces, camera(), effects, light=LIGHT, number=number, seed=5, **options).image


def pixel_grid():
    return np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)


# ---- light and grey values ---------------------------------------------------------------------------------


def test_without_imperfections_a_photograph_is_the_plain_rendering():
    plain = syn.render([wall()], K, np.eye(3), np.zeros(3), WIDTH, HEIGHT, light=LIGHT, noise=2.0, seed=(5, 4))
    taken = syn.photograph([wall()], camera(), syn.Imperfections(), light=LIGHT, read_noise=2.0, seed=5, number=4)
    for name in ("image", "depth", "normals", "surface"):
        np.testing.assert_array_equal(getattr(taken, name), getattr(plain, name))


@pytest.mark.parametrize(("read", "photon"), [(3.0, 0.0), (0.0, 8.0), (3.0, 8.0)])
def test_noise_has_its_standard_deviation_at_every_brightness(read, photon):
    for level in (30.0, 120.0, 200.0):
        flat = np.full((200, 200, 3), level, np.float32)
        readings = optics.sensor_readings(flat, read, photon, np.random.default_rng(1)).astype(float)
        expected = np.sqrt(read**2 + photon**2 * level / 255 + 1 / 12)
        assert readings.std() == pytest.approx(expected, rel=0.02)
        assert readings.mean() == pytest.approx(level, abs=0.2)


def test_photographs_have_that_noise_and_each_its_own():
    effects = syn.Imperfections(photon_noise=10.0)
    clean = picture([wall(UNIFORM)]).astype(float)
    first, second = (picture([wall(UNIFORM)], effects, number).astype(float) for number in (0, 1))
    expected = np.sqrt(100 * clean.mean(axis=(0, 1)) / 255 + 1 / 12)
    np.testing.assert_allclose(first.std(axis=(0, 1)), expected, rtol=0.03)
    np.testing.assert_allclose((first - second).std(axis=(0, 1)), np.sqrt(2) * expected, rtol=0.03)


def test_exposures_differ_from_image_to_image_by_one_factor_each():
    effects = syn.Imperfections(exposure=0.8)
    plain = picture([wall()]).astype(float)
    factors = []
    for number in range(6):
        exposed = picture([wall()], effects, number).astype(float)
        inside = (exposed > 60) & (exposed < 254) & (plain > 60)
        ratio = exposed[inside] / plain[inside]
        factors.append(np.median(ratio))
        # Both are rounded to whole grey values.
        assert np.abs(ratio / factors[-1] - 1).max() < 1.1 / 60 * 2
        assert factors[-1] == pytest.approx(syn.exposure_gain(effects, 5, number), rel=0.01)
    stops = np.log2(factors)
    assert np.abs(stops).max() <= 0.81
    assert np.ptp(stops) > 0.4


def test_vignetting_leaves_the_middle_and_darkens_the_corners():
    plain = picture([wall(UNIFORM)]).astype(float)
    dark = picture([wall(UNIFORM)], syn.Imperfections(vignetting=0.6)).astype(float)
    share = (dark / plain).mean(axis=2)
    assert share[HEIGHT // 2, WIDTH // 2] == pytest.approx(1.0, abs=0.01)
    assert [share[0, 0], share[-1, -1], share[0, -1]] == pytest.approx([0.4] * 3, abs=0.02)
    # A quarter of the square of the half diagonal, along the middle row.
    assert share[HEIGHT // 2, round(WIDTH * (0.5 + 0.25))] == pytest.approx(1 - 0.6 * 0.16, abs=0.01)


def edge_variance(image, axis):
    """Variance (px²) of the derivative of a step along an axis."""
    profile = image.astype(float).mean(axis=2).mean(axis=1 - axis)
    step = np.abs(np.diff(profile))
    place = np.arange(step.size)
    mean = np.sum(step * place) / step.sum()
    return np.sum(step * (place - mean) ** 2) / step.sum()


@pytest.mark.parametrize(
    ("effects", "variance"),
    [
        (syn.Imperfections(blur=2.0), 4.0),
        # A disc of even density: r² / 4 along each axis.
        (syn.Imperfections(defocus=4.0), 4.0),
    ],
)
def test_a_blurred_edge_is_as_wide_as_its_kernel(effects, variance):
    surfaces = [
        wall(UNIFORM, (3.0, 100.0), x=-3.0),
        syn.Plane((0, 0, 9), (0, 0, -1), syn.Mottled(NOISE, (0.1,) * 3, 0.0)),
    ]
    added = edge_variance(picture(surfaces, effects), 1) - edge_variance(picture(surfaces), 1)
    assert added == pytest.approx(variance, rel=0.06)


@pytest.mark.parametrize("direction", [0.0, 0.6, np.pi / 2])
def test_shake_smears_along_its_direction_alone(direction):
    step = np.zeros((60, 60, 3), np.float32)
    step[:, 30:] = 200
    smeared = optics.smeared(step, 9.0, direction)
    # An even density of length L: L² / 12; sharing what falls between pixels adds up to a quarter.
    across = 81 / 12 * np.cos(direction) ** 2
    assert across - 0.01 <= edge_variance(smeared, 1) <= across + 0.25
    down = optics.smeared(step.transpose(1, 0, 2).copy(), 9.0, direction)
    along = 81 / 12 * np.sin(direction) ** 2
    assert along - 0.01 <= edge_variance(down, 0) <= along + 0.25


def test_each_image_is_shaken_in_its_own_direction():
    effects = syn.Imperfections(motion_blur=6.0)
    assert not np.array_equal(picture([wall()], effects, 0), picture([wall()], effects, 1))


@pytest.mark.parametrize("centre", [(0.0, 0.0, 10.0), (4.0, -3.0, 14.0)])
def test_a_highlight_is_where_the_mirrored_ray_meets_the_sun(centre):
    sun = np.array([0.4, -0.5, 0.8])
    light = syn.Light(tuple(sun), specular=0.7, shininess=30.0)
    x, y = np.meshgrid(np.arange(-30, 30, 0.25), np.arange(-30, 30, 0.25))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    upward = np.broadcast_to([[0.0], [0.0], [1.0]], points.shape)
    white = light.highlight(points, upward, points - np.array(centre)[:, None])[:, 0]
    downward = sun * [1, 1, -1]
    expected = np.array(centre) - centre[2] / downward[2] * downward
    np.testing.assert_allclose(points[:, np.argmax(white)], expected, atol=0.25)
    assert white.max() == pytest.approx(0.7, rel=0.01)


# ---- geometry ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rotation", [0.0, 0.05])
@pytest.mark.parametrize("way", [(0.0, 0.0, 0.0), (0.3, 0.1, 0.0), (0.0, 0.0, 0.4)])
def test_a_vertical_edge_slants_as_the_camera_moves(rotation, way):
    """The right edge of a wall, x = 0.4, in a camera that pans by the angle and moves by the way."""
    edge = 0.4
    moving = syn.RealCamera(
        K, np.eye(3), np.zeros(3), WIDTH, HEIGHT, motion=syn.Motion(np.array([0, rotation, 0]), np.array(way))
    )
    depth, normals, _ = syn.exact_geometry([wall(GREY, (50.0, 50.0), x=edge - 50.0)], moving, origin=0.5)
    _, y = pixel_grid()
    share = y[:, 0] / HEIGHT - 0.5
    angle = np.arctan2(edge - share * way[0], WALL_DEPTH - share * way[2]) + share * rotation
    expected = K[0, 2] + K[0, 0] * np.tan(angle)
    np.testing.assert_array_equal((depth > 0).sum(axis=1), np.floor(expected + 0.5))
    # The wall is as far from the camera of the middle row, whichever row sees it.
    np.testing.assert_allclose(depth[depth > 0], WALL_DEPTH, rtol=1e-12)
    np.testing.assert_allclose(
        normals[depth > 0], np.broadcast_to([0, 0, -1], normals[depth > 0].shape), atol=1e-12
    )


def field_by_hand(bending, x, y):
    """The cubic field, term by term."""
    u, v = 2 * x / WIDTH - 1, 2 * y / HEIGHT - 1
    terms = [1, v, v**2, v**3, u, u * v, u * v**2, u**2, u**2 * v, u**3]
    return [sum(c * term for c, term in zip(row, terms, strict=True)) for row in bending.coefficients]


@pytest.fixture
def bending():
    return syn.Bending.draw(1.5, WIDTH, HEIGHT, np.random.default_rng(2))


def test_the_field_has_its_size_and_moves_no_middle(bending):
    dx, dy = field_by_hand(bending, *pixel_grid())
    assert np.sqrt(np.mean(dx**2)) == pytest.approx(1.5, rel=0.05)
    assert np.sqrt(np.mean(dy**2)) == pytest.approx(1.5, rel=0.05)
    np.testing.assert_allclose(bending.displacement(np.array([80.0]), np.array([60.0])), 0.0, atol=1e-12)


def test_a_bent_picture_is_the_straight_one_through_its_field(bending):
    bent_camera = syn.RealCamera(K, np.eye(3), np.zeros(3), WIDTH, HEIGHT, bending=bending)
    straight = picture([wall()])
    bent = syn.photograph([wall()], bent_camera, syn.Imperfections(), light=LIGHT).image
    x, y = pixel_grid()
    dx, dy = field_by_hand(bending, x, y)
    # cv2 counts from the first pixel's centre.
    across = (x + dx - 0.5).astype(np.float32)
    down = (y + dy - 0.5).astype(np.float32)
    again = cv2.remap(straight, across, down, cv2.INTER_CUBIC)
    inner = np.s_[8:-8, 8:-8]
    error = np.abs(again[inner].astype(float) - bent[inner]).mean()
    unmoved = np.abs(straight[inner].astype(float) - bent[inner]).mean()
    assert error < 0.8
    assert unmoved > 4 * error


@pytest.mark.parametrize("origin", [0.0, 0.5])
def test_depth_of_a_bent_pixel_is_that_of_what_it_shows(bending, origin):
    normal = np.array([0.5, -0.3, -0.8])
    plane = syn.Plane((0, 0, WALL_DEPTH), normal, GREY)
    bent = syn.RealCamera(K, np.eye(3), np.zeros(3), WIDTH, HEIGHT, bending=bending)
    depth, _, _ = syn.exact_geometry([plane], bent, origin=origin)
    x, y = (grid - 0.5 + origin for grid in pixel_grid())
    dx, dy = field_by_hand(bending, x, y)
    rays = np.stack([(x + dx - K[0, 2]) / K[0, 0], (y + dy - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    np.testing.assert_allclose(depth, normal[2] * WALL_DEPTH / (rays @ normal), rtol=1e-10)


def test_points_are_observed_on_the_rays_that_see_them(bending):
    rng = np.random.default_rng(4)
    motion = syn.Motion(np.array([0.05, -0.08, 0.06]), np.array([0.3, -0.6, 0.4]))
    R, t = syn.look_at((3.0, -9.0, 2.0), (0, 0, 0))
    real = syn.RealCamera(K, R, t, WIDTH, HEIGHT, bending, motion)
    points = rng.uniform(-1.5, 1.5, (40, 3))
    for point, (x, y) in zip(points, real.observe(points), strict=True):
        rays = real.rays(np.array([x]), np.array([y]))
        towards = point - rays.origins[:, 0, 0]
        direction = rays.directions[:, 0, 0] / np.linalg.norm(rays.directions[:, 0, 0])
        assert np.linalg.norm(np.cross(towards, direction)) < 1e-9
        assert towards @ direction > 0
    assert np.abs(real.observe(points) - real.project(points)[0]).max() > 2


def test_a_thing_at_the_edge_of_a_moving_view_is_not_lost():
    """What only the first or the last rows see must be traced, too: against every ray, one at a time."""
    motion = syn.Motion(np.array([0.0, 0.3, 0.0]), np.array([0.5, 0.0, 0.0]))
    real = syn.RealCamera(K, np.eye(3), np.zeros(3), WIDTH, HEIGHT, motion=motion)
    for x in (-4.6, -3.6, 3.6, 4.6):
        thing = syn.box((x, -1.5, WALL_DEPTH), (0.8, 3.0, 1.0), (GREY,))
        depth, _, _ = syn.exact_geometry([thing], real)
        x_grid, y_grid = pixel_grid()
        rays = real.rays(x_grid[0], y_grid[:, 0])
        expected = np.isfinite(thing.intersect(rays.origins, rays.directions)[0])
        assert expected.any()
        np.testing.assert_array_equal(depth > 0, expected)


# ---- the world ---------------------------------------------------------------------------------------------


def sky_picture(view, effects):
    taken = syn.photograph([wall(UNIFORM, (0.6, 0.6))], view, effects, light=LIGHT, seed=3)
    return taken.image.astype(float), taken.depth


def test_clouds_stand_at_infinity_and_have_no_depth():
    effects = syn.Imperfections(sky=True, clouds=0.8)
    R = syn.look_at((0, 0, 0), (0, 1, 0.4))[0]
    first, depth = sky_picture(camera(R=R), effects)
    second, _ = sky_picture(camera((300.0, -40.0, 25.0), R), effects)
    assert not depth.any()
    np.testing.assert_array_equal(first, second)
    assert first.std(axis=(0, 1)).min() > 5
    # Turned by ten degrees: the homography of pure rotation.
    angle = np.radians(10)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned, _ = sky_picture(camera((80.0, 0, 0), turn @ R), effects)
    centre_shift = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    H = centre_shift @ K @ turn @ np.linalg.inv(K) @ np.linalg.inv(centre_shift)
    expected = cv2.warpPerspective(first, H, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    seen = cv2.warpPerspective(np.ones((HEIGHT, WIDTH)), H, (WIDTH, HEIGHT)) > 0.999
    seen = cv2.erode(seen.astype(np.uint8), np.ones((7, 7)), borderValue=0) > 0
    assert seen.mean() > 0.5
    assert np.abs(expected - turned)[seen].max() < 2
    assert np.abs(first - turned)[seen].mean() > 5


def test_a_clear_sky_is_smooth_and_pales_towards_the_horizon():
    sky, depth = sky_picture(camera(R=syn.look_at((0, 0, 0), (0, 1, 0.3))[0]), syn.Imperfections(sky=True))
    assert not depth.any()
    red = sky[..., 0]
    assert (np.diff(red, axis=0) >= -1).all()
    assert red[0].mean() < red[-1].mean() - 30
    assert np.abs(np.diff(red, axis=1)).max() <= 1


def test_moving_things_stand_elsewhere_in_each_image_and_are_part_of_its_truth():
    ground = syn.Plane((0, 0, 0), (0, 0, 1), GREY)
    R, t = syn.look_at((0, 0, 60.0), (0, 0, 0), (0, 1, 0))
    view = syn.Camera(K, R, t, WIDTH, HEIGHT)
    masks = []
    for number in (0, 1):
        things = moving_things([ground], view, 6, gsd=0.4, seed=1, number=number)
        assert len(things) == 6
        depth, _, surface = syn.exact_geometry([ground, *things], view)
        masks.append(surface > 0)
        np.testing.assert_allclose(depth[~masks[-1]], 60.0)
        # A roof's height above the ground, or a side between.
        assert depth[masks[-1]].min() == pytest.approx(60.0 - 1.4)
        assert depth[masks[-1]].max() <= 60.0
    assert all(mask.sum() > 50 for mask in masks)
    assert (masks[0] & masks[1]).sum() < 0.5 * masks[0].sum()


# ---- models ------------------------------------------------------------------------------------------------


def model_of_a_ring(count=60):
    """Cameras around a small cloud of points, all of which all see."""
    rng = np.random.default_rng(8)
    points = rng.uniform(-1, 1, (60, 3))
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        R, t = syn.look_at((12 * np.cos(angle), 12 * np.sin(angle), rng.uniform(-3, 3)), (0, 0, 0))
        cameras.append(syn.Camera(K, R, t, WIDTH, HEIGHT))
    everything = tuple(np.arange(len(points)) for _ in cameras)
    sparse = syn.SparsePoints(points, tuple(view.project(points)[0] for view in cameras), everything)
    names = [f"{number:02}.jpg" for number in range(count)]
    return syn.build_reconstruction(names, cameras, sparse, keypoint_noise=0.2), cameras, points


def mean_shifts(model, cameras, points):
    """By how many pixels (cameras, 2) a model's cameras see the points beside where the true ones see them."""
    shifts = []
    for number, view in enumerate(cameras, start=1):
        pose = model.images[number].cam_from_world()
        moved = syn.Camera(K, pose.rotation.matrix(), pose.translation, WIDTH, HEIGHT)
        shifts.append((moved.project(points)[0] - view.project(points)[0]).mean(axis=0))
    return shifts


@pytest.mark.parametrize("effects", [syn.Imperfections(rotation_error=0.8), syn.Imperfections(centre_error=0.8)])
def test_disturbed_poses_move_projections_by_so_many_pixels(effects):
    model, cameras, points = model_of_a_ring()
    disturb(model, effects, seed=3)
    shifts = mean_shifts(model, cameras, points)
    # 120 numbers know their spread to 6.5 %.
    assert np.sqrt(np.mean(np.square(shifts))) == pytest.approx(0.8, rel=0.2)
    # A two-dimensional Gaussian error of 0.8 px, and the keypoints' 0.2: its mean length.
    assert model.compute_mean_reprojection_error() == pytest.approx(
        np.hypot(0.8, 0.2) * np.sqrt(np.pi / 2), rel=0.2
    )


def test_bundle_adjustment_repairs_what_was_only_disturbed():
    model, cameras, points = model_of_a_ring(12)
    disturb(model, syn.Imperfections(rotation_error=1.0, centre_error=1.0, bundle_adjusted=True), seed=3)
    assert model.compute_mean_reprojection_error() < 0.2 * np.sqrt(np.pi / 2) * 1.05
    shifts = mean_shifts(model, cameras, points)
    disturb(model, syn.Imperfections(rotation_error=1.0, centre_error=1.0), seed=3)
    assert np.abs(shifts).max() < 0.3
    assert np.abs(mean_shifts(model, cameras, points)).max() > 1


SMALL_STREET = syn.StreetOptions(
    width=160, height=120, images=4, points=300, keypoint_noise=0.0, image_noise=0.0, supersample=1
)


def test_the_street_on_disk(tmp_path):
    effects = syn.Imperfections(sky=True, clouds=0.5, lens=0.8, wobble=0.4, rolling_shutter=4.0, moving=2)
    capture = syn.make_street_block(tmp_path, replace(SMALL_STREET, effects=effects))
    model = pycolmap.Reconstruction(capture.sparse_dir)
    # The tracks are those of bent images, the poses the true ones.
    assert 0.3 < model.compute_mean_reprojection_error() < 4
    by_name = {image.name: image for image in model.images.values()}
    for name, view, places in zip(capture.names, capture.cameras, capture.sparse.observations, strict=True):
        depth, _ = capture.truth(name)
        assert 0.15 < (depth == 0).mean() < 0.6
        written = np.array([point.xy for point in by_name[name].points2D])
        np.testing.assert_allclose(written, places)
        # What a track's pixel shows is as far away as its point, where no edge is near.
        column, row = np.rint(places).astype(int).T
        points = capture.sparse.points[capture.sparse.point_indices[capture.names.index(name)]]
        error = np.abs(depth[row, column] / view.project(points)[1] - 1)
        assert np.median(error) < 0.01
    heights = [point.xyz for point in model.points3D.values()]
    x, y, z = np.array(heights).T
    on_blank = (np.abs(x - 5.6) < 4.01) & (np.abs(y - 4.0) < 3.51) & (z > 0.01) & (z < 7.51)
    assert not on_blank.any()


def test_strengths_out_of_bounds_are_named():
    options = syn.BlockOptions(effects=syn.Imperfections(clouds=1.5, wobble=-1.0))
    with pytest.raises(OptionError, match=r"wobble = -1\.0 .*clouds = 1\.5 "):
        options.check()
