"""Analytic scenes against closed formulas, pictures against each other, the block against COLMAP's reader."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from projects import read_picture

from colmap_sph import synthetic as syn
from colmap_sph.errors import OptionError, OutputError

GREY = syn.Mottled(syn.Noise(0.05, seed=3))
K = np.array([[210.0, 0, 83.3], [0, 205.0, 58.1], [0, 0, 1]])
SIZE = (160, 120)


def rays(camera_matrix, width, height, origin):
    """Directions (H, W, 3) of unit z through (col + origin, row + origin)."""
    x, y = np.meshgrid(np.arange(width) + origin, np.arange(height) + origin)
    return np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera_matrix).T


def world_points(rendering_depth, camera, origin):
    directions = rays(camera.K, camera.width, camera.height, origin)
    return (directions * rendering_depth[..., None] - camera.t) @ camera.R


def camera_at(eye, target, up=(0.0, 0.0, 1.0)):
    R, t = syn.look_at(eye, target, up)
    return syn.Camera(K, R, t, *SIZE)


@pytest.mark.parametrize("origin", [0.0, 0.5])
@pytest.mark.parametrize(("slant", "tilt"), [(0, 0), (35, 0), (60, 90), (45, 200)])
def test_plane_depth_is_the_formula_at_every_pixel(origin, slant, tilt):
    pair = syn.slanted_plane_pair(slant, tilt, depth=7.0, focal_length=400.0, size=SIZE)
    camera = pair.right
    depth, normals, _ = syn.exact_geometry(pair.surfaces, camera, origin=origin)
    s, d = np.radians(slant), np.radians(tilt)
    normal = np.array([np.sin(s) * np.cos(d), np.sin(s) * np.sin(d), -np.cos(s)])
    offset = normal @ [0, 0, 7.0] - normal @ camera.centre
    expected = offset / (rays(camera.K, *SIZE, origin) @ normal)
    np.testing.assert_allclose(depth, np.where(expected > 0, expected, 0.0), rtol=1e-12)
    np.testing.assert_allclose(normals[depth > 0], np.broadcast_to(normal, normals[depth > 0].shape), atol=1e-12)


def test_bounded_plane_ends_where_it_should():
    plane = syn.Plane((0, 0, 0), (0, 0, 1), GREY, half_size=(1.5, 0.75))
    camera = camera_at((0.3, -0.2, 4.0), (0, 0, 0), up=(0, 1, 0))
    depth, _, _ = syn.exact_geometry([plane], camera)
    on_level = world_points(np.full(depth.shape, 4.0) / (rays(K, *SIZE, 0.5) @ -camera.R[:, 2]), camera, 0.5)
    inside = (np.abs(on_level[..., 0]) <= 1.5) & (np.abs(on_level[..., 1]) <= 0.75)
    assert 0 < inside.sum() < inside.size
    np.testing.assert_array_equal(depth > 0, inside)


@pytest.mark.parametrize("distance", [4.0, 4e4])
def test_sphere_depth_solves_the_quadratic(distance):
    centre = np.array([0.4, distance, 1.0])
    radius = 0.25 * distance
    camera = camera_at((0, 0, 0), centre)
    depth, normals, surface = syn.exact_geometry([syn.sphere(centre, radius, GREY)], camera)
    direction = rays(K, *SIZE, 0.5)
    c = camera.R @ centre + camera.t
    a, b = np.sum(direction**2, axis=-1), direction @ c
    discriminant = b**2 - a * (c @ c - radius**2)
    hit = discriminant > 0
    np.testing.assert_array_equal(surface == 0, hit)
    inner = discriminant > 1e-3 * b**2
    expected = (b - np.sqrt(np.maximum(discriminant, 0))) / a
    np.testing.assert_allclose(depth[inner], expected[inner], rtol=1e-10)
    np.testing.assert_allclose(normals[inner], ((direction * depth[..., None] - c) / radius)[inner], atol=1e-9)
    assert np.all(depth[~hit] == 0)
    assert np.all(normals[~hit] == 0)


def test_box_depth_lies_on_the_face_of_its_normal():
    size = np.array([2.0, 1.2, 0.9])
    yaw = 0.7
    base = np.array([0.2, 3.0, -0.4])
    solid = syn.box(base, tuple(size), (GREY,), yaw)
    camera = camera_at((0.6, -1.0, 1.9), base + np.array([0, 0, 0.45]))
    depth, normals, _ = syn.exact_geometry([solid], camera)
    hit = depth > 0
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    scale = size / 2
    local = ((world_points(depth, camera, 0.5)[hit] - base) @ turn - [0, 0, scale[2]]) / scale
    np.testing.assert_allclose(np.max(np.abs(local), axis=1), 1.0, atol=1e-12)
    face = np.argmax(np.abs(local), axis=1)
    expected = np.eye(3)[face] * np.sign(local[np.arange(len(local)), face])[:, None]
    np.testing.assert_allclose(normals[hit] @ camera.R @ turn, expected, atol=1e-12)
    assert len(np.unique(face)) == 3
    # Nothing of the box lies nearer: every ray is outside up to the hit.
    for share in (0.5, 0.9, 0.999):
        before = ((world_points(share * depth, camera, 0.5)[hit] - base) @ turn - [0, 0, scale[2]]) / scale
        assert np.all(np.max(np.abs(before), axis=1) > 1)


@pytest.mark.parametrize("hipped", [False, True])
def test_roof_has_the_height_of_its_formula(hipped):
    house = syn.gabled_house((0, 0, 0), (4.0, 2.0, 1.0), 1.8, (GREY,), hipped=hipped)
    camera = camera_at((0.5, -0.7, 7.0), (0, 0, 1), up=(0, 1, 0))
    depth, _, _ = syn.exact_geometry([house], camera)
    points = world_points(depth, camera, 0.5)[depth > 0]
    roof = points[points[:, 2] > 1.0 + 1e-9]
    height = 1.8 - 0.8 * np.abs(roof[:, 1])
    if hipped:
        height = np.minimum(height, 1.0 + 0.8 * (2.0 - np.abs(roof[:, 0])))
    assert len(roof) > 1000
    np.testing.assert_allclose(roof[:, 2], height, atol=1e-12)


def wavy(steepness=1.0):
    amplitudes = np.array([1.5, 0.8, 0.3]) * steepness
    waves = np.array([[0.05, 0.02], [-0.04, 0.09], [0.15, 0.12]])
    return syn.Terrain(2.0, amplitudes, waves, np.array([0.3, 1.1, 4.0]), GREY)


def formula_height(x, y, steepness=1.0):
    height = 2.0 + 0 * x
    terms = [(1.5, 0.05, 0.02, 0.3), (0.8, -0.04, 0.09, 1.1), (0.3, 0.15, 0.12, 4.0)]
    for amplitude, kx, ky, phase in terms:
        height = height + steepness * amplitude * np.sin(kx * x + ky * y + phase)
    return height


@pytest.mark.parametrize("eye", [(0, 0, 80.0), (-60.0, 10.0, 60.0)])
def test_terrain_residual_and_normals(eye):
    camera = camera_at(eye, (5.0, 0.0, 2.0), up=(0.1, 1, 0))
    depth, normals, _ = syn.exact_geometry([wavy()], camera, origin=0.0)
    points = world_points(depth, camera, 0.0)
    x, y, z = np.moveaxis(points, -1, 0)
    assert np.all(depth > 0)
    assert np.max(np.abs(z - formula_height(x, y))) < 1e-9
    step = 1e-4
    slope_x = (formula_height(x + step, y) - formula_height(x - step, y)) / (2 * step)
    slope_y = (formula_height(x, y + step) - formula_height(x, y - step)) / (2 * step)
    expected = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(normals @ camera.R, expected, atol=1e-6)


def test_terrain_gives_the_first_crossing_of_grazing_rays():
    steepness = 4.0
    camera = camera_at((0.0, -80.0, 2.0 + 2.6 * steepness + 3.0), (0.0, 0.0, 4.0))
    depth, _, _ = syn.exact_geometry([wavy(steepness)], camera)
    points = world_points(depth, camera, 0.5)
    hit = depth > 0
    assert 0.3 < hit.mean() < 1
    residual = points[..., 2] - formula_height(points[..., 0], points[..., 1], steepness)
    assert np.max(np.abs(residual[hit])) < 1e-6
    for share in np.linspace(0.02, 0.998, 150):
        before = world_points(share * depth, camera, 0.5)[hit]
        assert np.all(before[:, 2] > formula_height(before[:, 0], before[:, 1], steepness) - 1e-6)


PAIRS = {
    "slanted": lambda: syn.slanted_plane_pair(40, 30),
    "convergent": lambda: syn.convergent_pair(14),
    "forward": lambda: syn.forward_motion_pair(),
    "epipole inside": lambda: syn.epipole_inside_pair(),
}


@pytest.mark.parametrize("name", PAIRS)
def test_normals_are_unit_and_face_the_camera(name):
    pair = PAIRS[name]()
    for camera in (pair.left, pair.right):
        depth, normals, surface = syn.exact_geometry(pair.surfaces, camera, origin=0.0)
        hit = depth > 0
        np.testing.assert_array_equal(hit, surface >= 0)
        np.testing.assert_allclose(np.linalg.norm(normals[hit], axis=1), 1.0, atol=1e-12)
        directions = rays(camera.K, camera.width, camera.height, 0.0)
        assert np.all(np.sum(normals * directions, axis=-1)[hit] < 0)


def warped(pair, left, right, shift):
    """The right picture as the left camera sees it, and where both see the same surface point."""
    camera = pair.left
    points = world_points(left.depth, camera, 0.5).reshape(-1, 3)
    image, depth = pair.right.project(points)
    # cv2 counts from the first pixel's centre, COLMAP from the corner.
    x, y = (image.T.reshape(2, *left.depth.shape) - 0.5 + shift).astype(np.float32)
    picture = cv2.remap(right.image, x, y, cv2.INTER_CUBIC)
    seen = syn.trace_points(pair.surfaces, pair.right, image).distance
    visible = (np.abs(seen - depth) < 1e-6 * depth).reshape(x.shape) & (left.depth > 0)
    # Two pixels from any edge of a surface a picture element may show both sides.
    edges = cv2.morphologyEx(left.surface, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) > 0
    inside = (x > 1) & (x < camera.width - 2) & (y > 1) & (y < camera.height - 2)
    return picture, visible & inside & ~edges


def correlation(first, second, where):
    return np.corrcoef(first[where].ravel().astype(float), second[where].ravel().astype(float))[0, 1]


@pytest.mark.parametrize("name", PAIRS)
def test_pictures_agree_through_exact_depth(name):
    pair = PAIRS[name]()
    left, right = pair.render("left", supersample=3), pair.render("right", supersample=3)
    picture, where = warped(pair, left, right, 0.0)
    assert where.mean() > 0.3
    exact = correlation(left.image, picture, where)
    assert exact > 0.95
    for shift in (-0.5, 0.5):
        picture, where = warped(pair, left, right, shift)
        # The unexplained part grows at least half as much again.
        assert 1 - correlation(left.image, picture, where) > 1.5 * (1 - exact)


def epipole(camera, other):
    image, depth = camera.project(other.centre[None])
    return image[0], depth[0]


def test_pairs_have_the_geometry_they_promise():
    forward = syn.forward_motion_pair(2.0)
    for first, second in ((forward.left, forward.right), (forward.right, forward.left)):
        np.testing.assert_allclose(epipole(first, second)[0], first.K[:2, 2], atol=1e-6)
    inside = syn.epipole_inside_pair()
    for first, second in ((inside.left, inside.right), (inside.right, inside.left)):
        place = epipole(first, second)[0]
        assert np.all(place > 10)
        assert np.all(place < np.array([first.width, first.height]) - 10)
        assert np.linalg.norm(place - first.K[:2, 2]) > 10
    convergent = syn.convergent_pair(30.0)
    axes = convergent.left.R[2] @ convergent.right.R[2]
    assert 20 < np.degrees(np.arccos(axes)) < 30.1  # the axes also point downwards


def test_look_at_puts_the_target_on_the_axis_and_up_above():
    R, t = syn.look_at((1, 2, 3), (4, -1, 2))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose((R @ [4, -1, 2] + t)[:2], 0, atol=1e-12)
    assert (R @ [1, 2, 4] + t)[1] < (R @ [1, 2, 3] + t)[1]
    with pytest.raises(ValueError, match="parallel"):
        syn.look_at((0, 0, 5), (0, 0, 0))


def test_texture_is_a_function_of_the_seed():
    first, again, other = (
        syn.slanted_plane_pair(seed=seed, size=(64, 48)).render("left", noise=2.0, seed=5).image
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert np.mean(first != other) > 0.9


def test_texture_does_not_alias_and_has_detail_everywhere():
    pair = syn.slanted_plane_pair(0.0)
    coarse = pair.render("left", supersample=2).image[..., 1].astype(float)
    fine = pair.render("left", supersample=6).image[..., 1].astype(float)
    assert np.std(coarse - fine) < 0.05 * np.std(fine)
    mean = cv2.blur(fine, (7, 7))
    deviation = np.sqrt(np.maximum(cv2.blur(fine**2, (7, 7)) - mean**2, 0))
    assert np.percentile(deviation, 0.1) > 4


def test_sensor_noise_has_its_standard_deviation():
    pair = syn.slanted_plane_pair(size=(160, 120))
    clean, noisy = pair.render("left"), pair.render("left", noise=3.0)
    difference = noisy.image.astype(float) - clean.image
    assert np.std(difference) == pytest.approx(3.0, rel=0.03)


def test_render_refuses_nonsense():
    with pytest.raises(OptionError, match="supersample"):
        syn.render([], K, np.eye(3), np.zeros(3), 10, 10, supersample=0)


def test_empty_scene_is_sky():
    rendering = syn.render([], K, np.eye(3), np.zeros(3), 8, 6)
    assert np.all(rendering.depth == 0)
    assert np.all(rendering.surface == -1)
    assert np.all(rendering.image == rendering.image[0, 0])


def test_a_surface_reaching_behind_the_camera_is_not_culled():
    long_box = syn.box((0, 0, -1.0), (0.5, 200.0, 0.5), (GREY,))
    camera = camera_at((0, 0, 0.5), (0, 10, 0))
    alone, _, _ = syn.exact_geometry([long_box], camera)
    points = world_points(alone, camera, 0.5)[alone > 0]
    assert len(points) > 500
    np.testing.assert_allclose(np.maximum(np.abs(points[:, 0]) / 0.25, np.abs(points[:, 2] + 0.75) / 0.25), 1.0)


def test_shadow_falls_where_the_sun_says():
    ground = syn.Plane((0, 0, 0), (0, 0, 1), GREY)
    pole = syn.box((0, 0, 0), (0.4, 0.4, 2.0), (GREY,))
    extent = np.array([[x, y, 0.0] for x in (-4, 4) for y in (-4, 4)])
    shadows = syn.ShadowMap.cast([ground, pole], (-1.0, 0.0, 1.0), extent, 0.02)
    places = np.array([[0.5, 0, 0], [1.9, 0, 0], [2.4, 0, 0], [1.0, 0.5, 0], [-0.5, 0, 0]]).T
    lit = shadows.lit(places, np.full(5, np.sqrt(0.5)))
    np.testing.assert_allclose(lit, [0, 0, 1, 1, 1])


SMALL = syn.BlockOptions(
    width=160,
    height=120,
    nadir_gsd=0.5,
    oblique_gsd=0.55,
    strips=1,
    strip_images=3,
    oblique_images=1,
    buildings=12,
    trees=10,
    points=300,
    image_noise=1.0,
)


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    calls = []
    made = syn.make_demo_block(
        tmp_path_factory.mktemp("demo"),
        SMALL,
        threads=2,
        progress=lambda done, all_: calls.append((done, all_)),
    )
    assert calls == [(number, 7) for number in range(1, 8)]
    return made


def test_block_is_a_colmap_model_that_reprojects(block):
    model = pycolmap.Reconstruction(block.sparse_dir)
    assert model.num_cameras() == 2
    assert model.num_reg_images() == len(block.names) == 7
    assert model.num_points3D() == len(block.sparse.points) == 300
    # The mean length of a two-dimensional Gaussian error of 0.3 px in each coordinate.
    assert model.compute_mean_reprojection_error() == pytest.approx(0.3 * np.sqrt(np.pi / 2), rel=0.08)
    assert min(point.track.length() for point in model.points3D.values()) >= 3
    names = {image.name: image for image in model.images.values()}
    for name, camera in zip(block.names, block.cameras, strict=True):
        image = names[name]
        np.testing.assert_allclose(image.cam_from_world().matrix()[:, :3], camera.R, atol=1e-12)
        np.testing.assert_allclose(image.projection_center(), camera.centre, atol=1e-9)
        np.testing.assert_allclose(image.camera.calibration_matrix(), camera.K)
        picture = read_picture(block.images_dir / name)
        assert picture.shape == (120, 160, 3)


def test_block_without_keypoint_noise_is_exact(block):
    model = syn.build_reconstruction(block.names, block.cameras, block.sparse)
    assert model.compute_mean_reprojection_error() < 1e-9


def test_block_truth_is_at_the_fusion_origin(block):
    for name, camera in list(zip(block.names, block.cameras, strict=True))[::3]:
        depth, normals = block.truth(name)
        expected, expected_normals, _ = syn.exact_geometry(block.village.surfaces, camera, origin=0.0)
        np.testing.assert_array_equal(depth, expected.astype(np.float32))
        np.testing.assert_allclose(normals, expected_normals, atol=1e-3)


def test_sparse_points_lie_on_the_nearest_surface(block):
    for number, camera in enumerate(block.cameras):
        image, depth = camera.project(block.sparse.points[block.sparse.point_indices[number]])
        np.testing.assert_allclose(image, block.sparse.observations[number], atol=1e-9)
        nearest = syn.trace_points(block.village.surfaces, camera, image).distance
        np.testing.assert_allclose(nearest, depth, rtol=1e-6)
        assert np.all((image > 0) & (image < [camera.width, camera.height]))


def test_block_does_not_depend_on_threads(block, tmp_path):
    again = syn.make_demo_block(tmp_path / "again", SMALL, threads=1)
    for folder in ("images", "truth", "sparse/0"):
        files = sorted((block.root / folder).iterdir())
        assert [file.name for file in files] == sorted(file.name for file in (again.root / folder).iterdir())
        for file in files:
            if file.suffix != ".npz":  # a zip archive holds the time of day
                assert file.read_bytes() == (again.root / folder / file.name).read_bytes()
    for name in block.names:
        np.testing.assert_array_equal(block.truth(name)[0], again.truth(name)[0])


def test_block_options_name_every_bound():
    with pytest.raises(OptionError, match=r"forward_overlap = 1\.5 .*points = 0 ") as refused:
        syn.BlockOptions(forward_overlap=1.5, points=0).check()
    assert refused.value.names == ("forward_overlap", "points")


def test_unwritable_output_is_one_sentence(tmp_path: Path):
    in_the_way = tmp_path / "file"
    in_the_way.write_text("")
    with pytest.raises(OutputError, match="file"):
        syn.make_demo_block(in_the_way, SMALL)
