"""Depth from disparities against exact geometry, the vote and the confirmation against the oracle."""

from dataclasses import replace

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import assert_refused
from rendered import (
    SIDES,
    disparities,
    exact_disparity,
    pixel_rays,
    project,
    scene_of,
    scene_of_pair,
    surface_points,
)

from colmap_sph import _native
from colmap_sph import synthetic as syn
from colmap_sph.scene import View
from colmap_sph.stereo.confirm import ConfirmOptions, confirm_depth
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair
from colmap_sph.stereo.vote import VoteOptions, depth_candidates, right_disparity, vote_depth

SPHERE, FRAME = RectificationOptions(), RectificationOptions(surface="frame")
ANGLES = RectificationOptions(columns="angles")
VOTE = VoteOptions(disparity_sigma=0.3, max_disparity_step=2.0, tolerance=3.0, min_support=1)
CONFIRM = ConfirmOptions(
    max_reprojection_error=1.0, tolerance=4.0, min_consistent=2, max_contradiction=1.0, min_surface=0.0
)
SIZE = (160, 120)
RENDERED = {
    "convergent": syn.convergent_pair(20.0, focal_length=200.0, size=SIZE),
    "widely convergent": syn.convergent_pair(60.0, focal_length=200.0, size=SIZE),
    "forward": syn.forward_motion_pair(1.0, focal_length=160.0, size=SIZE),
    "epipole inside": syn.epipole_inside_pair(1.0, focal_length=160.0, size=SIZE),
}
CASES = [*((name, options) for options in (SPHERE, ANGLES) for name in RENDERED), ("convergent", FRAME)]
every_case = pytest.mark.parametrize(
    ("name", "options"), CASES, ids=[f"{name} {options.surface} {options.columns}" for name, options in CASES]
)
both_sides = pytest.mark.parametrize("side", ["left", "right"])
property_test = settings(max_examples=30, deadline=None, derandomize=True)


# ---- triangulation -----------------------------------------------------------------------------------------


def triangulate_pixel(view, pair, side, column, row, disparity, options=VOTE):
    """Depth and sigma of one pixel for a disparity in float64.

    The disparity map holds float32: what rounding takes away goes to the pair's origin.
    """
    K = view.K - np.array([[0, 0, column], [0, 0, row], [0, 0, 0]])
    rounded = np.float32(disparity)
    exact = replace(pair, left_origin=pair.left_origin + (disparity - float(rounded)))
    flat = np.full((pair.height, pair.width(side)), rounded)
    depth, sigma = depth_candidates(replace(view, K=K, width=1, height=1), flat, exact, side, options)
    return float(depth[0, 0]), float(sigma[0, 0])


@every_case
@both_sides
def test_exact_disparity_gives_exact_depth(name, options, side):
    """Relative error below 1e-6 at COLMAP's pixel origin, all over the image and for either side."""
    synthetic = RENDERED[name]
    scene, left, right = scene_of_pair(synthetic)
    pair = rectify_pair(scene, left, right, options)
    view = left if side == "left" else right
    truth, _, _ = syn.exact_geometry(synthetic.surfaces, getattr(synthetic, side), origin=0.0)
    exact = disparities(pair, left, right, surface_points(view, truth, 0.0).reshape(-1, 3))[0]
    exact = exact.reshape(truth.shape)
    compared = 0
    for row in range(0, view.height, 8):
        for column in range(0, view.width, 8):
            depth, sigma = triangulate_pixel(view, pair, side, column, row, exact[row, column])
            if truth[row, column] > 0 and depth > 0:
                assert abs(depth / truth[row, column] - 1) < 1e-6
                assert sigma > 0
                compared += 1
    assert compared > 0.9 * (truth[::8, ::8] > 0).sum()


@every_case
@both_sides
def test_sigma_is_the_slope_of_depth_over_disparity(name, options, side):
    synthetic = RENDERED[name]
    scene, left, right = scene_of_pair(synthetic)
    pair = rectify_pair(scene, left, right, options)
    view = left if side == "left" else right
    truth, _, _ = syn.exact_geometry(synthetic.surfaces, getattr(synthetic, side), origin=0.0)
    exact = disparities(pair, left, right, surface_points(view, truth, 0.0).reshape(-1, 3))[0]
    # Surer where there are more rectified pixels than the image has.
    sigma_of_disparity = VOTE.disparity_sigma * max(view.K[0, 0] / pair.scales[0], 0.8)
    for column, row in ((20, 20), (120, 40), (60, 100)):
        disparity = exact.reshape(truth.shape)[row, column]
        _, sigma = triangulate_pixel(view, pair, side, column, row, disparity)
        step = 0.01
        nearer, _ = triangulate_pixel(view, pair, side, column, row, disparity + step)
        farther, _ = triangulate_pixel(view, pair, side, column, row, disparity - step)
        assert sigma == pytest.approx(sigma_of_disparity * (farther - nearer) / (2 * step), rel=1e-3)


@every_case
@both_sides
def test_a_map_of_exact_disparities_gives_the_depth_map(name, options, side):
    """Read between rectified pixels: only the interpolation's error is left, and no shift of the grid."""
    synthetic = RENDERED[name]
    scene, left, right = scene_of_pair(synthetic)
    pair = rectify_pair(scene, left, right, options)
    view = left if side == "left" else right
    disparity, _ = exact_disparity(synthetic.surfaces, left, right, pair, side)
    depth, sigma = depth_candidates(view, disparity.astype(np.float32), pair, side, VOTE)
    truth, _, _ = syn.exact_geometry(synthetic.surfaces, getattr(synthetic, side), origin=0.0)
    found = (depth > 0) & (truth > 0)
    assert found.mean() > 0.9
    error = np.abs(depth[found] / truth[found] - 1)
    assert np.median(error) < 2e-5
    assert np.quantile(error, 0.9) < 1e-3
    assert not sigma[~(depth > 0)].any()


@pytest.mark.parametrize("scale", [100.0, 10_000.0])
@pytest.mark.parametrize("flatness", [0.0, 0.9, 1.0])
def test_rays_are_found_in_the_map_to_a_millionth_of_a_pixel(scale, flatness):
    """Angles come from approximations of arc tangent and cotangent: where a ray reads the map shows their errors.

    Where columns are flattened, a millionth of the pixels that there would be without.
    """
    rng = np.random.default_rng(0)
    rays = np.concatenate([rng.standard_normal((300, 3)), rng.standard_normal((60, 3)) * [1, 1e-3, 1]])
    rays = np.concatenate([rays, [[0, 0, 1], [0, 1, 0], [0, 0, -1], [0, -1, 0], [1, 0, 0.1], [0, 1, 1]]])
    for along_rows in (False, True):
        # The map's value is 1 at its first pixel and grows by 1 a pixel along one axis.
        ramp = np.array([[1, 2], [1, 2]], dtype=np.float32)
        ramp = np.ascontiguousarray(ramp.T) if along_rows else ramp
        for x, y, z in rays:
            across = np.hypot(y, z)
            angle = np.arctan2(x, across)
            flattened = np.tan(flatness * angle) / flatness if flatness else angle
            finer = 1 / np.cos(flatness * angle) ** 2
            u, v = flattened * scale, np.arctan2(y, z) * scale
            matrix = np.zeros((3, 3))
            matrix[:, 2] = x, y, z
            depth, sigma = np.empty((1, 1), np.float32), np.empty((1, 1), np.float32)
            origins = (u - 0.3, v - 0.6)
            geometry = ramp, matrix, (scale, scale), origins, 0.0, 1.0, 1.0, 5.0, True, flatness, True, 0
            _native.depth_candidates(backend(), *geometry, depth, sigma)
            norm = np.sqrt(x * x + across**2)
            tangent = across / (float(depth[0, 0]) * norm**2 - x)
            there = angle - np.arctan(tangent)
            seen = np.tan(flatness * there) / flatness if flatness else there
            read = (flattened - seen) * scale - 1
            assert read == pytest.approx(0.6 if along_rows else 0.3, abs=1e-6 * finer)


@pytest.mark.parametrize("flatness", [0.0, 0.7])
@pytest.mark.parametrize(
    ("focal_length", "angle"),
    [(3000.0, 0.3), (3000.0, 1.3), (400.0, 0.3), (400.0, 1.2), (60.0, 0.3), (60.0, 1.2), (60.0, 1.6), (60.0, 2.2)],
)
def test_rays_between_others_are_found_to_a_ten_thousandth_of_a_pixel(focal_length, angle, flatness):
    """Most of an image's rays are interpolated, but not where they turn fast, as at an epipole: a ramp tells."""
    width, height, scale = 300, 12, focal_length
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    matrix = turn @ np.linalg.inv([[focal_length, 0, width / 2], [0, focal_length, 5.3], [0, 0, 1.0]])
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    x, y, z = np.einsum("ij,jhw->ihw", matrix, np.stack([columns, rows, np.ones_like(rows)]))
    across = np.hypot(y, z)
    angles = np.arctan2(x, across)
    flattened = np.tan(flatness * angles) / flatness if flatness else angles
    u, v = flattened * scale, np.arctan2(y, z) * scale
    # Around the middle of all rays, as much as there is room for.
    origins = (np.median(u) - 250.3, np.median(v) - 250.6)
    u, v = u - origins[0], v - origins[1]
    ramp = (1 + 0.2 * np.arange(500) + 0.1 * np.arange(500)[:, None]).astype(np.float32)
    depth, sigma = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    geometry = ramp, matrix, (scale, scale), origins, 0.0, 1.0, 1.0, 5.0, True, flatness, True, 0
    _native.depth_candidates(backend(), *geometry, depth, sigma)
    inside = (u > 0) & (u < 499) & (v > 0) & (v < 499) & (depth > 0)
    inside &= across > 0.2 * np.hypot(x, across)  # next to the epipole 32-bit depths do not tell as much
    assert inside.sum() > 50
    there = angles - np.arctan2(across, depth * (x**2 + across**2) - x)
    seen = np.tan(flatness * there) / flatness if flatness else there
    read, expected = ((flattened - seen) * scale)[inside], (1 + 0.2 * u + 0.1 * v)[inside]
    finer = 1 / np.cos(flatness * angles[inside]) ** 2
    np.testing.assert_array_less(np.abs(read - expected), 5e-5 * finer)


@pytest.mark.parametrize("options", [SPHERE, ANGLES, FRAME], ids=["sphere", "equal angles", "frame"])
def test_candidates_do_not_depend_on_the_backend(options, monkeypatch):
    synthetic = RENDERED["convergent"]
    scene, left, right = scene_of_pair(synthetic)
    pair = rectify_pair(scene, left, right, options)
    rng = np.random.default_rng(0)
    for side, view in zip(SIDES, (left, right), strict=True):
        disparity, _ = exact_disparity(synthetic.surfaces, left, right, pair, side)
        disparity += rng.normal(0, 1.5, disparity.shape)
        disparity[rng.random(disparity.shape) < 0.2] = np.nan
        results = []
        for kernels in _native.backends():
            monkeypatch.setenv("COLMAP_SPH_KERNELS", kernels)
            results.append(depth_candidates(view, disparity.astype(np.float32), pair, side, VOTE))
        assert (results[0][0] > 0).mean() > 0.3
        for other in results[1:]:
            np.testing.assert_array_equal(other, results[0])


def test_disparities_without_a_point_in_front_give_none():
    synthetic = RENDERED["convergent"]
    scene, left, right = scene_of_pair(synthetic)
    for options in (SPHERE, FRAME):
        pair = rectify_pair(scene, left, right, options)
        for side, view in zip(SIDES, (left, right), strict=True):
            for value in (np.nan, -pair.disparity_origin, -pair.disparity_origin - 5):
                flat = np.full((pair.height, pair.width(side)), value, dtype=np.float32)
                depth, sigma = depth_candidates(view, np.nextafter(flat, np.float32(-1e9)), pair, side, VOTE)
                assert not depth.any() and not sigma.any()


def test_surfaces_are_not_mixed_across_a_step():
    """Bilinear within a surface; at a step of more than the limit the nearest pixel's side alone counts."""
    K = np.array([[100, 0, 0.0], [0, 100, 0], [0, 0, 1]])
    view = View(1, "a", 200, 8, K, np.eye(3), np.zeros(3), np.zeros(0, np.int64))
    pair = RectifiedPair("frame", np.eye(3), 1.0, 100.0, 100.0, 0.25, 0.25, 0.25, 8, 200, 200, 0.0, 50.0)
    left, right = 10.0, 13.0
    disparity = np.full((8, 200), left, dtype=np.float32)
    disparity[:, 50:] = right
    for step, expected in ((2.0, right), (4.0, 0.25 * left + 0.75 * right)):
        # Ray 50 reads column 49.75: nearer to column 50.
        depth, _ = depth_candidates(view, disparity, pair, "left", replace(VOTE, max_disparity_step=step))
        assert 100 / depth[4, 50] == pytest.approx(expected, rel=1e-6)
        assert 100 / depth[4, 49] == pytest.approx(left, rel=1e-6)
    disparity[:, 50:] = np.nan
    depth, _ = depth_candidates(view, disparity, pair, "left", VOTE)
    assert 100 / depth[4, 49] == pytest.approx(left, rel=1e-6) and depth[4, 50] == 0


# ---- from the left image to the right ----------------------------------------------------------------------


@property_test
@given(
    height=st.integers(1, 3),
    widths=st.tuples(st.integers(1, 150), st.integers(1, 150)),
    spread=st.sampled_from([0, 100, 700, 5000]),
    quantum=st.sampled_from([1, 128, 256]),
    holes=st.sampled_from([0.0, 0.2, 1.0]),
    max_step=st.sampled_from([0.0, 1.0, 2.0, 1000.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_transfer_is_the_oracles(height, widths, spread, quantum, holes, max_step, seed):
    rng = np.random.default_rng(seed)
    left = rng.integers(-spread, spread + 1, (height, widths[0])) // quantum * (quantum / 256)
    left = left.astype(np.float32)
    left[rng.random(left.shape) < holes] = np.nan
    right = np.zeros((height, widths[1]), dtype=np.float32)
    _native.transfer_disparity(left, max_step, right)
    np.testing.assert_allclose(right, oracle.transfer_disparity(left, max_step, widths[1]), atol=1e-4)


@pytest.mark.parametrize("pixels", [1, 2, 150])
def test_surfaces_are_as_wide_in_the_right_image(pixels):
    """Wherever a surface lies between two columns, it covers one for each of its pixels, as in the left image."""
    for disparity in (0.25, 0.75, 4.25, 4.75):
        left = np.full((1, 300), np.nan, dtype=np.float32)
        left[0, 100 : 100 + pixels] = disparity
        right = np.zeros((1, 300), dtype=np.float32)
        _native.transfer_disparity(left, 2.0, right)
        expected = np.round(np.arange(100, 100 + pixels) - disparity).astype(int)
        np.testing.assert_array_equal(np.flatnonzero(~np.isnan(right[0])), expected)
        assert (right[0, expected] == disparity).all()


@pytest.mark.parametrize("name", RENDERED)
def test_transfer_agrees_with_exact_geometry(name):
    """The left image's exact map, carried over, is the right image's, where both see the surface."""
    synthetic = RENDERED[name]
    scene, left, right = scene_of_pair(synthetic)
    pair = rectify_pair(scene, left, right, SPHERE)
    source, seen_by_right = exact_disparity(synthetic.surfaces, left, right, pair, "left")
    expected, seen_by_left = exact_disparity(synthetic.surfaces, left, right, pair, "right")
    source[~seen_by_right] = np.nan
    carried = right_disparity(PairDisparity("a", "b", pair, source.astype(np.float32)), 2.0)
    assert carried.shape == (pair.height, pair.right_width)
    both = seen_by_left & ~np.isnan(carried)
    # Widely convergent: some surfaces take more than three columns on the right for one on the left.
    assert both.sum() > (0.88 if "widely" in name else 0.94) * seen_by_left.sum()
    error = np.abs(carried - expected)[both]
    assert np.median(error) < 0.002
    assert (error < 0.05).mean() > 0.95
    assert (~np.isnan(carried) & ~seen_by_left & ~np.isnan(expected)).sum() < 0.05 * both.sum()


# ---- the vote ----------------------------------------------------------------------------------------------


def vote(depths, sigmas, tolerance, stations=None):
    """Depth, sigma and support, the same to the bit by every backend."""
    numbers = np.arange(len(depths)) if stations is None else np.array(stations)
    results = []
    for kernels in _native.backends():
        maps = [np.full(depths.shape[1:], 9, kind) for kind in (np.float32, np.float32, np.uint8)]
        _native.vote_depth(kernels, depths, sigmas, numbers.astype(np.int32), tolerance, *maps)
        results.append(maps)
    for other in results[1:]:
        for found, expected in zip(other, results[0], strict=True):
            np.testing.assert_array_equal(found.view(np.uint8), expected.view(np.uint8))
    return results[0]


@property_test
@given(
    count=st.integers(1, 12),
    surfaces=st.integers(1, 4),
    holes=st.sampled_from([0.0, 0.4, 1.0]),
    tolerance=st.sampled_from([0.5, 3.0]),
    twins=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_vote_is_the_oracles(count, surfaces, holes, tolerance, twins, seed):
    rng = np.random.default_rng(seed)
    shape = (count, 3, 17)
    places = rng.uniform(5, 20, (surfaces, *shape[1:]))
    chosen = np.take_along_axis(places, rng.integers(0, surfaces, shape), axis=0)
    sigmas = rng.uniform(0.01, 0.5, shape).astype(np.float32)
    depths = (chosen + sigmas * rng.standard_normal(shape)).astype(np.float32)
    none = rng.random(shape) < holes
    depths[none] = rng.choice([0, -1, np.nan], none.sum())
    stations = np.sort(rng.integers(0, 1 + count // 2, count)) if twins else np.arange(count)
    depth, sigma, support = vote(depths, sigmas, tolerance, stations)
    expected_depth, expected_sigma, expected_support, clearance = oracle.vote_depth(
        depths, sigmas, tolerance, stations
    )
    clear = clearance > 1e-4
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(support[clear], expected_support[clear])
    np.testing.assert_allclose(depth[clear], expected_depth[clear], rtol=1e-5)
    np.testing.assert_allclose(sigma[clear], expected_sigma[clear], rtol=1e-5)


def test_the_larger_cluster_wins_and_is_averaged():
    depths = np.array([7.0, 10.0, 10.2, 9.9, 7.01], dtype=np.float32).reshape(5, 1, 1)
    sigmas = np.array([0.01, 0.1, 0.2, 0.1, 0.01], dtype=np.float32).reshape(5, 1, 1)
    depth, sigma, support = vote(depths, sigmas, 3.0)
    weights = 1 / sigmas[1:4, 0, 0].astype(float) ** 2
    assert support[0, 0] == 3
    assert depth[0, 0] == pytest.approx((depths[1:4, 0, 0] * weights).sum() / weights.sum(), rel=1e-6)
    assert sigma[0, 0] == pytest.approx(weights.sum() ** -0.5, rel=1e-6)


def _noisy_depths():
    """Disparities of 10 px with noise of 0.5 px, (4, 48, 64), and what they make of depth and its sigma."""
    disparities = 10 + np.random.default_rng(0).normal(0, 0.5, (4, 48, 64))
    return disparities, (100 / disparities).astype(np.float32), (50 / disparities**2).astype(np.float32)


def test_noise_of_disparities_does_not_draw_confirmed_depths_nearer():
    """Views side by side, that look along the same rays to a pixel: the mean of four is at 10 px."""
    _, depths, sigmas = _noisy_depths()
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    places = [np.array([1e-6 * k, 0, 0]) for k in range(4)]
    views = [View(k, str(k), 64, 48, K, np.eye(3), place, np.empty(0, np.int64)) for k, place in enumerate(places)]
    support = np.full(depths[0].shape, 2, np.uint8)
    maps = [DepthEstimate(depth, sigma, support) for depth, sigma in zip(depths, sigmas, strict=True)]
    partners = list(zip(views[1:], maps[1:], strict=True))
    confirmed = confirm_depth(views[0], maps[0], partners, replace(CONFIRM, tolerance=30.0))
    kept = confirmed.depth > 0
    assert kept.mean() > 0.9
    # Of means of depths it would be 0.06; it has a standard deviation of 0.5 / sqrt(4 * 48 * 64).
    assert abs((100 / confirmed.depth[kept] - 10).mean()) < 0.02


def test_candidates_of_one_station_have_one_vote():
    """Four frames from one place say 7, two from different places 10."""
    depths = np.array([7.0, 7.0, 7.0, 7.0, 10.0, 10.2], dtype=np.float32).reshape(6, 1, 1)
    sigmas = np.full_like(depths, 0.1)
    depth, sigma, support = vote(depths, sigmas, 3.0, [1, 1, 1, 1, 2, 3])
    assert (depth[0, 0], support[0, 0]) == (pytest.approx(10.1), 2)
    assert sigma[0, 0] == pytest.approx(0.1 / 2**0.5)
    depth, sigma, support = vote(depths[:4], sigmas[:4], 3.0, [1, 1, 1, 1])
    assert (depth[0, 0], support[0, 0], sigma[0, 0]) == (7, 1, pytest.approx(0.1))


def test_more_than_255_candidates_do_not_overflow():
    depths = np.full((300, 1, 2), 5, dtype=np.float32)
    depth, _, support = vote(depths, np.full_like(depths, 0.1), 3.0)
    np.testing.assert_allclose(depth, 5)
    assert support[0, 0] == 255


# ---- consistency between views -----------------------------------------------------------------------------


def wall_views(count=5, depth=10.0):
    """Views side by side that look at the plane z = depth, with exact depth at COLMAP's pixel origin."""
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    views = []
    for k in range(count):
        R, t = syn.look_at((0.8 * (k - count // 2), 0.1 * k, 0), (0, 0, depth), up=(0, -1, 0))
        views.append(View(k + 1, f"{k}", 64, 48, K, R, t, np.zeros(0, dtype=np.int64)))
    return views, [plane_depth(view, depth) for view in views]


def plane_depth(view, depth):
    column, row = np.meshgrid(np.arange(view.width), np.arange(view.height))
    rays = pixel_rays(view, column, row)
    return ((depth - view.center[2]) / rays[:, 2]).reshape(column.shape).astype(np.float32)


def estimate(depth, sigma=0.02, support=2):
    depth = depth.astype(np.float32)
    return DepthEstimate(
        depth, np.where(depth > 0, np.float32(sigma), np.float32(0)), np.full(depth.shape, support, np.uint8)
    )


def confirm(views, maps, options=CONFIRM, support=2):
    partners = [(v, estimate(m, support=support)) for v, m in zip(views[1:], maps[1:], strict=True)]
    return confirm_depth(views[0], estimate(maps[0]), partners, options)


@pytest.mark.parametrize("kernels", _native.backends())
@pytest.mark.parametrize("max_error", [1.0, 0.1])
@pytest.mark.parametrize("counted", [3, 255])
@pytest.mark.parametrize("silence_counts", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_consistency_is_the_oracles(seed, silence_counts, counted, max_error, kernels):
    """Verdicts and weighted sums on noisy, holed depth maps of views that turn and differ."""
    rng = np.random.default_rng(seed)
    views, maps = wall_views(3)
    views[1] = replace(views[1], width=50, height=60, K=np.array([[70.0, 0, 24], [0, 65, 31], [0, 0, 1]]))
    maps[1] = plane_depth(views[1], 10.0)
    sigmas = [rng.uniform(0.02, 0.2, depth.shape).astype(np.float32) for depth in maps]
    for depth, sigma in zip(maps, sigmas, strict=True):
        depth += (sigma * rng.standard_normal(depth.shape) * rng.choice([1, 5], depth.shape)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.1] = 0
        depth[rng.random(depth.shape) < 0.1] *= 0.6
    reference, partner = views[0], views[1]
    shape = maps[0].shape
    support = rng.integers(0, 4, maps[1].shape).astype(np.uint8)
    observing, agreeing, contradicting = (np.full(shape, counted, np.uint8) for _ in range(3))
    weighted, weight = np.full(shape, 0.5, np.float32), np.full(shape, 2, np.float32)
    forward = np.hstack([partner.R @ reference.R.T @ np.linalg.inv(reference.K), np.zeros((3, 1))])
    forward[:, 3] = partner.t - partner.R @ reference.R.T @ reference.t
    back = np.hstack([reference.R @ partner.R.T @ np.linalg.inv(partner.K), np.zeros((3, 1))])
    back[:, 3] = reference.t - reference.R @ partner.R.T @ partner.t
    _native.compare_depths(
        kernels,
        maps[0],
        sigmas[0],
        maps[1],
        sigmas[1],
        support,
        partner.K @ forward,
        reference.K @ back,
        max_error,
        4.0,
        2,
        silence_counts,
        observing,
        agreeing,
        contradicting,
        weighted,
        weight,
    )
    verdict, seen, carried, spread, clearance = oracle.compare_depths(
        reference,
        maps[0],
        sigmas[0],
        partner,
        (maps[1], sigmas[1], support),
        max_error,
        4.0,
        2,
        silence_counts=silence_counts,
    )
    clear = clearance > 1e-4
    assert clear.mean() > 0.95 and (verdict > 0).mean() > 0.1 and (verdict < 0).mean() > 0.01
    # Counts stay at 255 rather than wrap around.
    assert 0.05 < seen.mean() < 0.95
    np.testing.assert_array_equal(observing[clear], np.minimum(counted + seen[clear], 255))
    np.testing.assert_array_equal(agreeing[clear], np.minimum(counted + (verdict > 0)[clear], 255))
    np.testing.assert_array_equal(contradicting[clear], np.minimum(counted + (verdict < 0)[clear], 255))
    agreed = clear & (verdict > 0)
    np.testing.assert_allclose(weight[agreed] - 2, 1 / spread[agreed] ** 2, rtol=1e-4)
    sums = (1 / carried[agreed] - 1 / maps[0][agreed]) / spread[agreed] ** 2
    np.testing.assert_allclose(weighted[agreed] - 0.5, sums, rtol=1e-3, atol=0.02)
    assert (weight[verdict <= 0] == 2).all() and (weighted[verdict <= 0] == 0.5).all()


@pytest.mark.parametrize("odd", [0, np.nan, np.inf, -1, 1e-40])
@pytest.mark.parametrize("shift", [0.0, 0.3, -2.5])
@pytest.mark.parametrize("silence_counts", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (3, 1), (1, 2), (5, 127), (4, 128), (3, 129), (2, 300)])
def test_consistency_does_not_depend_on_the_backend(size, silence_counts, shift, odd):
    """Rows that fill blocks and do not, points on the rim of the partner's map, and depths that are none."""
    rng = np.random.default_rng(0)
    maps = [rng.uniform(*bounds, size).astype(np.float32) for bounds in ((9.9, 10.1), (0.01, 0.1)) * 2]
    for values in maps:
        values[rng.random(size) < 0.1] = odd
    support = rng.integers(0, 4, size).astype(np.uint8)
    forward, back = (np.column_stack([np.eye(3), [sign * 10 * shift, 0, 0]]) for sign in (1, -1))
    results = []
    for kernels in _native.backends():
        sums = [np.full(size, counted, np.uint8) for counted in (0, 254, 255)]
        sums += [np.full(size, -0.0, np.float32), np.full(size, 2, np.float32)]
        _native.compare_depths(
            kernels, maps[0], maps[1], maps[2], maps[3], support, forward, back, 2.0, 4.0, 2, silence_counts, *sums
        )
        results.append(sums)
    assert results[0][0].any() or size[1] <= abs(shift) + 1
    for other in results[1:]:
        for one, same in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(one.view(np.uint8), same.view(np.uint8))


def test_at_the_rim_the_nearest_depth_is_taken():
    """The last column has no neighbours to interpolate with, though points half a pixel before it have."""
    maps = (np.full((2, 3), 10, np.float32), np.full((2, 3), 0.05, np.float32))
    partner = np.array([[10, 10, 10.1], [10, 10, 10.1]], np.float32)
    for shift, carried in ((0.0, 10.1), (-0.5, 1 / (0.5 / 10 + 0.5 / 10.1))):
        forward, back = (np.column_stack([np.eye(3), [sign * 10 * shift, 0, 0]]) for sign in (1, -1))
        for kernels in _native.backends():
            counts = [np.zeros((2, 3), np.uint8) for _ in range(3)]
            sums = [np.zeros((2, 3), np.float32) for _ in range(2)]
            support = np.ones((2, 3), np.uint8)
            matrices = (forward, back)
            sigmas = maps[1]
            _native.compare_depths(
                kernels,
                maps[0],
                sigmas,
                partner,
                sigmas,
                support,
                *matrices,
                2.0,
                4.0,
                2,
                False,
                counts[0],
                counts[1],
                counts[2],
                sums[0],
                sums[1],
            )
            assert sums[0][0, 2] / sums[1][0, 2] == pytest.approx(1 / carried - 1 / 10, rel=1e-4)


def test_exact_maps_confirm_each_other_and_stay_as_they_are():
    views, maps = wall_views()
    confirmed = confirm(views, maps)
    kept = confirmed.depth > 0
    assert kept.mean() > 0.6
    np.testing.assert_allclose(confirmed.depth[kept], maps[0][kept], rtol=1e-4)
    assert (confirmed.sigma[kept] < 0.02).all() and not confirmed.sigma[~kept].any()
    assert confirmed.support.max() == 4
    alone = confirmed.support[kept] < CONFIRM.min_consistent
    assert 0 < alone.mean() < 0.3


def test_averaging_with_partners_reduces_noise():
    rng = np.random.default_rng(0)
    views, maps = wall_views()
    noisy = [depth + np.float32(0.02) * rng.standard_normal(depth.shape).astype(np.float32) for depth in maps]
    confirmed = confirm(views, noisy)
    kept = confirmed.support >= 4
    before, after = (noisy[0] - maps[0])[kept].std(), (confirmed.depth - maps[0])[kept].std()
    assert after < 0.6 * before
    assert confirmed.sigma[kept].mean() == pytest.approx(0.02 / np.sqrt(5), rel=1e-3)


@pytest.mark.parametrize("exponent", [-40, 40])
def test_depth_is_confirmed_alike_in_all_units(exponent):
    """Also where a power of depths that is no float enters: powers of two change nothing else."""
    rng = np.random.default_rng(4)
    views, maps = wall_views(5)
    noisy = [depth + np.float32(0.02) * rng.standard_normal(depth.shape).astype(np.float32) for depth in maps]
    unit = np.float32(2.0**exponent)
    rescaled = [replace(view, t=view.t * float(unit)) for view in views]

    def confirmed(views, unit):
        first, *others = (
            DepthEstimate(depth * unit, np.full_like(depth, 0.02) * unit, np.full(depth.shape, 4, np.uint8))
            for depth in noisy
        )
        return confirm_depth(views[0], first, zip(views[1:], others, strict=True), CONFIRM)

    usual, other = confirmed(views, np.float32(1)), confirmed(rescaled, unit)
    assert (usual.support >= 4).any()
    np.testing.assert_array_equal(other.support, usual.support)
    np.testing.assert_array_equal(other.depth, usual.depth * unit)
    np.testing.assert_array_equal(other.sigma, usual.sigma * unit)


def in_view(reference, other, depth):
    """Where the other view has the plane point of a reference pixel inside its image."""
    column, row = np.meshgrid(np.arange(reference.width), np.arange(reference.height))
    along = plane_depth(reference, depth).reshape(-1, 1)
    uv, _ = project(other, reference.center + pixel_rays(reference, column, row) * along)
    return ((uv >= 0) & (uv <= [other.width - 1, other.height - 1])).all(axis=1).reshape(column.shape)


UNSURE = replace(CONFIRM, min_contradicting_support=255)


def test_one_view_is_enough_where_no_other_has_a_depth():
    views, maps = wall_views(3)
    first, second = (in_view(views[0], view, 10.0) for view in views[1:])
    assert 0.01 < (first & ~second).mean() < 0.5 < (first & second).mean()
    # Where the second has another depth it could have confirmed it and did not.
    maps[2] = plane_depth(views[2], 14.0)
    np.testing.assert_array_equal(confirm(views, maps, UNSURE).depth > 0, first & ~second)
    # Unless that is nearer and blocks its sight, or there is none.
    maps[2] = plane_depth(views[2], 4.0)
    np.testing.assert_array_equal(confirm(views, maps, UNSURE).depth > 0, first)
    maps[2][:, maps[2].shape[1] // 8 :] = 0
    np.testing.assert_array_equal(confirm(views, maps, UNSURE).depth > 0, first)


def test_an_image_with_hardly_any_depth_does_not_confirm():
    """It may be of another place: two images that fit each other would pass by its silence."""
    views, maps = wall_views(3)
    first, second = (in_view(views[0], view, 10.0) for view in views[1:])
    maps[2][:, maps[2].shape[1] // 16 :] = 0
    confirmed = confirm(views, maps, UNSURE)
    np.testing.assert_array_equal(confirmed.depth[~second] > 0, first[~second])
    with_depth = confirm([views[0], views[2]], [maps[0], maps[2]], replace(UNSURE, min_surface=0)).depth > 0
    np.testing.assert_array_equal(confirmed.depth[second] > 0, (first & with_depth)[second])


def test_a_view_of_the_sky_may_have_hardly_any_depth():
    """Where other views of its photograph have some: these say that it is of this place."""
    views, maps = wall_views(3)
    first = in_view(views[0], views[1], 10.0)
    maps[2][:, maps[2].shape[1] // 16 :] = 0
    sky = replace(views[2], original="photograph")
    back = replace(sky, name="back", R=np.diag([-1.0, 1.0, -1.0]) @ sky.R, t=np.diag([-1.0, 1.0, -1.0]) @ sky.t)
    partners = [(views[1], estimate(maps[1])), (sky, estimate(maps[2])), (back, estimate(maps[1]))]
    confirmed = confirm_depth(views[0], estimate(maps[0]), partners, UNSURE, [1, 2, 2], [0.0] * 3)
    np.testing.assert_array_equal(confirmed.depth > 0, first)


def test_what_too_few_views_confirm_is_dropped():
    views, maps = wall_views(4)
    for k in (2, 3):
        maps[k] = plane_depth(views[k], 14.0)
    seen = in_view(views[0], views[2], 10.0)
    assert not confirm(views, maps, UNSURE).depth[seen].any()
    assert confirm(views, maps, replace(UNSURE, min_consistent=1)).depth[seen].any()
    assert (confirm(views, maps, replace(UNSURE, min_consistent=0)).depth > 0).all()


def test_what_one_view_confirms_in_passing_is_dropped():
    """Of what one view alone confirms, only what is part of a surface stays."""
    views, maps = wall_views(2)
    shape = maps[0].shape
    second = in_view(views[0], views[1], 10.0)
    speckles = np.zeros(shape, bool)
    speckles[::9, ::9] = speckles[1::9, ::9] = True
    block = np.zeros(shape, bool)
    block[15:45, 20:50] = True
    maps[0] = np.where(speckles | block, maps[0], 0)
    confirmed = confirm(views, maps, replace(CONFIRM, min_surface=0.8)).depth > 0
    inner = np.zeros(shape, bool)
    inner[18:42, 23:47] = True
    assert (inner & second).sum() > 100
    assert confirmed[inner & second].all()
    # Nothing outside the block, whose corners have little more than a third of a window around them.
    assert not confirmed[~block].any() and not confirmed[15, 20]
    assert (confirm(views, maps).depth > 0)[speckles & second].all()


def inner(mask, radius):
    """Where all pixels within a radius are set, on an image that goes on beyond its border."""
    padded = np.pad(mask, radius, constant_values=True)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * radius + 1, 2 * radius + 1))
    return windows.all(axis=(2, 3))


def test_a_surface_stands_for_one_view_that_does_not_confirm():
    views, maps = wall_views(3)
    first, second = (in_view(views[0], view, 10.0) for view in views[1:])
    maps[2] = plane_depth(views[2], 14.0)
    options = replace(UNSURE, min_surface=0.6)
    unsure = inner(first, 2) & second
    assert unsure.mean() > 0.2
    assert (confirm(views, maps, options).depth > 0)[unsure].all()
    # Not where that view looks through it, nor beside a view of which nothing is known.
    assert not (confirm(views, maps, replace(options, min_contradicting_support=2)).depth > 0)[unsure].any()
    silent = [maps[0], maps[1], np.where(np.arange(views[2].width) < 4, maps[2], 0)]
    assert not (confirm(views, silent, options).depth > 0)[unsure].any()
    # Of two rows of three a window holds three fifths.
    sparse = [np.where((np.arange(views[0].height) % 3 < 2)[:, None], maps[0], 0), *maps[1:]]
    assert not (confirm(views, sparse, options).depth > 0)[unsure].any()
    milder = confirm(views, sparse, replace(options, min_surface=0.1)).depth > 0
    assert milder[2:-2][(unsure & (sparse[0] > 0))[2:-2]].all()


GHOST = (slice(18, 30), slice(26, 38))


def with_ghost(views, maps, seen_by, depth=5.0):
    """A patch that floats at z = depth, in the depth maps of some of the views."""
    corners = surface_points(views[0], plane_depth(views[0], depth), 0.0)[GHOST].reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    for k in seen_by:
        nearer = plane_depth(views[k], depth)
        place = surface_points(views[k], nearer, 0.0)
        inside = ((place >= low - 1e-6) & (place <= high + 1e-6))[..., :2].all(axis=-1)
        maps[k] = np.where(inside, nearer, maps[k])
    return maps


def test_a_ghost_that_others_see_through_is_dropped():
    """Two views share the mistake, so it is confirmed twice, but more views see the wall behind it."""
    views, maps = wall_views(7)
    views = [views[3], *views[:3], *views[4:]]
    maps = [maps[3], *maps[:3], *maps[4:]]
    maps = with_ghost(views, maps, seen_by=(0, 1, 2))
    inner = (slice(20, 28), slice(28, 36))
    assert (maps[0][inner] < 6).all()
    assert not confirm(views, maps).depth[inner].any()
    lenient = confirm(views, maps, replace(CONFIRM, max_contradiction=10.0))
    assert (lenient.depth[inner] > 0).all() and (lenient.support[inner] == 2).all()
    # What a single pair says of the wall behind does not count against two views.
    unsure = confirm(views, maps, support=1)
    np.testing.assert_array_equal(unsure.depth[inner], lenient.depth[inner])
    assert not confirm(views, maps, replace(CONFIRM, min_contradicting_support=1), support=1).depth[inner].any()


def test_an_occluded_point_is_not_contradicted():
    """A patch hides the wall from four views; the two others confirm it, and nobody looks through it."""
    views, maps = wall_views(7)
    views = [views[3], *views[:3], *views[4:]]
    maps = [maps[3], *maps[:3], *maps[4:]]
    hidden = with_ghost(views, [m.copy() for m in maps], seen_by=(1, 2, 3, 4))
    strict = replace(CONFIRM, max_contradiction=0.0)
    before, after = confirm(views, maps, strict), confirm(views, hidden, strict)
    assert (after.support < before.support).sum() > 50
    enough = before.support >= 6
    np.testing.assert_array_equal(after.depth[enough] > 0, before.depth[enough] > 0)


# ---- whole views -------------------------------------------------------------------------------------------


def exact_pairs(synthetic, views, scene, indices):
    pairs = []
    for a, b in indices:
        geometry = rectify_pair(scene, views[a], views[b], SPHERE)
        disparity, seen = exact_disparity(synthetic, views[a], views[b], geometry, "left")
        disparity[~seen] = np.nan
        pairs.append(PairDisparity(views[a].name, views[b].name, geometry, disparity.astype(np.float32)))
    return pairs


def test_a_view_takes_depth_from_pairs_in_which_it_is_left_or_right():
    first, second = RENDERED["convergent"], RENDERED["widely convergent"]
    cameras = (first.left, first.right, second.right)
    scene = scene_of(first.surfaces, cameras)
    pairs = exact_pairs(first.surfaces, scene.views, scene, [(0, 1), (1, 2)])
    view = scene.views[1]
    truth, _, _ = syn.exact_geometry(first.surfaces, first.right, origin=0.0)
    result = vote_depth(view, pairs, VOTE)
    for field, dtype in (("depth", np.float32), ("sigma", np.float32), ("support", np.uint8)):
        assert getattr(result, field).shape == truth.shape and getattr(result, field).dtype == dtype
    found = result.depth > 0
    assert found.mean() > 0.7
    assert np.median(np.abs(result.depth / truth - 1)[found]) < 1e-4
    assert (np.abs(result.depth / truth - 1)[found] < 0.005).mean() > 0.97
    assert (result.support == 2).mean() > 0.4 and result.support.max() == 2
    stricter = vote_depth(view, pairs, replace(VOTE, min_support=2))
    np.testing.assert_array_equal(stricter.depth > 0, found & (result.support == 2))


@pytest.mark.parametrize(("disparity", "pairs", "is_known"), [(2, 1, False), (2, 2, True), (3, 1, True)])
def test_depths_are_known_to_a_tenth_or_not_at_all(disparity, pairs, is_known):
    # A standard deviation of .25 pixels, of d pixels, is a share of 1 / 4 d; by n pairs that over √n.
    K = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    view = View(1, "a", 64, 48, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))
    geometry = RectifiedPair(
        surface="frame",
        rectified_from_world=np.eye(3),
        baseline=1.0,
        columns_per_radian=100.0,
        rows_per_radian=100.0,
        row_origin=-24.0,
        left_origin=-32.0,
        right_origin=-32.0,
        height=48,
        left_width=64,
        right_width=64,
        min_disparity=0.0,
        max_disparity=20.0,
    )
    pair = PairDisparity("a", "b", geometry, np.full((48, 64), disparity, np.float32))
    depth = vote_depth(view, [pair] * pairs, VoteOptions()).depth[8:40, 8:56]
    np.testing.assert_allclose(depth, 100 / disparity if is_known else 0)


def test_a_view_without_pairs_has_no_depth():
    view = wall_views(1)[0][0]
    result = vote_depth(view, [], VOTE)
    assert result.depth.shape == (48, 64)
    assert not result.depth.any() and not result.support.any()
    assert not confirm_depth(view, result, [], CONFIRM).depth.any()


@pytest.mark.parametrize(
    ("record", "name", "value"),
    [
        *[
            (VoteOptions, name, value)
            for name in ("disparity_sigma", "max_disparity_step", "tolerance")
            for value in (0, -1, np.nan)
        ],
        *[(VoteOptions, "min_support", value) for value in (0, 256)],
        *[(ConfirmOptions, name, np.nan) for name in ("max_reprojection_error", "tolerance", "max_contradiction")],
        *[(ConfirmOptions, "min_contradicting_support", value) for value in (0, 256)],
        *[(ConfirmOptions, "min_consistent", value) for value in (-1, 256)],
        (ConfirmOptions, "max_contradiction", -0.1),
        (ConfirmOptions, "min_surface", 1.5),
        (ConfirmOptions, "min_surface", np.nan),
    ],
)
def test_options_out_of_bounds_are_refused(record, name, value):
    record().check()
    assert_refused(record(**{name: value}), name)
