"""Refined planes against exact depth of rendered scenes; the kernel against its oracle."""

import shutil
import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import oracle
import pytest
from refusals import assert_refused
from rendered import SIDES, grey

import colmap_sph
from colmap_sph import _native
from colmap_sph import synthetic as syn
from colmap_sph.pipeline.stages import confirm
from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import View
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.refinement import RefinementOptions, refine_maps, suits_half_size

OPTIONS = RefinementOptions()
NAME = "F_0.jpg"
# Columns that are matched in the same partners, and where windows begin.
TILE = 32
FIRST = 3


# ---- the kernel --------------------------------------------------------------------------------------------


def texture(shape, seed):
    """Smooth random grey image, of which windows of a few pixels can be told apart."""
    noise = np.random.default_rng(seed).normal(0, 1, shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def equations_of(backend, image, source, matrix, planes, options=OPTIONS):
    return equations_of_all(backend, image, [(source, matrix)], planes, options)


def equations_of_all(backend, image, partners, planes, options=OPTIONS):
    equations = np.zeros((12, *image.shape), np.float32)
    add_equations(backend, image, partners, planes, options, equations)
    return equations


def paired(image):
    """Every pixel with the one below it in the upper byte."""
    return image[:-1] + 256 * image[1:].astype(np.uint16)


def everywhere(image):
    """In no tile of columns a source is left out."""
    return np.full(-(-image.shape[1] // TILE), 2**32 - 1, np.uint32)


def add_equations(backend, image, partners, planes, options, equations, used=None):
    sources = tuple(paired(source) for source, _ in partners)
    matrices = np.stack([matrix for _, matrix in partners])
    used = everywhere(image) if used is None else used
    limits = options.contrast, options.min_score
    _native.add_patch_equations(backend, image, sources, matrices, used, planes, 0, 1, *limits, equations)


@pytest.mark.parametrize("backend", _native.backends())
@pytest.mark.parametrize(("first", "step"), [(0, 2), (3, 5), (39, 7), (45, 1)])
def test_equations_of_some_rows_are_those_of_all(backend, first, step):
    image = texture((40, 40), 1)
    planes = slanted_planes((40, 40), 2)
    rows = slice(first, None, step)
    expected = equations_of(backend, image, image, AFFINE, planes)[:, rows]
    found = np.zeros(expected.shape, np.float32)
    some = np.ascontiguousarray(planes[:, rows])
    limits = OPTIONS.contrast, OPTIONS.min_score
    given = image, (paired(image),), AFFINE[None], everywhere(image), some
    _native.add_patch_equations(backend, *given, first, step, *limits, found)
    assert np.array_equal(found, expected)
    assert np.any(found) or first >= 39


def slanted_planes(shape, seed, slope=0.002):
    """Inverse depth about 1 with random changes per pixel; some pixels without."""
    rng = np.random.default_rng(seed)
    planes = np.stack([rng.uniform(0.8, 1.2, shape), *rng.uniform(-slope, slope, (2, *shape))])
    return np.where(rng.random(shape) < 0.9, planes, 0).astype(np.float32)


# A shift, a rotated and enlarged source, and one that looks at the plane from the side.
AFFINE = np.array([[1, 0, 2.3, 1.5], [0, 1, 3.6, 0.4], [0, 0, 1, 0]])
TURNED = np.array([[0.9, -0.5, 12.2, 2.5], [0.5, 1.1, 6.4, -1.4], [0, 0, 1, 0]])
PROJECTIVE = np.array([[1.02, 0.01, 1.3, 2], [0.02, 0.98, -0.6, 1], [3e-4, -2e-4, 1, 2e-3]])


@pytest.mark.parametrize("backend", _native.backends())
@pytest.mark.parametrize(("matrix", "tolerance"), [(AFFINE, 2e-3), (TURNED, 2e-3), (PROJECTIVE, 3e-2)])
@pytest.mark.parametrize("size", [(12, 21), (7, 8), (6, 6), (5, 30)])
def test_equations_are_the_oracles(backend, matrix, tolerance, size):
    image = texture((40, 40), 1)[: size[0], : size[1]].copy()
    source = texture((33, 35), 1)
    planes = slanted_planes(size, 2)
    options = replace(OPTIONS, min_score=-0.999)
    expected = oracle.patch_equations(image, source, matrix, planes, options.contrast, options.min_score)
    found = equations_of(backend, image, source, matrix, planes, options)
    known = np.isfinite(expected)
    scale = np.abs(np.where(known, expected, 0)).max(axis=(1, 2), keepdims=True) + 1e-9
    close = np.abs(found - expected) <= tolerance * scale
    # A tap that rounding puts into the neighbouring pixel of the source has another slope.
    assert close[known].mean() > 0.98
    np.testing.assert_array_equal((found[0] > 0)[known[0]], (expected[0] > 0)[known[0]])
    assert (found[0] > 0).any() == (size[0] >= 6)


@pytest.mark.parametrize("size", [(6, 6), (9, 7), (17, 40), (11, 29)])
@pytest.mark.parametrize("matrix", [AFFINE, TURNED, PROJECTIVE])
def test_equations_do_not_depend_on_the_backend(size, matrix):
    image = texture(size, 3)
    source = texture((30, 31), 4)
    planes = slanted_planes(size, 5)
    options = replace(OPTIONS, min_score=-0.5)
    results = [equations_of(backend, image, source, matrix, planes, options) for backend in _native.backends()]
    assert results[0].any()
    for other in results[1:]:
        np.testing.assert_array_equal(results[0], other)


@pytest.mark.parametrize("backend", _native.backends())
@pytest.mark.parametrize("size", [(6, 6), (9, 7), (17, 40), (11, 29)])
def test_sources_of_one_call_add_up_in_their_order(backend, size):
    """As by a call for each, to the bit: those of other sizes, and one too small for any window, included."""
    image = texture(size, 3)
    planes = slanted_planes(size, 5)
    options = replace(OPTIONS, min_score=-0.5)
    sources = [texture((30, 31), 4), texture((26, 50), 7), texture((6, 4), 8), texture((40, 28), 9)]
    partners = list(zip(sources, (AFFINE, TURNED, AFFINE, PROJECTIVE), strict=True))
    together, in_turn = (
        equations_of_all(backend, image, partners, planes, options),
        np.zeros((12, *size), np.float32),
    )
    alone = [equations_of_all(backend, image, [partner], planes, options) for partner in partners]
    for partner in partners:
        add_equations(backend, image, [partner], planes, options, in_turn)
    assert sum(equations.any() for equations in alone) >= 2 and not alone[2].any()
    np.testing.assert_array_equal(together.view(np.uint32), in_turn.view(np.uint32))
    np.testing.assert_allclose(together, np.sum(alone, axis=0), rtol=1e-4, atol=1e-4 * np.abs(together).max())


@pytest.mark.parametrize("backend", _native.backends())
@pytest.mark.parametrize("width", [6, 34, 37, 38, 40, 101])
def test_each_tile_of_columns_is_matched_in_its_own_sources(backend, width):
    """Sums of what each source says alone, to the bit, in the tiles that use it."""
    image = texture((9, width), 3)
    planes = slanted_planes(image.shape, 5)
    options = replace(OPTIONS, min_score=-0.9)
    sources = [texture((30, width + 5), seed) for seed in (4, 7, 8)]
    partners = list(zip(sources, (AFFINE, PROJECTIVE, AFFINE), strict=True))
    used = np.array([0b101, 0b010, 0b000, 0b1000110], np.uint32)[: -(-width // TILE)]
    found = np.zeros((12, *image.shape), np.float32)
    add_equations(backend, image, partners, planes, options, found, used)
    tiles = np.maximum(np.arange(width) - FIRST, 0) // TILE
    expected = np.zeros_like(found)
    for index, partner in enumerate(partners):
        alone = equations_of(backend, image, *partner, planes, options)
        asked = used[tiles] >> index & 1
        assert alone[0, :, : FIRST + TILE].any()
        expected += np.where(asked, alone, 0)
    np.testing.assert_array_equal(found.view(np.uint32), expected.view(np.uint32))


def slanted_plane(size):
    """Two views of a plane, its normals in the first one, and depths there that are a little too large."""
    block = syn.slanted_plane_pair(30.0, focal_length=300.0, size=size)
    view, other = (
        View(k, str(k), c.width, c.height, c.K, c.R, c.t, np.zeros(0, np.int64))
        for k, c in enumerate((block.left, block.right))
    )
    truth, normals, _ = syn.exact_geometry(block.surfaces, block.left, origin=0.0)
    depth = (truth * 1.002).astype(np.float32)
    estimate = DepthEstimate(depth, (0.01 * depth).astype(np.float32), np.ones(truth.shape, np.uint8))
    return view, other, normals.astype(np.float32), estimate


def test_there_may_be_more_partners_than_one_call_takes(monkeypatch):
    """What fits into one call, and in parts: the same bits."""
    view, other, normals, estimate = slanted_plane((160, 120))
    sources = [(other, texture((other.height, other.width), seed)) for seed in range(35)]
    options = replace(OPTIONS, max_partners=35, min_score=-0.9)
    results = []
    for most in (32, 3):
        monkeypatch.setattr("colmap_sph.stereo.refinement._SOURCES", most)
        maps = normals.copy(), estimate.depth.copy()
        results.append(refine_maps(view, texture(estimate.depth.shape, 99), estimate, *maps, sources, options))
    assert (results[0][1] != estimate.depth).any()
    for one, part in zip(*results, strict=True):
        np.testing.assert_array_equal(one, part)


@pytest.mark.parametrize("backend", _native.backends())
def test_an_image_matches_itself(backend):
    """At infinite depth the image lies on itself, half a pixel of COLMAP's origin included: nothing is to do."""
    image = texture((20, 30), 6)
    identity = np.column_stack([np.eye(3), [1.0, 0, 0]])
    planes = np.zeros((3, 20, 30), np.float32)
    planes[0] = 1e-7
    equations = equations_of(backend, image, image, identity, planes)
    # Windows that touch the rim have no bilinear neighbours there, and one row below them is read along.
    assert (equations[0, 4:16, 4:27] > 0).all()
    matched = equations[0] > 0
    weight = equations[0][matched]
    # What noise takes from the score of windows of variance v, all above 75: 2 (1 - v / (v + 4)).
    assert (equations[1][matched] / weight < 0.1).all()
    curvature = equations[6][matched]
    assert (np.abs(equations[3][matched]) < 0.02 * curvature).all()


@pytest.mark.parametrize("shift", [-0.5, -0.2, 0.3, 0.5])
def test_a_shifted_image_gives_its_shift(shift):
    """One step from a wrong parallax goes most of the way to the true one."""
    y, x = np.mgrid[0:24, 0:48].astype(float)

    def picture(x, y):
        return 128 + 40 * np.sin(0.9 * x + 0.3 * y) + 40 * np.sin(0.5 * y - 0.4 * x)

    image = np.rint(picture(x, y)).astype(np.uint8)
    source = np.rint(picture(x - 4 - shift, y)).astype(np.uint8)
    matrix = np.column_stack([np.eye(3), [4.0, 0, 0]])
    planes = np.zeros((3, 24, 48), np.float32)
    planes[0] = 1
    equations = equations_of(_native.backends()[0], image, source, matrix, planes)
    matched = equations[0] > 0
    assert matched.mean() > 0.5
    _native.refine_planes(equations, np.full((24, 48), 1e3, np.float32), 1e-6, planes)
    left = np.abs(planes[0][matched] * 4 - (4 + shift))
    assert left.max() < 0.5 * abs(shift) and np.median(left) < 0.25 * abs(shift)
    assert (planes[0][~matched] == 1).all()


@pytest.mark.parametrize(("first", "step"), [(0, 1), (3, 4)])
def test_planes_meet_the_neighbouring_rays_where_maps_say(first, step):
    """Inverse depths of a pixel's plane on the rays beside and below it, from their intersection."""
    rng = np.random.default_rng(4)
    height, width = 13, 70
    K = np.array([[50, 0.4, 30.0], [0, 55, 7], [0, 0, 1]])
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([column, row, np.ones_like(row)], axis=-1)
    normals = np.dstack([rng.uniform(-0.5, 0.5, (height, width, 2)), -np.ones((height, width))])
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    depth = rng.uniform(3, 9, (height, width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    normals[depth == 0] = 0
    rows = slice(first, None, step)
    planes = np.full((3, len(range(height)[rows]), width), 9, np.float32)
    _native.planes_of_maps(normals, depth, np.linalg.inv(K), first, step, planes)
    found = depth[rows] > 0

    def inverse_depth(right, down):
        point = (pixels @ np.linalg.inv(K).T) * depth[..., None].astype(float)
        ray = (pixels + np.array([right, down, 0])) @ np.linalg.inv(K).T
        return (normals * ray).sum(axis=-1)[rows][found] / (normals * point).sum(axis=-1)[rows][found]

    own = inverse_depth(0, 0)
    expected = [own, inverse_depth(1, 0) - own, inverse_depth(0, 1) - own]
    np.testing.assert_allclose(planes[:, found], expected, rtol=1e-4, atol=1e-6)
    assert not planes[:, ~found].any()


def test_maps_of_planes_are_those_they_came_from():
    rng = np.random.default_rng(5)
    K = np.array([[50, 0.4, 30.0], [0, 55, 7], [0, 0, 1]])
    planes = np.stack([rng.uniform(0.1, 0.3, (6, 70)), *rng.uniform(-2e-3, 2e-3, (2, 6, 70))]).astype(np.float32)
    planes[:, rng.random((6, 70)) < 0.2] = 0
    normals, depth = np.full((9, 70, 3), 9, np.float32), np.full((9, 70), 9, np.float32)
    _native.maps_of_planes(planes, K, 2, normals, depth)
    assert (normals[[0, 1, 8]] == 9).all() and (depth[[0, 1, 8]] == 9).all()
    found = planes[0] > 0
    assert not normals[2:8][~found].any() and not depth[2:8][~found].any()
    np.testing.assert_allclose(np.linalg.norm(normals[2:8][found], axis=-1), 1, rtol=1e-6)
    again = np.zeros_like(planes)
    _native.planes_of_maps(np.ascontiguousarray(normals[:8]), depth[:8], np.linalg.inv(K), 2, 1, again)
    np.testing.assert_allclose(again, planes, rtol=1e-4, atol=1e-7)


def test_planes_without_equations_or_freedom_stay():
    equations = np.ones((12, 2, 3), np.float32)
    equations[[7, 8, 10]] = 0
    planes, sigma = np.ones((3, 2, 3), np.float32), np.ones((2, 3), np.float32)
    equations[0, 0, 0] = 0
    sigma[0, 1] = 0
    planes[0, 0, 2] = 0
    equations[3:, 1, 0] = np.nan
    before = planes.copy()
    _native.refine_planes(equations, sigma, 0.1, planes)
    changed = (planes != before).any(axis=0)
    np.testing.assert_array_equal(changed, [[False, False, False], [False, True, True]])


def test_the_solution_is_the_weighted_mean_of_image_and_depth():
    """Equations of curvature a and right side b: the step is b i / (a i + 1 / sigma²), i = 1 / (2 (q + 0.02))."""
    a, b, q, sigma = 5.0, 0.3, 0.08, 0.4
    equations = np.zeros((12, 1, 1), np.float32)
    equations[[0, 1, 3, 6]] = np.array([1, q, b, a])[:, None, None]
    planes = np.array([2, 0, 0], np.float32).reshape(3, 1, 1)
    _native.refine_planes(equations, np.full((1, 1), sigma, np.float32), 0.1, planes)
    information = 0.5 / (q + 0.02)
    assert planes[0, 0, 0] == pytest.approx(2 + b * information / (a * information + sigma**-2), rel=1e-6)


# ---- rendered scenes ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(block):
    views = read_scene(block.sparse_dir)
    images = {
        view.name: cv2.imread(str(block.images_dir / view.name), cv2.IMREAD_GRAYSCALE) for view in views.views
    }
    return views, images


def rays(view):
    """Rays (H, W, 3) of the depth map's pixels in the camera's frame."""
    column, row = np.meshgrid(np.arange(view.width), np.arange(view.height))
    return np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(view.K).T


def disturbed(view, truth, normals, pixels, degrees, seed=0, smoothness=2.0):
    """Exact maps with smooth errors of depth, in pixels on the ground, and turned normals."""
    rng = np.random.default_rng(seed)
    found = (truth > 0) & normals.any(axis=-1)
    wave = cv2.GaussianBlur(rng.normal(0, 1, truth.shape), (0, 0), smoothness)
    sigma = np.where(found, pixels * truth / view.K[0, 0], 0).astype(np.float32)
    depth = np.where(found, truth + sigma * wave / wave.std(), 0).astype(np.float32)
    turned = normals + np.tan(np.radians(degrees)) * rng.normal(0, 0.7, normals.shape)
    turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
    turned *= -np.sign((turned * rays(view)).sum(axis=-1, keepdims=True))  # still towards the camera
    turned = np.where(found[..., None], turned, 0).astype(np.float32)
    return DepthEstimate(depth, sigma, np.full(depth.shape, 3, np.uint8)), turned


def angle(normals, truth):
    return np.degrees(np.arccos(np.clip((normals * truth).sum(axis=-1), -1, 1)))


@pytest.mark.parametrize("name", [NAME, "N_0_1.jpg"])
def test_refinement_comes_nearer_to_the_truth(block, scene, name):
    """Depth errors shrink by a third and more, and normals turn towards the true ones."""
    views, images = scene
    assert name in images, sorted(images)
    view = views.view(name)
    truth, true_normals = block.truth(name)
    estimate, normals = disturbed(view, truth, true_normals, pixels=0.5, degrees=8)
    sources = [(other, images[other.name]) for other in views.views if other.name != name]
    refined, depth = refine_maps(
        view, images[name], estimate, normals.copy(), estimate.depth.copy(), sources, OPTIONS
    )
    found = (estimate.depth > 0) & (depth > 0)
    np.testing.assert_array_equal(depth > 0, estimate.depth > 0)
    assert not depth[estimate.depth == 0].any() and not refined[depth == 0].any()
    before, after = (np.abs(values - truth)[found] for values in (estimate.depth, depth))
    assert np.median(after) < 0.67 * np.median(before)
    assert np.median(angle(refined, true_normals)[found]) < np.median(angle(normals, true_normals)[found])
    np.testing.assert_allclose(np.linalg.norm(refined[found], axis=-1), 1, atol=1e-5)


@pytest.mark.parametrize(("pixels", "rounds", "partners"), [(0.0, 1, 3), (0.19, 1, 3), (0.2, 2, 6), (1.0, 2, 6)])
def test_precise_poses_need_one_round_in_few_images(pixels, rounds, partners):
    options = replace(OPTIONS, rounds=2, max_partners=6).for_residual(pixels)
    assert (options.rounds, options.max_partners) == (rounds, partners)
    options = replace(OPTIONS, rounds=0, max_partners=2).for_residual(pixels)
    assert (options.rounds, options.max_partners) == (0, 2)


def test_without_partners_or_rounds_maps_stay(block, scene):
    views, images = scene
    view = views.view(NAME)
    truth, true_normals = block.truth(NAME)
    estimate, normals = disturbed(view, truth, true_normals, pixels=0.5, degrees=8)
    sources = [(other, images[other.name]) for other in views.views if other.name != NAME]
    for partners, rounds in (([], 1), (sources, 0)):
        options = replace(OPTIONS, rounds=rounds)
        refined, depth = refine_maps(
            view, images[NAME], estimate, normals.copy(), estimate.depth.copy(), partners, options
        )
        np.testing.assert_allclose(depth, estimate.depth, rtol=1e-6)
        np.testing.assert_allclose(refined, normals, atol=1e-5)


def test_partners_that_see_something_else_have_no_say(block, scene):
    """Pictures of noise correlate with nothing: depth stays where it was."""
    views, images = scene
    view = views.view(NAME)
    truth, true_normals = block.truth(NAME)
    estimate, normals = disturbed(view, truth, true_normals, pixels=0.5, degrees=0)
    rng = np.random.default_rng(1)
    sources = [
        (other, rng.integers(0, 256, images[other.name].shape, np.uint8))
        for other in views.views
        if other.name != NAME
    ]
    options = replace(OPTIONS, rounds=1)
    _, depth = refine_maps(view, images[NAME], estimate, normals.copy(), estimate.depth.copy(), sources, options)
    found = depth > 0
    assert (np.abs(depth - estimate.depth)[found] < 1e-4 * depth[found]).mean() > 0.95


def test_partners_that_tell_most_are_chosen(block, scene):
    """Of true pictures and pictures of noise the true ones: the same maps as from these alone."""
    views, images = scene
    view = views.view(NAME)
    truth, true_normals = block.truth(NAME)
    estimate, normals = disturbed(view, truth, true_normals, pixels=0.5, degrees=8)
    others = [other for other in views.views if other.name != NAME][:4]
    rng = np.random.default_rng(2)
    true = []
    mixed = []
    for other in others:
        true.append((other, images[other.name]))
        mixed += [(other, rng.integers(0, 256, images[other.name].shape, np.uint8)), true[-1]]
    options = replace(OPTIONS, max_partners=4)
    alone, chosen = (
        refine_maps(view, images[NAME], estimate, normals.copy(), estimate.depth.copy(), sources, options)
        for sources in (true, mixed)
    )
    # In a tile of which fewer than four true ones see anything, noise may match by chance.
    same = (alone[0] == chosen[0]).all(axis=-1) & (alone[1] == chosen[1])
    assert same.mean() > 0.998


def test_each_tile_is_matched_in_what_shows_it(block, scene):
    """Two pictures show a partner's view of the left and of the right half of an image, and noise elsewhere.

    With one partner per tile, both halves are refined as on the whole picture, and come nearer to the exact depth.
    """
    views, images = scene
    partner_name = "N_0_1.jpg"
    view, other = views.view(NAME), views.view(partner_name)
    truth, true_normals = block.truth(NAME)
    estimate, normals = disturbed(view, truth, true_normals, pixels=0.5, degrees=8)
    points = (rays(view) * truth[..., None] - view.t) @ view.R
    noise = np.random.default_rng(2).integers(0, 256, images[partner_name].shape, np.uint8)
    half, border = view.width // 2, 2 * TILE
    halves = slice(0, half), slice(half, None)
    sources = []
    for columns in halves:
        there = points[:, columns][truth[:, columns] > 0] @ other.R.T + other.t
        u, v = (there @ other.K.T)[:, :2].T / there[:, 2]
        inside = (u >= 0) & (v >= 0) & (u < other.width) & (v < other.height)
        shown = np.zeros(noise.shape, np.uint8)
        shown[v[inside].astype(int), u[inside].astype(int)] = 1
        shown = cv2.dilate(shown, np.ones((13, 13), np.uint8))
        sources.append((other, np.where(shown, images[partner_name], noise)))
    options = replace(OPTIONS, max_partners=1)
    of_whole, of_halves = (
        refine_maps(view, images[NAME], estimate, normals.copy(), estimate.depth.copy(), partners, options)
        for partners in ([(other, images[partner_name])], sources)
    )
    for columns in (slice(0, half - border), slice(half + border, None)):
        same = of_halves[1][:, columns] == of_whole[1][:, columns]
        assert same.mean() > 0.95
        moved = (of_halves[1] != estimate.depth)[:, columns]
        before, after = (np.abs(depth - truth)[:, columns][moved] for depth in (estimate.depth, of_halves[1]))
        assert np.median(after) < 0.8 * np.median(before)


@pytest.mark.parametrize("size", [(6, 7), (17, 40), (33, 32), (49, 65)])
def test_views_of_any_size_are_refined(size):
    """Those too low for a surveyed row in their last tile included."""
    height, width = size
    K = np.array([[50.0, 0, width / 2], [0, 50, height / 2], [0, 0, 1]])
    view, other = (
        View(k, str(k), width, height, K, np.eye(3), np.array([-0.4 * k, 0, 0]), np.zeros(0, np.int64))
        for k in range(2)
    )
    image = texture((height, width + 2), 1)
    truth = np.full(size, 10, np.float32)
    normals = np.zeros((*size, 3), np.float32)
    normals[..., 2] = -1
    estimate = DepthEstimate(truth * np.float32(1.1), np.full(size, 0.5, np.float32), np.ones(size, np.uint8))
    pictures = [np.ascontiguousarray(image[:, k : k + width]) for k in (0, 2)]
    _, depth = refine_maps(
        view, pictures[0], estimate, normals, estimate.depth.copy(), [(other, pictures[1])], OPTIONS
    )
    moved = depth != estimate.depth
    assert moved.any() == (width >= 16)
    assert not moved.any() or np.median(np.abs(depth - truth)[moved]) < 0.5


def test_a_slanted_plane_is_found_from_a_frontal_one():
    """Both depth and slope: the plane is rendered exactly, the first guess faces the camera."""
    pair = syn.slanted_plane_pair(30.0, focal_length=300.0, size=(160, 120))
    view, other = (
        View(k, name, c.width, c.height, c.K, c.R, c.t, np.zeros(0, np.int64))
        for k, (name, c) in enumerate((("a", pair.left), ("b", pair.right)))
    )
    image, source = (grey(pair.render(side)) for side in SIDES)
    truth, true_normals, _ = syn.exact_geometry(pair.surfaces, pair.left, origin=0.0)
    normals = np.zeros((*truth.shape, 3), np.float32)
    normals[..., 2] = -1
    sigma = (0.3 * truth / 300).astype(np.float32)
    estimate = DepthEstimate(truth.astype(np.float32), sigma, np.ones(truth.shape, np.uint8))
    options = replace(OPTIONS, rounds=6, slope_freedom=45.0)
    refined, depth = refine_maps(
        view, image, estimate, normals.copy(), estimate.depth.copy(), [(other, source)], options
    )
    inner = (slice(15, -15), slice(15, -15))
    assert np.median(angle(refined, true_normals)[inner]) < 10
    assert np.median(np.abs(depth - truth)[inner] / sigma[inner]) < 1


def test_a_run_refines_its_geometric_maps(block, finished, tmp_path):
    """Against the same run without refinement, at the same pixels: what is off comes nearer to the truth.

    What is exact to hundredths or tenths of a pixel, as only renders without noise are, may lose some.
    """
    plain = tmp_path / "dense"
    shutil.copytree(finished.dense, plain)
    report = colmap_sph.run(workspace=plain, options=colmap_sph.RunOptions(refinement=RefinementOptions(rounds=0)))
    assert report.made["match pairs"] == report.made["vote on depth"] == 0
    assert report.coverage == finished.report.coverage

    scene = read_scene(finished.dense / "sparse")

    def errors(dense):
        """Of depth, in pixels on the ground, and of normals, degrees; of each pixel."""
        depths, angles = [], []
        for name in block.names:
            truth, true_normals = block.truth(name)
            depth = read_depth_map(Workspace(dense).depth_map_path(name, "geometric"))
            normals = read_normal_map(Workspace(dense).normal_map_path(name, "geometric"))
            found = (depth > 0) & (truth > 0) & true_normals.any(axis=-1)
            focal_length = scene.view(name).K[0, 0]
            depths.append(np.abs(depth / truth - 1)[found] * focal_length)
            angles.append(angle(normals, true_normals)[found])
        return np.concatenate(depths), np.concatenate(angles)

    depth_errors, normal_errors = errors(finished.dense)
    plain_depth_errors, plain_normal_errors = errors(plain)
    off = np.maximum(depth_errors, plain_depth_errors) > 0.5
    assert off.mean() > 0.04
    assert np.median(depth_errors[off]) < 0.99 * np.median(plain_depth_errors[off])
    assert np.median(depth_errors) < np.median(plain_depth_errors) + 0.02
    assert np.median(normal_errors) < np.median(plain_normal_errors) + 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rounds", -1),
        ("rounds", 17),
        ("max_partners", 0),
        ("depth_freedom", 0.0),
        ("slope_freedom", 90.0),
        ("slope_freedom", 0.0),
        ("contrast", -1.0),
        ("min_score", 1.0),
        ("min_score", float("nan")),
        ("smoothing_radius", 0),
    ],
)
def test_options_out_of_bounds_are_refused(name, value):
    assert_refused(replace(OPTIONS, **{name: value}), name)


# ---- images of little detail -------------------------------------------------------------------------------


def soft(image):
    """An image that holds half of its pixels' detail: as if enlarged from half its size."""
    return cv2.GaussianBlur(image, (0, 0), 1.6)


@pytest.mark.parametrize("odd", [0, 1])
def test_soft_images_are_matched_at_half_their_size(block, scene, monkeypatch, odd):
    """In a quarter of the pixels; depth at full size comes nearer to the truth all the same."""
    views, images = scene
    matched = []
    kernel = _native.add_patch_equations

    def counted(backend, image, *given):
        matched.append(image.shape)
        kernel(backend, image, *given)

    monkeypatch.setattr("colmap_sph.stereo.refinement._native.add_patch_equations", counted)
    view = views.view(NAME).cropped(0, 0, views.view(NAME).width - odd, views.view(NAME).height - odd)
    shape = (view.height, view.width)
    truth, true_normals = (part[: shape[0], : shape[1]] for part in block.truth(NAME))
    estimate, _ = disturbed(view, truth, true_normals, pixels=0.5, degrees=0, smoothness=6.0)
    turned = true_normals + np.array([0.1, 0.1, 0])
    turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
    normals = np.where(estimate.depth[..., None] > 0, turned, 0).astype(np.float32)
    sources = [(other, soft(images[other.name])) for other in views.views if other.name != NAME]
    image = np.ascontiguousarray(soft(images[NAME])[: shape[0], : shape[1]])
    refined, depth = refine_maps(
        view, image, estimate, normals.copy(), estimate.depth.copy(), sources, OPTIONS, half_size=True
    )
    assert set(matched) == {(shape[0] // 2, shape[1] // 2)}
    np.testing.assert_array_equal(depth > 0, estimate.depth > 0)
    np.testing.assert_array_equal(refined.any(axis=-1), depth > 0)
    for rows, columns in ((0, 0), (0, 1), (1, 0), (1, 1)):
        part = (slice(rows, None, 2), slice(columns, None, 2))
        found = depth[part] > 0
        before, after = (np.abs(values - truth)[part][found] for values in (estimate.depth, depth))
        assert np.median(after) < 0.8 * np.median(before)
        before, after = (angle(values[part], true_normals[part])[found] for values in (normals, refined))
        assert np.median(after) < 0.5 * np.median(before)


@pytest.mark.parametrize(("size", "rows"), [((160, 63), 63), ((160, 120), 1)])
def test_small_images_are_matched_as_they_are(size, rows):
    """Where the image is small, or one of its partners, which has so many rows."""
    view, other, normals, estimate = slanted_plane(size)
    small = other.cropped(0, 0, other.width, rows)
    sources = [(one, texture((one.height, one.width), 1)) for one in (other, small)]
    options = replace(OPTIONS, min_score=-0.9)
    given = (view, texture(estimate.depth.shape, 2), estimate)
    results = [
        refine_maps(*given, normals.copy(), estimate.depth.copy(), sources, options, half_size=half_size)
        for half_size in (False, True)
    ]
    assert (results[0][1] != estimate.depth).any()
    for one, same in zip(*results, strict=True):
        np.testing.assert_array_equal(one, same)


@pytest.mark.parametrize(
    ("detail", "pixels", "half_size"),
    [(0.5, 0.2, True), (0.25, 1.0, True), (0.51, 1.0, False), (0.3, 0.19, False)],
)
def test_soft_images_with_imprecise_poses_are_matched_at_half_size(detail, pixels, half_size):
    assert suits_half_size(detail, pixels) == half_size
    assert OPTIONS.images_used(9, half_size=half_size) == (9 / 4 if half_size else 9)


@pytest.mark.parametrize("half_size", [False, True])
def test_memory_is_what_is_reserved(half_size):
    """Two rounds, with planes fitted anew between them: measured with all that is given."""
    shape = (4096, 256)
    size = shape[0] * shape[1]
    K, none = np.array([[1e4, 0, 128], [0, 1e4, 2048], [0, 0, 1]]), np.empty(0, np.int64)
    view, other = (View(k, str(k), *shape[::-1], K, np.eye(3), np.array([-0.1 * k, 0, 0]), none) for k in (0, 1))
    images = [np.roll(texture(shape, 1), -k, axis=1) for k in (0, 1)]
    tracemalloc.start()
    depth = np.full(shape, 1000, np.float32)
    estimate = DepthEstimate(depth.copy(), np.ones_like(depth), np.full(shape, 2, np.uint8))
    normals = np.zeros((*shape, 3), np.float32)
    normals[..., 2] = -1
    given = (view, images[0], estimate, normals, depth, [(other, images[1])], OPTIONS)
    refine_maps(*given, half_size=half_size)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    reserved = confirm._REFINE_BYTES + confirm._HALF_SIZE_BYTES * half_size + confirm._PAIRED_BYTES
    assert 0.7 * reserved < peak / size < reserved
