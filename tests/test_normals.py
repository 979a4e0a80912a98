"""Normals of planes in closed form, with and without noise, and next to edges."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import assert_refused
from rendered import pixel_rays

from colmap_sph import _native
from colmap_sph.scene import View
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.normals import NormalOptions, fit_normals

OPTIONS = NormalOptions(radius=4, tolerance=6.0, max_shift=1.0, max_incidence=90.0)
# Two thousand pixels a radian of parallax: depth 10 with a baseline of 2 and a focal length of 400.
PIXELS_PER_INVERSE_DEPTH = 800.0
VIEW = View(
    1,
    "a",
    120,
    90,
    np.array([[400.0, 0, 47.3], [0, 380, 51.9], [0, 0, 1]]),
    np.eye(3),
    np.zeros(3),
    np.zeros(0, dtype=np.int64),
)


def plane_normal(slant, tilt):
    s, t = np.radians(slant), np.radians(tilt)
    return np.array([np.sin(s) * np.cos(t), np.sin(s) * np.sin(t), -np.cos(s)])


def inverse_depth(normal, point=(0.0, 0.0, 10.0), view=VIEW):
    """(H, W) inverse depth of a plane at COLMAP's pixel origin: 0 where it is behind the camera."""
    column, row = np.meshgrid(np.arange(view.width), np.arange(view.height))
    rays = pixel_rays(view, column, row).reshape(*column.shape, 3)
    return np.maximum(rays @ normal / (np.asarray(point) @ normal), 0)


def estimate(inverse, noise, seed=None):
    """Depth map with a standard deviation of `noise` pixels of disparity; the noise itself with a seed."""
    sigma = noise / PIXELS_PER_INVERSE_DEPTH
    if seed is not None:
        inverse = inverse + sigma * np.random.default_rng(seed).standard_normal(inverse.shape) * (inverse > 0)
    with np.errstate(divide="ignore"):
        depth = np.where(inverse > 0, 1 / inverse, 0).astype(np.float32)
    return DepthEstimate(depth, sigma * depth**2, np.ones(depth.shape, np.uint8))


def planes_of(given, options=OPTIONS):
    """(H, W) depths of fitted planes alone, without their relief."""
    inverse = np.where(given.depth > 0, 1 / np.maximum(given.depth, 1e-9), 0).astype(np.float32)
    sigma = (given.sigma * inverse**2).astype(np.float32)
    normals, fitted = np.zeros((*inverse.shape, 3), np.float32), np.zeros_like(inverse)
    gates = (options.max_shift, 2, np.cos(np.radians(options.max_incidence)), 3)
    fit = (VIEW.K, options.radius, options.tolerance, *gates)
    _native.fit_planes("scalar", inverse, sigma, given.support, *fit, normals, fitted)
    return fitted


def angles(normals, truth):
    """Degrees between fitted and true normals, (H, W)."""
    cross = np.linalg.norm(np.cross(normals, truth), axis=-1)
    return np.degrees(np.arctan2(cross, (normals * truth).sum(axis=-1)))


def assert_unit_and_towards_the_camera(normals, view=VIEW):
    found = normals.any(axis=-1)
    np.testing.assert_allclose(np.linalg.norm(normals[found], axis=-1), 1, atol=1e-6)
    column, row = np.meshgrid(np.arange(view.width), np.arange(view.height))
    rays = pixel_rays(view, column, row).reshape(*column.shape, 3)
    assert ((normals * rays).sum(axis=-1)[found] < 0).all()


SLANTS = [0, 15, 30, 45, 60, 75]


@pytest.mark.parametrize("slant", SLANTS)
@pytest.mark.parametrize("tilt", [0, 130, 270])
def test_exact_planes_give_exact_normals(slant, tilt):
    normal = plane_normal(slant, tilt)
    exact = estimate(inverse_depth(normal), noise=0.3)
    normals, depth = fit_normals(VIEW, exact, OPTIONS)
    assert normals.shape == (90, 120, 3) and normals.dtype == np.float32 and depth.dtype == np.float32
    found = exact.depth > 0
    assert found.mean() > 0.8
    assert angles(normals, normal)[found].max() < 0.1
    np.testing.assert_allclose(depth[found], exact.depth[found], rtol=1e-4)
    assert not normals[~found].any() and not depth[~found].any()
    assert_unit_and_towards_the_camera(normals)


@pytest.mark.parametrize("slant", SLANTS)
@pytest.mark.parametrize("noise", [0.01, 0.05, 0.15])
def test_noisy_planes_give_normals_within_ten_degrees(slant, noise):
    normal = plane_normal(slant, 40)
    exact = inverse_depth(normal)
    noisy = estimate(exact, noise, seed=slant)
    normals, depth = fit_normals(VIEW, noisy, OPTIONS)
    found = noisy.depth > 0
    assert (angles(normals, normal)[found] < 10).mean() >= 0.95
    assert_unit_and_towards_the_camera(normals)
    # The fitted depth is less noisy than what it was fitted to.
    inner = (depth > 0) & (exact > 0)
    before, after = (np.abs(1 / values[inner] - exact[inner]) for values in (noisy.depth, depth))
    assert np.median(after) < 0.5 * np.median(before)


def test_normals_do_not_depend_on_the_backend(monkeypatch):
    noisy = estimate(inverse_depth(plane_normal(40, 70)), noise=0.3, seed=3)
    noisy.depth[np.random.default_rng(0).random(noisy.depth.shape) < 0.3] = 0
    results = []
    for kernels in _native.backends():
        monkeypatch.setenv("COLMAP_SPH_KERNELS", kernels)
        results.append(fit_normals(VIEW, noisy, OPTIONS))
    for other in results[1:]:
        for first, second in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("tilt", [0, 90, 45])
def test_normals_at_a_ridge_belong_to_either_side(tilt):
    """A roof of two planes of 40 degrees: two pixels beside the ridge a normal is its own plane's."""
    sides = [plane_normal(40, tilt), plane_normal(-40, tilt)]
    planes = np.stack([inverse_depth(normal) for normal in sides])
    roof = estimate(planes.min(axis=0), noise=0.05, seed=1)
    normals, _ = fit_normals(VIEW, roof, OPTIONS)
    both = np.stack([angles(normals, normal) for normal in sides])
    own = np.take_along_axis(both, planes.argmin(axis=0)[None], axis=0)[0]
    gradient = np.hypot(*np.gradient(planes[0] - planes[1]))
    beside = np.abs(planes[0] - planes[1]) > 2 * gradient
    assert (own[beside] < 10).mean() > 0.9
    assert (own < 10).mean() > 0.9


def test_normals_beside_a_step_ignore_the_other_surface():
    near, far = plane_normal(30, 0), plane_normal(20, 200)
    column = np.broadcast_to(np.arange(VIEW.width) < 60, (VIEW.height, VIEW.width))
    inverse = np.where(column, inverse_depth(near, (0, 0, 7)), inverse_depth(far))
    step = estimate(inverse, noise=0.1, seed=2)
    normals, _ = fit_normals(VIEW, step, OPTIONS)
    error = np.where(column, angles(normals, near), angles(normals, far))
    assert (error[:, 56:64] < 10).mean() > 0.9
    assert (error < 10).mean() > 0.95


def test_outliers_do_not_turn_normals():
    normal = plane_normal(45, 70)
    inverse = inverse_depth(normal)
    rng = np.random.default_rng(0)
    wild = rng.random(inverse.shape) < 0.1
    inverse[wild] *= rng.uniform(1.3, 2, wild.sum())
    normals, _ = fit_normals(VIEW, estimate(inverse, noise=0.1, seed=3), OPTIONS)
    assert (angles(normals, normal)[~wild] < 10).mean() > 0.95


def test_holes_have_no_normals_and_neighbours_keep_theirs():
    normal = plane_normal(50, 10)
    inverse = inverse_depth(normal)
    hole = np.random.default_rng(0).random(inverse.shape) < 0.4
    inverse[hole] = 0
    normals, depth = fit_normals(VIEW, estimate(inverse, noise=0.3), OPTIONS)
    assert not normals[hole].any() and not depth[hole].any()
    assert angles(normals, normal)[~hole].max() < 0.1


def fitted_slowly(inverse, sigma, row, column, options):
    """Inverse depth of a pixel's plane and its change along row and column, tap by tap; None without a plane.

    The first two of three rounds look at every second row and column.
    """
    radius, centre = options.radius, inverse[row, column]
    noise = min(options.tolerance * sigma[row, column] / centre, 1)
    plane = np.zeros(3)
    solved = False
    for step, widening in ((2, 1 + radius), (2, 2), (1, 1)):
        places = [place for place in range(-radius, radius + 1) if place % step == 0]
        taps = []
        for j in places:
            for i in places:
                inside = 0 <= row + j < inverse.shape[0] and 0 <= column + i < inverse.shape[1]
                if not inside or inverse[row + j, column + i] == 0:
                    continue
                value = inverse[row + j, column + i] / centre - 1
                error = value - plane @ [1, i, j]
                near = (1 - (i / (radius + 1)) ** 2) ** 2 * (1 - (j / (radius + 1)) ** 2) ** 2
                taps.append((near / (1 + (error / (noise * widening)) ** 2) ** 2, i, j, value))
        weight, i, j, value = np.array(taps).T
        A = np.column_stack([np.ones_like(i), i, j])
        normal_matrix = (A * weight[:, None]).T @ A
        solved = np.linalg.det(normal_matrix) > 1e-6 * weight.sum() ** 3
        if solved:
            plane = np.linalg.solve(normal_matrix, (A * weight[:, None]).T @ value)
    return centre * (plane + np.array([1, 0, 0])) if solved else None


def with_relief_slowly(own, sigma, planes):
    """Inverse depths of planes moved towards those of their pixels where planes bend, pixel by pixel; 0 = none."""
    height, width = planes.shape
    there = planes > 0

    def around(row, column, reach):
        rows = range(max(row - reach, 0), min(row + reach + 1, height))
        columns = range(max(column - reach, 0), min(column + reach + 1, width))
        return [(y, x) for y in rows for x in columns if there[y, x]]

    def bend(row, column):
        bends = [0.0]
        for before, after in (((row - 2, column), (row + 2, column)), ((row, column - 2), (row, column + 2))):
            if min(before) >= 0 and after[0] < height and after[1] < width and there[before] and there[after]:
                bends.append(abs(planes[before] + planes[after] - 2 * planes[row, column]) / sigma[row, column])
        return min(max(bends), 50)

    moved = planes.copy()
    for row, column in np.argwhere(there):
        near = around(row, column, 1)
        bent = np.mean([bend(*place) for place in near])
        residual = np.mean([own[place] - planes[place] for place in near])
        most = own[row, column] - planes[row, column]
        moved[row, column] += np.clip(residual, min(most, 0), max(most, 0)) * bent**2 / (bent**2 + 16)
    return moved


@pytest.mark.parametrize("radius", [2, 3, 4])
def test_planes_are_those_of_a_slow_fit(radius):
    """Noise, a step between two surfaces, and holes between which few neighbours are left; then their relief."""
    rng = np.random.default_rng(radius)
    view = replace(VIEW, width=24, height=20)
    inverse = inverse_depth(plane_normal(40, 30), view=view)
    inverse[:, 11:] *= 1.2
    inverse = np.where(rng.random(inverse.shape) < np.linspace(0.1, 1, 20)[:, None], inverse, 0)
    given = estimate(inverse, 0.3, seed=1)
    options = replace(OPTIONS, radius=radius, max_shift=1e9)
    normals, depth = fit_normals(view, given, options)
    inverse = np.where(given.depth > 0, 1 / np.maximum(given.depth, 1e-9), 0)
    sigma = given.sigma * inverse**2
    planes = np.zeros(inverse.shape)
    for row, column in np.argwhere(given.depth > 0):
        plane = fitted_slowly(inverse, sigma, row, column, options)
        if plane is None or plane[0] <= 0:
            assert depth[row, column] == 0
            continue
        planes[row, column] = plane[0]
        value, right, down = plane
        expected = view.K.T @ [right, down, value - right * column - down * row]
        np.testing.assert_allclose(normals[row, column], -expected / np.linalg.norm(expected), atol=2e-3)
    found = planes > 0
    assert found.sum() > 150
    np.testing.assert_allclose(depth[found], 1 / with_relief_slowly(inverse, sigma, planes)[found], rtol=1e-4)
    assert not np.allclose(depth[found], 1 / planes[found], rtol=1e-3)


def test_neighbours_off_the_coarse_rounds_are_enough_for_a_plane():
    """Two by two pixels of a plane alone: no two of them lie in one of every second rows and columns."""
    normal = plane_normal(40, 30)
    inverse = inverse_depth(normal)
    lone = np.zeros(inverse.shape, np.bool_)
    lone[30:32, 40:42] = lone[60:62, 71:73] = True
    normals, _ = fit_normals(VIEW, estimate(np.where(lone, inverse, 0), 0.1), OPTIONS)
    assert (normals.any(axis=-1) == lone).all()
    assert angles(normals, normal)[lone].max() < 0.5


def test_ridges_are_not_cut_off():
    """Two roofs that meet in a line: planes near it cut it off, and their relief puts it back."""
    ridge = np.maximum(inverse_depth(plane_normal(50, 0)), inverse_depth(plane_normal(50, 180)))
    planes_alone, errors = {}, {}
    for seed in (None, 7):
        given = estimate(ridge, noise=0.1, seed=seed)
        given.support[:] = 3
        _, fitted = fit_normals(VIEW, given, OPTIONS)
        column = round(VIEW.K[0, 2])
        near = np.s_[5:-5, column - 2 : column + 3]
        errors[seed] = np.abs(fitted - 1 / ridge)[near].mean()
        planes_alone[seed] = np.abs(planes_of(given) - 1 / ridge)[near].mean()
    assert errors[None] < 0.75 * planes_alone[None]
    assert errors[7] < 0.75 * planes_alone[7]


def test_flat_surfaces_have_no_relief():
    """Where planes do not bend, the noise of the depths stays away."""
    normal = plane_normal(30, 70)
    noisy = estimate(inverse_depth(normal), noise=0.3, seed=2)
    exact = 1 / inverse_depth(normal)
    inner = np.s_[5:-5, 5:-5]
    _, fitted = fit_normals(VIEW, noisy, OPTIONS)
    error = np.sqrt(np.square(fitted - exact)[inner].mean())
    assert error < 1.01 * np.sqrt(np.square(planes_of(noisy) - exact)[inner].mean())


def test_too_few_neighbours_give_no_normal():
    full = inverse_depth(plane_normal(20, 0))
    for keep in ((slice(40, 41), slice(60, 61)), (slice(40, 41), slice(30, 90)), (slice(20, 80), slice(60, 61))):
        lone = np.zeros_like(full)
        lone[keep] = full[keep]
        normals, depth = fit_normals(VIEW, estimate(lone, noise=0.3), OPTIONS)
        assert not normals.any() and not depth.any()


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (3, 1), (5, 7)])
def test_images_smaller_than_the_window_are_survived(size):
    view = View(1, "a", size[0], size[1], VIEW.K, VIEW.R, VIEW.t, VIEW.point_indices)
    normal = plane_normal(30, 60)
    normals, _ = fit_normals(view, estimate(inverse_depth(normal, view=view), noise=0.3), OPTIONS)
    assert normals.shape == (size[1], size[0], 3)
    found = normals.any(axis=-1)
    assert found.all() == (min(size) > 1)
    assert angles(normals, normal)[found].max(initial=0) < 0.1


def test_a_larger_window_takes_more_noise():
    normal = plane_normal(30, 0)
    noisy = estimate(inverse_depth(normal), noise=0.3, seed=4)
    errors = [
        np.median(angles(fit_normals(VIEW, noisy, NormalOptions(radius, 6.0))[0], normal)) for radius in (2, 4, 8)
    ]
    assert errors[0] > 2 * errors[1] > 3 * errors[2]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("radius", 0),
        ("radius", 17),
        *((name, value) for name in ("tolerance", "max_shift", "max_incidence") for value in (0.0, -1.0, np.nan)),
        ("max_incidence", 90.5),
    ],
)
def test_options_out_of_bounds_are_refused(name, value):
    NormalOptions().check()
    assert_refused(NormalOptions(**{name: value}), name)


def test_depths_off_their_plane_are_dropped():
    """A pixel that sticks out of a plane by several pixel sizes and standard deviations, and one within either."""
    plane = estimate(inverse_depth(plane_normal(20, 40)), noise=0.3)
    depth = plane.depth.copy()
    size = plane.depth / VIEW.K[0, 0]
    depth[30, 30] += 5 * plane.sigma[30, 30] + 3 * size[30, 30]
    depth[60, 60] += 0.5 * size[60, 60]
    two = np.full(depth.shape, 2, np.uint8)
    noisy = DepthEstimate(depth, plane.sigma, two)
    normals, fitted = fit_normals(VIEW, noisy, OPTIONS)
    assert fitted[30, 30] == 0 and not normals[30, 30].any()
    assert (fitted > 0).sum() == fitted.size - 1
    assert (fit_normals(VIEW, noisy, replace(OPTIONS, max_shift=100.0))[1] > 0).all()
    # Where depths are uncertain, the same step is noise.
    uncertain = DepthEstimate(depth, 5 * plane.sigma, two)
    assert (fit_normals(VIEW, uncertain, OPTIONS)[1] > 0).all()
    # What three or more support is a rough surface; it is put onto the plane.
    _, smooth = fit_normals(VIEW, replace(noisy, support=two + 1), OPTIONS)
    np.testing.assert_allclose(smooth[30, 30], plane.depth[30, 30], atol=size[30, 30])


def test_what_may_be_missing_to_a_plane_grows_with_its_slope():
    """On a plane at 72 degrees depth changes by about three pixel sizes from one pixel to the next."""
    exact = inverse_depth(plane_normal(72, 90))
    plane = DepthEstimate((1 / exact).astype(np.float32), np.zeros_like(exact), np.full(exact.shape, 2, np.uint8))
    size = plane.depth / VIEW.K[0, 0]
    change = np.abs(np.gradient(plane.depth, axis=0))
    depth = plane.depth.copy()
    for row in (30, 45, 60):
        assert 2.5 < change[row, 30] / size[row, 30] < 4
        depth[row, 30] += 0.6 * change[row, 30]
        depth[row, 60] += 1.6 * change[row, 60]
    # Both are off by more than two standard deviations.
    sigma = (0.25 * change).astype(np.float32)
    _, fitted = fit_normals(VIEW, DepthEstimate(depth, sigma, plane.support), OPTIONS)
    assert (fitted[30:61:15, 30] > 0).all()
    assert not fitted[30:61:15, 60].any()


def test_glancing_surfaces_need_support():
    """A plane under angles of 66 to 84 degrees: the part beyond 75 needs three others that see it."""
    normal = plane_normal(75, 0)
    exact = estimate(inverse_depth(normal), noise=0.3)
    column, row = np.meshgrid(np.arange(VIEW.width), np.arange(VIEW.height))
    rays = pixel_rays(VIEW, column, row).reshape(*column.shape, 3)
    incidence = np.degrees(np.arccos(-(rays @ normal) / np.linalg.norm(rays, axis=-1)))
    clear = (np.abs(incidence - 75) > 0.1) & (exact.depth > 0)
    assert 0.2 < (incidence < 75)[clear].mean() < 0.8
    options = replace(OPTIONS, max_incidence=75.0)
    for support, kept in ((2, (incidence < 75)[clear]), (3, np.ones(clear.sum(), bool))):
        supported = DepthEstimate(exact.depth, exact.sigma, np.full(exact.depth.shape, support, np.uint8))
        normals, depth = fit_normals(VIEW, supported, options)
        np.testing.assert_array_equal(depth[clear] > 0, kept)
        np.testing.assert_array_equal(np.any(normals != 0, axis=-1)[clear], kept)
