"""The kernels of rectified images, against slow readable ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_sph import _native

property_test = settings(max_examples=40, deadline=None, derandomize=True)
sizes = st.tuples(st.integers(0, 9), st.integers(0, 40))
seeds = st.integers(0, 2**32 - 1)


def of_every_backend(run):
    """What all versions of a kernel give, to the bit."""
    first, *others = (run(backend) for backend in _native.backends())
    for other in others:
        np.testing.assert_array_equal(np.asarray(other), np.asarray(first))
    return first


def source_pixels(rows, columns, weights, width, height):
    def run(backend):
        shape = (rows.shape[1], len(weights))
        found = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8)
        _native.source_pixels(backend, rows, columns, weights, width, height, *found)
        return found

    return of_every_backend(run)


@property_test
@given(shape=sizes, seed=seeds)
def test_source_pixels_are_those_of_their_rays(shape, seed):
    """Homogeneous pixels with depths from behind the camera to far before it, in 32-bit arithmetic."""
    rng = np.random.default_rng(seed)
    rows, columns = (rng.uniform(-20, 40, (3, size)).astype(np.float32) for size in shape)
    columns[2] = rng.choice([-30, 0, 1e-7, 1, 5], shape[1])
    rows[2] = rng.choice([0, 1, 2], shape[0])
    weights = rng.uniform(0, 1, shape[1]).astype(np.float32)
    found_columns, found_rows, inside = source_pixels(rows, columns, weights, 30, 20)
    x, y, z = (row[:, None] * weights + column for row, column in zip(rows, columns, strict=True))
    before = z > np.float32(1e-6)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (each * np.where(before, 1 / z, z) for each in (x, y))
    np.testing.assert_array_equal(found_columns, u - np.float32(0.5))
    np.testing.assert_array_equal(found_rows, v - np.float32(0.5))
    np.testing.assert_array_equal(inside, 255 * (before & (u >= 0) & (u <= 30) & (v >= 0) & (v <= 20)))


def test_a_pinhole_sees_itself():
    """Rays through the centres of its own pixels come back to whole numbers."""
    focal, middle = 50.0, (20.0, 15.0)
    directions = (np.arange(40) + 0.5 - middle[0]) / focal, (np.arange(30) + 0.5 - middle[1]) / focal
    rows = np.stack([np.full(30, middle[0]), focal * directions[1] + middle[1], np.ones(30)]).astype(np.float32)
    columns = np.stack([focal * directions[0], np.zeros(40), np.zeros(40)]).astype(np.float32)
    found_columns, found_rows, inside = source_pixels(rows, columns, np.ones(40, np.float32), 40, 30)
    np.testing.assert_allclose(found_columns, np.tile(np.arange(40), (30, 1)), atol=1e-4)
    np.testing.assert_allclose(found_rows, np.tile(np.arange(30)[:, None], (1, 40)), atol=1e-4)
    assert (inside == 255).all()


def resampled(tables, image, mask):
    """Grey values and validity of rectified pixels."""

    rows, columns, weights = tables

    def run(backend):
        shape = (rows.shape[1], len(weights))
        grey, valid = np.empty(shape, np.float32), np.empty(shape, np.uint8)
        _native.resample(backend, rows, columns, weights, image, mask, grey, valid)
        return grey, valid

    return of_every_backend(run)


def whole_pixels(columns, rows):
    """Tables of rays, of depth 1, that meet an image at these pixels' centres."""
    nothing = np.zeros(len(columns))
    ray_rows = np.stack([np.zeros(len(rows)), rows + 0.5, np.ones(len(rows))])
    ray_columns = np.stack([columns + 0.5, nothing, nothing])
    return [table.astype(np.float32) for table in (ray_rows, ray_columns, np.ones(len(columns)))]


@property_test
@given(shape=sizes, source=st.tuples(st.integers(2, 9), st.integers(2, 9)), masked=st.booleans(), seed=seeds)
def test_resampled_pixels_lie_between_four(shape, source, masked, seed):
    """At places in eighths of a pixel, whose weights 32 bits hold: inside, on the border, and far outside."""
    rng = np.random.default_rng(seed)
    rows, columns = (rng.integers(-60, 130, size) / 8 for size in shape)
    image = rng.integers(0, 256, source).astype(np.float32)
    mask = np.where(rng.random(source) < 0.2, 254, 255).astype(np.uint8)
    grey, valid = resampled(whole_pixels(columns, rows), image, mask if masked else mask[:0])
    for y, x in np.ndindex(shape):
        weights = np.zeros(source)
        v, u = (np.clip(place, 0, size - 1) for place, size in zip((rows[y], columns[x]), source, strict=True))
        for i, j in np.ndindex(source):
            weights[i, j] = max(1 - abs(v - i), 0) * max(1 - abs(u - j), 0)
        assert grey[y, x] == (weights * image).sum()
        inside = -0.5 <= rows[y] <= source[0] - 0.5 and -0.5 <= columns[x] <= source[1] - 0.5
        assert valid[y, x] == 255 * (inside and not (masked and (mask < 255)[weights > 0].any()))


def test_rays_that_are_no_numbers_read_nothing_outside():
    tables = whole_pixels(np.array([np.nan, np.inf, -np.inf, 3e38, 1]), np.array([np.nan, np.inf, -3e38, 1]))
    grey, valid = resampled(tables, np.full((3, 4), 7, np.float32), np.empty((0, 4), np.uint8))
    assert (grey == 7).all()
    assert [tuple(place) for place in np.argwhere(valid)] == [(3, 4)]


@property_test
@given(shape=sizes, seed=seeds)
def test_halves_are_means_of_four(shape, seed):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, shape).astype(np.float32)
    mask = rng.choice(np.array([0, 255], np.uint8), shape)
    odd = [(0, side % 2) for side in shape]
    grey, content = np.pad(image, odd, mode="edge"), np.pad(mask, odd)
    means, shares = (
        np.mean([values[y::2, x::2] for y in (0, 1) for x in (0, 1)], axis=0, dtype=float)
        for values in (grey, content)
    )
    half_image, half_mask = np.empty(means.shape, np.float32), np.empty(means.shape, np.uint8)
    _native.half_image(image, half_image)
    _native.half_mask(mask, half_mask)
    np.testing.assert_array_equal(half_image, means)
    np.testing.assert_array_equal(half_mask, np.where(shares >= 255 / 2, 255, 0))


def sharpened(image, sharpening):
    def run(backend):
        padded = np.full((image.shape[0] + 6, image.shape[1] + 8), 5, np.int16)
        _native.sharpen(backend, image, sharpening, padded)
        return padded

    return of_every_backend(run)


@property_test
@given(shape=st.tuples(st.integers(1, 9), st.integers(1, 40)), seed=seeds)
def test_sharpened_images_differ_from_their_mean_by_more(shape, seed):
    """Half as much more; of whole grey values there is nothing to be cut off."""
    image = np.random.default_rng(seed).integers(0, 256, shape)
    wide = np.pad(image, ((4, 4), (5, 5)), mode="edge")
    expected = np.empty((shape[0] + 6, shape[1] + 8), int)
    for y, x in np.ndindex(expected.shape):
        window = wide[y : y + 3, x : x + 3]
        mean_times_16 = np.sum(np.outer((1, 2, 1), (1, 2, 1)) * window)
        expected[y, x] = 64 * window[1, 1] + 2 * (16 * window[1, 1] - mean_times_16)
    np.testing.assert_array_equal(sharpened(image.astype(np.float32), 0.5), expected)


def test_an_even_slope_has_nothing_to_be_sharpened():
    image = (3 * np.arange(30) + 2 * np.arange(20)[:, None]).astype(np.float32)
    inside = sharpened(image, 0.6)[4:-4, 5:-5]
    np.testing.assert_allclose(inside, 64 * image[1:-1, 1:-1], atol=1.01)


@pytest.mark.parametrize(("value", "most"), [(np.inf, 32767), (-np.inf, -32768), (np.nan, -32768), (1e30, 32767)])
def test_what_is_no_grey_value_has_an_end(value, most):
    assert sharpened(np.full((1, 1), value, np.float32), 0.0)[3, 4] in (most, -32768)
