"""The kernels of ties against slow readable ones and closed formulas."""

import numpy as np
import pytest
from rendered import scene_of_pair

from colmap_sph import _native
from colmap_sph import synthetic as syn
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import image_coordinates, pixel_from_rectified_ray

# ---- surfaces ----------------------------------------------------------------------------------------------


def fitted(disparity, places, least_found=0.8):
    planes, roughness = np.empty((len(places), 3)), np.empty(len(places), np.float32)
    _native.fit_surfaces(disparity, places, least_found, planes, roughness)
    return planes, roughness


def test_planes_are_those_of_least_squares():
    rng = np.random.default_rng(0)
    disparity = (rng.normal(0, 1, (60, 80)) + 0.3 * np.arange(80) - 20).astype(np.float32)
    disparity[rng.random(disparity.shape) < 0.15] = np.nan
    places = rng.uniform((-3, -3), (83, 63), (300, 2))
    planes, roughness = fitted(disparity, places)
    steps = np.arange(-4, 5)
    column, row = (part.ravel() for part in np.meshgrid(steps, steps))
    numbers = {"inside": 0, "beside": 0, "sparse": 0}
    for place, plane, rough in zip(places, planes, roughness, strict=True):
        x, y = np.rint(place).astype(int)
        if not (4 <= x <= 75 and 4 <= y <= 55):
            assert np.isinf(rough)
            numbers["beside"] += 1
            continue
        window = disparity[y - 4 : y + 5, x - 4 : x + 5].ravel().astype(float)
        there = np.isfinite(window)
        if there.mean() < 0.8:
            assert np.isinf(rough)
            numbers["sparse"] += 1
            continue
        terms = np.stack([np.ones(81), column + x - place[0], row + y - place[1]], axis=1)
        expected = np.linalg.lstsq(terms[there], window[there], rcond=None)[0]
        np.testing.assert_allclose(plane, expected, rtol=1e-9, atol=1e-9)
        assert rough == pytest.approx(np.abs(window - terms @ expected)[there].max(), rel=1e-5)
        numbers["inside"] += 1
    assert min(numbers.values()) >= 10


def test_places_out_of_this_world_have_no_plane():
    odd = np.array([[np.nan, 9], [9, np.inf], [-np.inf, 9], [1e300, 9], [9, -1e300]])
    assert np.isinf(fitted(np.zeros((20, 20), np.float32), odd)[1]).all()


@pytest.mark.parametrize("shape", [(0, 0), (8, 30), (30, 8)])
def test_maps_smaller_than_a_window_have_no_plane(shape):
    assert np.isinf(fitted(np.zeros(shape, np.float32), np.full((1, 2), 4.0))[1]).all()


# ---- windows -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("surface", "columns_by"), [("spherical", "flat"), ("spherical", "angles"), ("frame", "flat")]
)
@pytest.mark.parametrize("coarse", [1.0, 0.02])
@pytest.mark.parametrize("backend", _native.backends())
def test_windows_are_placed_where_the_geometry_says(surface, columns_by, coarse, backend):
    """Coarse ones are wider than sines of small angles are good for."""
    scene, left, right = scene_of_pair(syn.convergent_pair())
    options = RectificationOptions(surface=surface, columns=columns_by)
    geometry = rectify_pair(scene, left, right, options).resampled(coarse)
    rng = np.random.default_rng(1)
    places = rng.uniform(0, (geometry.right_width, geometry.height), (40, 2))
    slopes = rng.uniform((0.5, -0.5), (1.5, 0.5), (40, 2))
    columns, rows = np.empty((40, 5, 7), np.float32), np.empty((40, 5, 7), np.float32)
    _native.place_windows(
        backend,
        places,
        slopes,
        pixel_from_rectified_ray(right, geometry),
        (geometry.right_origin, geometry.row_origin),
        (geometry.columns_per_radian, geometry.rows_per_radian),
        surface == "spherical",
        geometry.flatness,
        columns,
        rows,
    )
    j, i = np.mgrid[-2:3, -3:4]
    across = places[:, 0, None, None] + slopes[:, 0, None, None] * i + slopes[:, 1, None, None] * j
    down = places[:, 1, None, None] + 0 * across + j
    expected = image_coordinates(right, geometry, "right", np.stack([across.ravel(), down.ravel()], axis=1))
    found = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    # What lies in front of the camera: at its sides pixels are endlessly far away.
    near = (np.abs(expected) < 5000).all(axis=1) & (found != 0).all(axis=1)
    assert near.mean() > 0.2
    np.testing.assert_allclose(found[near], expected[near], rtol=1e-5, atol=0.01)


@pytest.mark.parametrize("backend", _native.backends())
@pytest.mark.parametrize("size", [(15, 15), (17, 17), (3, 40), (33, 1)])
@pytest.mark.parametrize("flatness", [None, 0.0, 0.7])
def test_all_versions_place_windows_alike(backend, size, flatness):
    """On a plane, on the sphere, with flat columns; narrow ones and wide ones, and where there is no place."""
    rng = np.random.default_rng(2)
    places, slopes = rng.uniform(-900, 900, (50, 2)), rng.uniform((0.5, -0.5), (1.5, 0.5), (50, 2))
    places[:5, 0], places[5:9, 1] = [np.nan, np.inf, -np.inf, 1e300, 1e9], [np.nan, np.inf, 1e300, -1e9]
    camera = np.array([[700, 3, 320], [-2, 690, 240], [0.01, -0.02, 1]])
    for scale in (50.0, 800.0):
        found = []
        for version in (backend, "scalar"):
            found.append(np.empty((2, 50, *size), np.float32))
            origins, scales = (20.5, -3.5), (scale, scale + 1)
            how = origins, scales, flatness is not None, flatness or 0.0
            _native.place_windows(version, places, slopes, camera, *how, *found[-1])
        np.testing.assert_array_equal(found[0], found[1])


def test_what_lies_behind_is_outside_of_the_image():
    columns, rows = np.empty((1, 3, 3), np.float32), np.empty((1, 3, 3), np.float32)
    behind = np.diag([1.0, 1.0, -1.0])
    _native.place_windows(
        "scalar", np.zeros((1, 2)), np.ones((1, 2)), behind, (0.0, 0.0), (9.0, 9.0), True, 0.9, columns, rows
    )
    assert (columns < -1).all() and (rows < -1).all()


# ---- least squares -----------------------------------------------------------------------------------------


def templates(windows, least_contrast=0.5):
    count, pixels = len(windows), (windows.shape[1] - 2) * (windows.shape[2] - 2)
    shapes = (count, pixels), (count, 4, pixels), (count, 4, 4)
    values, jacobian, normal = (np.empty(shape, np.float32) for shape in shapes)
    _native.make_templates(windows, least_contrast, values, jacobian, normal)
    return values, jacobian, normal


def stepped(template, windows, least_contrast=0.5):
    values, jacobian, normal = template
    move, correlation, variance = (np.empty((len(windows), *rest), np.float32) for rest in ((4,), (), ()))
    inverse = np.linalg.inv(normal + 1e-3 * np.eye(4, dtype=np.float32))
    flat = windows.reshape(len(windows), -1)
    _native.step_windows(values, jacobian, inverse, flat, least_contrast, move, correlation, variance)
    return move, correlation, variance


def scenery(columns, rows):
    """Smooth grey values at any place."""
    return 100 + 40 * np.sin(0.35 * columns + 0.2 * rows) + 30 * np.cos(0.3 * rows - 0.1 * columns)


def test_templates_are_normalised_and_differentiated():
    windows = np.random.default_rng(2).uniform(0, 255, (5, 11, 9)).astype(np.float32)
    values, jacobian, normal = templates(windows)
    inner = windows[:, 1:-1, 1:-1].reshape(5, -1).astype(float)
    scale = inner.std(axis=1, keepdims=True) + 0.5
    np.testing.assert_allclose(values, (inner - inner.mean(axis=1, keepdims=True)) / scale, atol=1e-5)
    down, along = np.gradient(windows.astype(float), axis=(1, 2))
    j, i = np.mgrid[-4:5, -3:4]
    terms = np.stack([along, down, along, down], axis=1)[:, :, 1:-1, 1:-1]
    terms[:, 2] = terms[:, 0] * i
    terms[:, 3] = terms[:, 0] * j
    expected = terms.reshape(5, 4, -1) / scale[:, None]
    expected -= expected.mean(axis=2, keepdims=True)
    np.testing.assert_allclose(jacobian, expected, atol=1e-4)
    np.testing.assert_allclose(normal, expected @ expected.swapaxes(1, 2), rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("move", [(0.1, 0, 0, 0), (0, -0.1, 0, 0), (0, 0, 0.03, 0), (0, 0, 0, -0.03)])
def test_a_step_finds_a_small_move(move):
    """The right window shows the left one moved, brighter and with more contrast."""
    j, i = np.mgrid[-8:9, -8:9].astype(float)
    places = np.random.default_rng(3).uniform(0, 50, (20, 2, 1, 1))
    left = scenery(places[:, 0] + i, places[:, 1] + j).astype(np.float32)
    j, i = j[1:-1, 1:-1], i[1:-1, 1:-1]
    along = move[0] + move[2] * i + move[3] * j
    right = 1.7 * scenery(places[:, 0] + i + along, places[:, 1] + j + move[1]) - 30
    found, correlation, variance = stepped(templates(left), right.astype(np.float32))
    assert (np.abs(found - move) < (0.03, 0.03, 0.01, 0.01)).all()
    values = templates(left)[0]
    flat = right.reshape(len(right), -1)
    flat = (flat - flat.mean(axis=1, keepdims=True)) / (flat.std(axis=1, keepdims=True) + 0.5)
    np.testing.assert_allclose(correlation, (flat * values).mean(axis=1), atol=1e-4)
    np.testing.assert_allclose(variance, ((flat - values) ** 2).mean(axis=1), atol=1e-4)
    assert (correlation > 0.97).all()


def test_windows_without_texture_move_nowhere():
    move, correlation, _ = stepped(
        templates(np.full((2, 9, 9), 77, np.float32)), np.full((2, 7, 7), 5, np.float32)
    )
    assert not move.any() and not correlation.any()
