"""The passes over offsets between the kernels of matching, against slow readable ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from colmap_sph import _native
from colmap_sph.stereo.search.offsets import INVALID, remove_small_segments

property_test = settings(max_examples=40, deadline=None, derandomize=True)
sizes = st.tuples(st.integers(1, 12), st.integers(1, 40))
seeds = st.integers(0, 2**32 - 1)

OFFSETS = {
    "noise": lambda rng, shape: rng.integers(-600, 600, shape),
    "slopes": lambda rng, shape: rng.integers(-150, 180, shape).cumsum(axis=1),
    "islands": lambda rng, shape: rng.choice([0, 10_000, INVALID], shape, p=[0.6, 0.1, 0.3]),
    "extreme": lambda rng, shape: rng.choice([INVALID, INVALID + 1, 0, 2**31 - 1], shape),
}
kinds = st.sampled_from(list(OFFSETS))


def offsets_of(kind, shape, seed):
    rng = np.random.default_rng(seed)
    offset = OFFSETS[kind](rng, shape).astype(np.int32)
    offset[rng.random(shape) < 0.1] = INVALID
    return offset


def torn_of(shape, seed):
    return (np.random.default_rng(seed).random(shape) < 0.3).astype(np.uint8)


def segments(offset):
    """(H, W) labels of connected regions, from a graph of all neighbours that are joined."""
    numbers = np.arange(offset.size).reshape(offset.shape)
    quarters = np.floor(offset / 64)
    edges = []
    for one, other in (
        ((slice(None), slice(1, None)), (slice(None), slice(-1))),
        ((slice(1, None), slice(None)), (slice(-1), slice(None))),
    ):
        joined = (offset[one] != INVALID) & (offset[other] != INVALID)
        joined &= np.abs(quarters[one] - quarters[other]) <= 4
        edges.append([numbers[one][joined], numbers[other][joined]])
    first, second = np.concatenate(edges, axis=1)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(offset.size, offset.size))
    return connected_components(graph, directed=False)[1].reshape(offset.shape)


@property_test
@given(shape=sizes, kind=kinds, least=st.integers(2, 40), seed=seeds)
def test_small_segments_are_those_of_the_graph(shape, kind, least, seed):
    offset = offsets_of(kind, shape, seed)
    labels = segments(offset)
    expected = np.where(np.bincount(labels.ravel())[labels] < least, INVALID, offset)
    remove_small_segments(offset, least)
    np.testing.assert_array_equal(offset, expected)


def test_a_spiral_is_one_segment():
    """Its arms meet from both sides, and only at its middle: joined by the last row that is read."""
    spiral = np.full((41, 41), INVALID, np.int32)
    for ring in range(0, 20, 2):
        spiral[ring, max(ring - 2, 0) : 41 - ring] = 7
        spiral[ring : 41 - ring, 40 - ring] = 7
        spiral[40 - ring, ring : 41 - ring] = 7
        spiral[ring + 2 : 41 - ring, ring] = 7
    count = int(np.count_nonzero(spiral == 7))
    kept = spiral.copy()
    remove_small_segments(kept, count)
    np.testing.assert_array_equal(kept, spiral)
    remove_small_segments(kept, count + 1)
    assert (kept == INVALID).all()


@property_test
@given(shape=sizes, kind=kinds, first=st.integers(-(2**40), 2**40), reach=st.integers(-5, 2**41), seed=seeds)
def test_what_lies_between_is_kept(shape, kind, first, reach, seed):
    for least in (first, first >> 25):
        offset = offsets_of(kind, shape, seed)
        wide = offset.astype(np.int64)
        expected = np.where((wide >= least) & (wide <= least + reach), offset, INVALID)
        _native.keep_between(offset, least, least + reach)
        np.testing.assert_array_equal(offset, expected)


@property_test
@given(shape=sizes, kind=kinds, seed=seeds)
def test_fractions_are_counted(shape, kind, seed):
    offset = offsets_of(kind, shape, seed)
    counts = np.full(256, 5, np.uint32)
    _native.count_fractions(offset, counts)
    np.testing.assert_array_equal(counts, np.bincount(offset[offset != INVALID] % 256, minlength=256))


@property_test
@given(shape=sizes, seed=seeds, as_it_is=st.integers(0, 5000))
def test_torn_pixels_leave_the_copy_of_the_source(shape, seed, as_it_is):
    offset, torn = offsets_of("slopes", shape, seed), torn_of(shape, seed)
    unwarped = np.full(shape, 9, np.int32)
    _native.unwarp_torn(offset, torn, as_it_is, unwarped)
    there = np.where(offset == INVALID, INVALID, offset - 256 * as_it_is)
    np.testing.assert_array_equal(unwarped, np.where(torn, there, 9))


@property_test
@given(shape=sizes, seed=seeds, margin=st.integers(0, 99), gap=st.integers(0, 99))
def test_bases_are_those_of_each_pixel(shape, seed, margin, gap):
    predicted, torn = offsets_of("slopes", shape, seed), torn_of(shape, seed)
    predicted[predicted == INVALID] = 0
    base = np.random.default_rng(seed).integers(-200, 200, shape).astype(np.int32)
    first, target_base = np.empty(shape, np.int32), np.empty(shape, np.int32)
    _native.first_offsets(predicted, base, torn, first)
    _native.target_bases(base, torn, margin, 70, gap, target_base)
    for y, x in np.ndindex(shape):
        if torn[y, x]:
            assert first[y, x] == base[y, x]
            assert target_base[y, x] + x == max(base[y, x] + x, -gap) + 70
        else:
            assert first[y, x] == base[y, x] + np.floor(predicted[y, x] / 256 + 0.5)
            assert target_base[y, x] == base[y, x] + margin


@property_test
@given(shape=sizes, source=st.integers(0, 40), gap=st.integers(0, 9), seed=seeds)
def test_targets_lie_side_by_side(shape, source, gap, seed):
    rng = np.random.default_rng(seed)
    warped, own = (rng.integers(0, 2**63, (shape[0], width), dtype=np.uint64) for width in (shape[1], source))
    columns = rng.integers(-1, 50, shape).astype(np.int32)
    census = np.empty((shape[0], shape[1] + gap + source), np.uint64)
    joined = np.empty(census.shape, np.int32)
    census[:, : shape[1]] = warped
    census[:, shape[1] + gap :] = own
    joined[:, : shape[1]] = columns
    _native.join_targets(shape[1], source, census, joined)
    nothing = np.full((shape[0], gap), 1 << 63, np.uint64)
    np.testing.assert_array_equal(census, np.hstack([warped, nothing, own]))
    own_columns = np.tile(np.arange(source), (shape[0], 1))
    np.testing.assert_array_equal(joined, np.hstack([columns, np.full((shape[0], gap), -1), own_columns]))


@property_test
@given(shape=sizes, seed=seeds, depth=st.sampled_from([32, 64, 1024]))
def test_windows_lie_about_offsets(shape, seed, depth):
    offset = offsets_of("slopes", shape, seed)
    offset[offset == INVALID] = 0
    expected = np.clip(np.floor(offset / 256 + 0.5) - depth / 2, -40, 7)
    _native.bases_about(offset, depth, -40, 7)
    np.testing.assert_array_equal(offset, expected)


@property_test
@given(shape=sizes, seed=seeds, max_step=st.sampled_from([0, 100, 700]))
def test_steps_are_marked_on_both_sides(shape, seed, max_step):
    offset = offsets_of("noise", shape, seed)
    offset[offset == INVALID] = 0
    expected = np.zeros(shape, np.uint8)
    for y, x in np.ndindex(shape):
        for there in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            if 0 <= there[0] < shape[0] and 0 <= there[1] < shape[1]:
                expected[y, x] |= abs(int(offset[there]) - offset[y, x]) > max_step
    marks = np.full(shape, 5, np.uint8)
    _native.mark_steps(offset, max_step, marks)
    np.testing.assert_array_equal(marks, expected)


@property_test
@given(shape=sizes, seed=seeds)
def test_slopes_are_counted(shape, seed):
    offset = offsets_of("slopes", shape, seed)
    offset[offset == INVALID] = 0
    places = offset[::2, ::2]
    slopes = np.maximum(np.abs(np.diff(places, axis=1)[:-1]), np.abs(np.diff(places, axis=0)[:, :-1]))
    expected = (slopes <= 300).sum(), ((slopes <= 300) & (slopes > 100)).sum()
    assert _native.count_slopes(offset, 300, 100) == expected


# ---- codes -------------------------------------------------------------------------------------------------


@property_test
@given(shape=sizes, seed=seeds, step=st.sampled_from([1 / 64, 0.37, 3.0]))
def test_codes_tell_disparities_to_half_a_step(shape, seed, step):
    rng = np.random.default_rng(seed)
    disparity = rng.uniform(-200, 800, shape).astype(np.float32)
    disparity[rng.random(shape) < 0.2] = rng.choice([np.nan, np.inf, -np.inf])
    found = np.isfinite(disparity)
    ends = np.empty(2, np.float32)
    _native.disparity_range(disparity, ends)
    assert ends.tolist() == ([disparity[found].min(), disparity[found].max()] if found.any() else [0, 0])
    codes = np.empty(shape, np.uint16)
    _native.code_disparity(disparity, ends[0], step, codes)
    np.testing.assert_array_equal(codes > 0, found)
    back = np.empty(shape, np.float32)
    _native.decode_disparity(codes, ends[0], step, back)
    np.testing.assert_array_equal(np.isnan(back), ~found)
    assert (np.abs(back - disparity)[found] <= step / 2 + 1e-3).all()


@pytest.mark.parametrize(("steps", "code"), [(0, 1), (0.5, 1), (1.5, 3), (2.49, 3), (65534, 65535), (1e9, 65535)])
def test_codes_are_whole_steps(steps, code):
    codes = np.empty((1, 1), np.uint16)
    _native.code_disparity(np.full((1, 1), 4 + 0.25 * steps, np.float32), 4.0, 0.25, codes)
    assert codes[0, 0] == code
