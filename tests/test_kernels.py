"""The matching kernels against the slow oracle, to the bit, and their boundary against wrong arguments."""

import functools
import itertools

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_sph import _native

INT32 = np.iinfo(np.int32)
BACKENDS = _native.backends()
DEPTHS = [32, 64, 96, 128, 160, 192]
SIZES = [(1, 1), (1, 31), (3, 33), (5, 7), (2, 65), (7, 32), (4, 50)]
PENALTIES = {
    "default": (10, 30, 120),
    "none": (0, 0, 0),
    "free steps": (0, 127, 127),
    "largest": (63, 127, 127),
}

property_test = settings(max_examples=40, deadline=None, derandomize=True)
every_backend = pytest.mark.parametrize("backend", BACKENDS)


# ---- input -------------------------------------------------------------------------------------------------


def words(rng, shape, invalid):
    """Random census words, a share of them without content."""
    census = rng.integers(0, 1 << 62, shape, dtype=np.uint64)
    census[rng.random(shape) < invalid] = oracle.CENSUS_INVALID
    return census


BASES = {
    "zero": lambda rng, shape: np.zeros(shape),
    "left": lambda rng, shape: np.full(shape, -40),
    "smooth": lambda rng, shape: rng.integers(-2, 3, shape).cumsum(axis=1) - 16,
    "rough": lambda rng, shape: rng.integers(-70, 40, shape),
    "jumps": lambda rng, shape: rng.choice([-1000, -33, 0, 31, 1000], shape),
    "outside": lambda rng, shape: rng.choice([-(10**6), 10**6], shape),
    "extreme": lambda rng, shape: rng.choice([INT32.min, INT32.min + 1, -16, 0, INT32.max - 1, INT32.max], shape),
}


def bases(rng, shape, kind):
    return BASES[kind](rng, shape).astype(np.int32)


# Values of images in 1/64 grey value.
GREYS = {
    "flat": [77 * 64],
    "contrast": [-9792, 26112],
    "dull": np.arange(640, 740),
    "full": np.arange(256) * 64,
    "extreme": [-32768, -32767, -32736, -32735, -1, 0, 32735, 32767],
}


def images(rng, shape, kind):
    if kind == "flat":
        return np.full(shape, 77, dtype=np.uint8)
    values = [0, 255] if kind == "contrast" else [10, 11, 12] if kind == "dull" else np.arange(256)
    return rng.choice(np.array(values, dtype=np.uint8), shape)


def p2_table(rng, p1, least, most):
    table = rng.integers(least, most + 1, 256).astype(np.uint8)
    table[0] = most
    assert p1 <= table.min()
    return table


def run_census(backend, padded, valid, *, fine=False, grey_step=0):
    census = np.full(valid.shape, 7, dtype=np.uint64)
    _native.census(backend, padded, valid, fine, grey_step, 0, census)
    return census


def run_cost(backend, reference, target, base, depth):
    cost = np.full((*base.shape, depth), 99, dtype=np.uint8)
    _native.matching_cost(backend, reference, target, base, cost)
    return cost


def run_aggregation(backend, cost, base, image, p1, p2, max_slant=0):
    aggregated = np.full_like(cost, 77)
    _native.aggregation(backend, cost, base, image, p1, p2, max_slant, np.full_like(cost, 99), aggregated)
    return aggregated


Shown = tuple[np.ndarray, int]  # columns of the source that a target shows, and the source's width


def run_selection(
    backend, aggregated, base, reference, target, max_difference, max_excess=0, shown: Shown | None = None
):
    """Without `shown` the target is its own source."""
    offset = np.full(base.shape, 5, dtype=np.int32)
    columns, width = unwarped(target.shape) if shown is None else shown
    images = reference, target, columns
    _native.selection(backend, aggregated, base, *images, width, max_difference, max_excess, offset)
    return offset


def unwarped(shape) -> Shown:
    """Columns of a target that is its own source, and its width."""
    return np.tile(np.arange(shape[1], dtype=np.int32), (shape[0], 1)), shape[1]


# Columns of the source that target pixels show, of a shape (height, width).
COLUMNS = {
    "same": lambda rng, shape: np.arange(shape[1]) + 0 * rng.integers(0, 1, shape),
    "squeezed": lambda rng, shape: rng.integers(0, 2, shape).cumsum(axis=1),
    "stretched": lambda rng, shape: rng.integers(0, 4, shape).cumsum(axis=1),
    "skipping": lambda rng, shape: rng.choice([1, 2, 3, 4, 5, 6, 9], shape).cumsum(axis=1) - 20,
    "torn": lambda rng, shape: np.arange(shape[1]) + 25 * (rng.random(shape) < 0.15).cumsum(axis=1) % 100 - 30,
    "random": lambda rng, shape: rng.integers(-3, 20, shape),
    "extreme": lambda rng, shape: rng.choice(
        [INT32.min, INT32.min + 1, -1, 0, 3, INT32.max - 3, INT32.max], shape
    ),
}


def source_columns(rng, shape, kind, source_width):
    """Columns as of a warp: -1 outside, but for those that no warp gives."""
    columns = COLUMNS[kind](rng, shape).astype(np.int32)
    if kind not in ("random", "extreme"):
        columns[(columns < 0) | (columns >= source_width)] = -1
    return columns


sizes = st.tuples(st.integers(1, 4), st.integers(1, 70))
seeds = st.integers(0, 2**32 - 1)
shares = st.sampled_from([0.0, 0.3, 1.0])


def test_scalar_kernels_are_always_there():
    assert BACKENDS[-1] == "scalar"
    assert set(BACKENDS) <= {"avx512", "avx512bw", "avx2", "neon", "scalar"}


# ---- census ------------------------------------------------------------------------------------------------


@every_backend
@property_test
@given(size=sizes, kind=st.sampled_from(list(GREYS)), invalid=shares, seed=seeds)
def test_census_is_the_oracles(backend, size, kind, invalid, seed):
    rng = np.random.default_rng(seed)
    padded = rng.choice(np.array(GREYS[kind], np.int16), (size[0] + 6, size[1] + 8))
    valid = np.where(rng.random(size) < invalid, 0, rng.integers(1, 256, size)).astype(np.uint8)
    np.testing.assert_array_equal(run_census(backend, padded, valid), oracle.census(padded, valid))


@every_backend
@pytest.mark.parametrize(("centre", "darker"), [(0, 0), (32, 0), (33, 1), (-1000, 0), (32767, 1), (-32768, 0)])
def test_census_leaves_out_half_a_grey_value(backend, centre, darker):
    padded = np.full((7, 8 + 40), centre, dtype=np.int16)
    padded[0, :] = 0
    census = run_census(backend, padded, np.ones((1, 40), dtype=np.uint8))
    np.testing.assert_array_equal(census, darker * 0b111111111)


@every_backend
@property_test
@given(size=sizes, before=st.integers(0, 9), after=st.integers(0, 9), seed=seeds)
def test_census_goes_into_some_columns_of_wider_rows(backend, size, before, after, seed):
    rng = np.random.default_rng(seed)
    padded = rng.integers(0, 9, (size[0] + 6, size[1] + 8)).astype(np.int16)
    valid = rng.integers(0, 2, size).astype(np.uint8)
    rows = np.full((size[0], before + size[1] + after), 7, dtype=np.uint64)
    expected = rows.copy()
    expected[:, before : before + size[1]] = oracle.census(padded, valid)
    _native.census(backend, padded, valid, False, 0, before, rows)
    np.testing.assert_array_equal(rows, expected)


@every_backend
@property_test
@given(
    size=sizes, fine=st.booleans(), step=st.sampled_from([0, 1, 64, 150, 5000, 70000]), invalid=shares, seed=seeds
)
def test_weighed_census_counts_near_neighbours_and_grey_steps(backend, size, fine, step, invalid, seed):
    """What differs: of fine images the neighbours within 5 x 5 twice; with grey values those within 7 x 7, and
    steps between grey values, of which the 28th is the first again; content always."""
    rng = np.random.default_rng(seed)
    reach = rng.choice([100, 4000, 32768])
    shape = (size[0] + 6, size[1] + 8)
    images = [rng.integers(-reach, reach, shape).astype(np.int16) for _ in range(2)]
    contents = [(rng.random(size) >= invalid).astype(np.uint8) for _ in range(2)]
    first, second = (oracle.census(*each) for each in zip(images, contents, strict=True))
    weighed = [
        run_census(backend, *each, fine=fine, grey_step=step) for each in zip(images, contents, strict=True)
    ]
    neighbours = [(y, x) for y in range(-3, 4) for x in range(-4, 5) if (y, x) != (0, 0)]
    if fine:
        times = [2 * (max(abs(y), abs(x)) <= 2) for y, x in neighbours]
    else:
        times = [int(abs(x) <= 3 or step == 0) for y, x in neighbours]
    assert sum(times) == (62 if step == 0 and not fine else 48)
    differing = first ^ second
    expected = (differing >> np.uint64(63)).astype(int)
    for bit, number in enumerate(times):
        expected += number * ((differing >> np.uint64(bit)) & np.uint64(1)).astype(int)
    if step > 0:
        # Values are known to a quarter of a grey value.
        levels = [((image[3:-3, 4:-4].astype(int) + 32768) // 16 * 16 + 8) // step for image in images]
        apart = (levels[0] - levels[1]) % 28
        expected += np.where((contents[0] & contents[1]) > 0, np.minimum(apart, 28 - apart), 0)
    found = np.bitwise_count(weighed[0] ^ weighed[1])
    both = (contents[0] & contents[1]) > 0
    np.testing.assert_array_equal(found[both], expected[both])
    for words, content in zip(weighed, contents, strict=True):
        np.testing.assert_array_equal(words >> np.uint64(63), 1 - content)


# ---- matching cost -----------------------------------------------------------------------------------------


@every_backend
@property_test
@given(
    size=sizes,
    target_width=st.integers(1, 80),
    depth=st.sampled_from(DEPTHS),
    kind=st.sampled_from(list(BASES)),
    invalid=shares,
    seed=seeds,
)
def test_cost_is_the_oracles(backend, size, target_width, depth, kind, invalid, seed):
    rng = np.random.default_rng(seed)
    reference, target = words(rng, size, invalid), words(rng, (size[0], target_width), invalid)
    base = bases(rng, size, kind)
    np.testing.assert_array_equal(
        run_cost(backend, reference, target, base, depth),
        oracle.matching_cost(reference, target, base, depth),
    )


@every_backend
def test_cost_counts_every_bit(backend):
    reference = np.zeros((1, 1), dtype=np.uint64)
    target = np.array([[(1 << k) - 1 for k in range(63)] + [1 << k for k in range(62)]], dtype=np.uint64)
    cost = run_cost(backend, reference, target, np.zeros((1, 1), dtype=np.int32), 128)
    np.testing.assert_array_equal(cost[0, 0], [*range(63), *[1] * 62, *[oracle.COST_UNSEEN] * 3])


@every_backend
def test_cost_of_a_shifted_image_vanishes_at_the_shift(backend):
    rng = np.random.default_rng(0)
    reference = words(rng, (6, 90), 0)
    target = np.roll(reference, 9, axis=1)
    cost = run_cost(backend, reference, target, np.full((6, 90), -3, dtype=np.int32), 32)
    assert not cost[:, :81, 12].any()
    assert (np.delete(cost, 12, axis=2) > 0).all()


# ---- aggregation -------------------------------------------------------------------------------------------


def check_aggregation(backend, rng, cost, base, image, penalties, max_slant=0):
    p1, least, most = penalties
    p2 = p2_table(rng, p1, least, most)
    expected = oracle.aggregation(cost, base, image, p1, p2, max_slant)
    aggregated = run_aggregation(backend, cost, base, image, p1, p2, max_slant)
    np.testing.assert_array_equal(aggregated, expected)


@every_backend
@property_test
@given(
    size=sizes,
    depth=st.sampled_from(DEPTHS),
    kind=st.sampled_from(list(BASES)),
    costs=st.sampled_from([(0, 62), (0, 1), (62, 62), (20, 40)]),
    image=st.sampled_from(["flat", "contrast", "dull", "full"]),
    penalties=st.sampled_from(list(PENALTIES)),
    max_slant=st.sampled_from([0, 1, 3, 2**31 - 1]),
    seed=seeds,
)
def test_aggregation_is_the_oracles(backend, size, depth, kind, costs, image, penalties, max_slant, seed):
    rng = np.random.default_rng(seed)
    cost = rng.integers(costs[0], costs[1] + 1, (*size, depth)).astype(np.uint8)
    check_aggregation(
        backend, rng, cost, bases(rng, size, kind), images(rng, size, image), PENALTIES[penalties], max_slant
    )


@every_backend
@pytest.mark.parametrize("penalties", PENALTIES.values(), ids=PENALTIES)
@pytest.mark.parametrize("shift", [0, 1, 30, 31, 32, 33, 34, 1024, 1025, 1026])
def test_aggregation_at_shifts_about_the_range(backend, shift, penalties):
    """Neighbours' ranges that overlap by many, one, or no disparity, in both directions."""
    rng = np.random.default_rng(shift)
    cost = rng.integers(0, 63, (3, 6, 32)).astype(np.uint8)
    base = (shift * rng.integers(-1, 2, (3, 6))).astype(np.int32)
    check_aggregation(backend, rng, cost, base, images(rng, (3, 6), "contrast"), penalties)


@every_backend
def test_aggregation_saturates_where_ranges_keep_jumping(backend):
    """Without common disparities each path adds P2: four times that must not wrap around."""
    rng = np.random.default_rng(0)
    base = (1000 * rng.integers(0, 4, (6, 40))).astype(np.int32)
    cost = np.full((6, 40, 32), 62, dtype=np.uint8)
    check_aggregation(backend, rng, cost, base, images(rng, (6, 40), "flat"), (10, 127, 127))


@every_backend
def test_aggregation_of_one_pixel_is_four_times_its_cost(backend):
    cost = np.arange(32, dtype=np.uint8).reshape(1, 1, 32)
    zero = np.zeros((1, 1), dtype=np.int32)
    aggregated = run_aggregation(backend, cost, zero, zero.astype(np.uint8), 3, np.full(256, 9, dtype=np.uint8))
    np.testing.assert_array_equal(aggregated, 4 * cost)


# ---- selection ---------------------------------------------------------------------------------------------


@every_backend
@property_test
@given(
    size=sizes,
    target_width=st.integers(1, 80),
    depth=st.sampled_from(DEPTHS),
    kind=st.sampled_from(list(BASES)),
    sums=st.sampled_from([(0, 255), (0, 3), (250, 255), (255, 255)]),
    invalid=st.sampled_from([0.0, 0.2]),
    limits=st.tuples(st.sampled_from([0, 2, INT32.max]), st.sampled_from([0, 1, 40, INT32.max])),
    seed=seeds,
)
def test_selection_is_the_oracles(backend, size, target_width, depth, kind, sums, invalid, limits, seed):
    rng = np.random.default_rng(seed)
    aggregated = rng.integers(sums[0], sums[1] + 1, (*size, depth)).astype(np.uint8)
    reference, target = words(rng, size, invalid), words(rng, (size[0], target_width), invalid)
    base = bases(rng, size, kind)
    np.testing.assert_array_equal(
        run_selection(backend, aggregated, base, reference, target, *limits),
        oracle.selection(aggregated, base, reference, target, *unwarped(target.shape), *limits),
    )


@every_backend
@settings(property_test, max_examples=100)
@given(
    size=st.tuples(st.integers(1, 3), st.integers(15, 60)),
    target_width=st.integers(20, 80),
    source_width=st.integers(0, 100),
    depth=st.sampled_from(DEPTHS[:2]),
    kind=st.sampled_from(["left", "smooth", "rough"]),
    columns=st.sampled_from(list(COLUMNS)),
    sums=st.sampled_from([(0, 255), (0, 40), (240, 255)]),
    invalid=st.sampled_from([0.0, 0.1]),
    limits=st.tuples(st.sampled_from([0, 2, 5]), st.sampled_from([0, 1, 20])),
    seed=seeds,
)
def test_selection_from_a_warped_target_is_the_oracles(
    backend, size, target_width, source_width, depth, kind, columns, sums, invalid, limits, seed
):
    rng = np.random.default_rng(seed)
    aggregated = rng.integers(sums[0], sums[1] + 1, (*size, depth)).astype(np.uint8)
    reference, target = words(rng, size, invalid), words(rng, (size[0], target_width), invalid)
    base = bases(rng, size, kind)
    shown = source_columns(rng, target.shape, columns, source_width), source_width
    np.testing.assert_array_equal(
        run_selection(backend, aggregated, base, reference, target, limits[0], limits[1], shown),
        oracle.selection(aggregated, base, reference, target, *shown, *limits),
    )


@every_backend
def test_selection_finds_a_planted_match(backend):
    """A cost valley at target column x - 7 + 0.25: found, within the fit's rounding, wherever it is seen."""
    width, depth = 60, 32
    slot = np.arange(depth)
    valley = np.minimum(20 + 64 * np.abs(slot - 12.25), 255).astype(np.uint8)
    aggregated = np.broadcast_to(valley, (2, width, depth)).copy()
    base = np.full((2, width), -19, dtype=np.int32)
    content = np.zeros((2, width), dtype=np.uint64)
    offset = run_selection(backend, aggregated, base, content, content, 2)
    np.testing.assert_array_equal(offset[:, :7], oracle.OFFSET_INVALID)
    np.testing.assert_array_equal(offset[:, 7:], -7 * 256 + 64)


@every_backend
def test_selection_keeps_a_loser_of_little_excess(backend):
    """Pixels 20 and 30 point at the same target pixel, the latter with a sum larger by 6."""
    aggregated = np.full((1, 40, 32), 90, dtype=np.uint8)
    aggregated[..., 16] = 50
    base = np.full((1, 40), -16, dtype=np.int32)
    aggregated[0, 20, 26], aggregated[0, 30, 16] = 10, 16
    content = np.zeros((1, 40), dtype=np.uint64)
    for excess, kept in ((0, False), (5, False), (6, True)):
        offset = run_selection(backend, aggregated, base, content, content, 2, excess)
        assert offset[0, 20] == 10 * 256
        assert (offset[0, 30] == 0) == kept


@every_backend
@pytest.mark.parametrize("skipped", [0, 1, 2, 3, 4, 5])
def test_selection_compares_what_shows_the_same_column(backend, skipped):
    """Target pixels 20 and 30, whose least sums are 10 and 16, show source columns 60 and 60 + `skipped`.

    Pixel 20 stands for those that its neighbour skips, too, as long as there are no more than three.
    """
    aggregated = np.full((1, 40, 32), 90, dtype=np.uint8)
    aggregated[..., 16] = 50
    aggregated[0, 20, 16], aggregated[0, 30, 16] = 10, 16
    base = np.full((1, 40), -16, dtype=np.int32)
    content = np.zeros((1, 40), dtype=np.uint64)
    columns = np.full((1, 40), -1, dtype=np.int32)
    for step in (1, 2, 3, 4, 5, 6):
        columns[0, 20:22] = 60, 60 + step
        columns[0, 30] = 60 + skipped
        # The sum of pixel 21, 50, is no rival; what is outside of the source has none.
        rivals = skipped == 0 or (skipped < step <= 4)
        for source_width, outside in ((60 + skipped, True), (61 + skipped, False)):
            offset = run_selection(
                backend, aggregated, base, content, content, 2, 5, shown=(columns, source_width)
            )
            assert offset[0, 20] == 0
            assert (offset[0, 30] == 0) == (outside or not rivals)
    assert run_selection(backend, aggregated, base, content, content, 10, 5, shown=(columns, 80))[0, 30] == 0


@every_backend
@pytest.mark.parametrize("width", [65535])
def test_selection_reaches_the_widest_row(backend, width):
    """The last of 65535 columns must still be told from the first."""
    aggregated = np.full((1, width, 32), 50, dtype=np.uint8)
    aggregated[..., 16] = 7
    base = np.full((1, width), -16, dtype=np.int32)
    content = np.zeros((1, width), dtype=np.uint64)
    offset = run_selection(backend, aggregated, base, content, content, 0)
    np.testing.assert_array_equal(offset, 0)


# ---- sub-pixel fit ----------------------------------------------------------------------------------


def run_fit(backend, offset, reference, target):
    fitted = np.full(offset.shape, 5, dtype=np.int32)
    _native.fit_offsets(backend, offset, reference, target, fitted)
    return fitted


OFFSETS = {
    "flat": lambda rng, shape: rng.integers(-200, 200, shape),
    "sloped": lambda rng, shape: 300 * np.arange(shape[1]) + 90 * np.arange(shape[0])[:, None] - 2000,
    "steps": lambda rng, shape: rng.choice([-2560, -2400, 0, 512, 513], shape),
    "extreme": lambda rng, shape: rng.choice(
        [INT32.min + 1, -(1 << 24), 1 << 24, (1 << 24) + 1, INT32.max], shape
    ),
}


@every_backend
@property_test
@given(
    size=st.tuples(st.integers(1, 7), st.integers(1, 40)),
    target_width=st.integers(1, 60),
    kind=st.sampled_from(list(OFFSETS)),
    missing=st.sampled_from([0.0, 0.2, 0.9]),
    likeness=st.sampled_from([0.0, 0.5, 0.9]),
    seed=seeds,
)
def test_the_fit_is_the_oracles(backend, size, target_width, kind, missing, likeness, seed):
    rng = np.random.default_rng(seed)
    reference, target = words(rng, size, 0), words(rng, (size[0], target_width), 0.05)
    common = min(size[1], target_width)
    alike = rng.random((size[0], common)) < likeness
    target[:, :common][alike] = reference[:, :common][alike]
    offset = OFFSETS[kind](rng, size).astype(np.int32)
    offset[rng.random(size) < missing] = oracle.OFFSET_INVALID
    np.testing.assert_array_equal(
        run_fit(backend, offset, reference, target), oracle.fit_offsets(offset, reference, target)
    )


@every_backend
@pytest.mark.parametrize("position", [-100, 0, 64, 120])
def test_the_fit_finds_the_tip_between_whole_pixels(backend, position):
    """Costs that grow by 20 bits per pixel from a tip at `position` / 256 pixel: the tip is found."""
    content = np.zeros((9, 30), dtype=np.uint64)
    columns = np.arange(30)
    # Target word of column c: as many bits as the cost between it and any reference pixel at c - 15.
    costs = np.round(20 * np.abs(columns - 15 - position / 256)).astype(int)
    target = np.broadcast_to(np.array([(1 << min(c, 62)) - 1 for c in costs], dtype=np.uint64), (9, 30)).copy()
    offset = np.full((9, 30), oracle.OFFSET_INVALID, dtype=np.int32)
    offset[:, 13:18] = 256 * (15 - columns[13:18])
    fitted = run_fit(backend, offset, content, target)
    assert np.abs(fitted[2:-2, 15] - position).max() <= 8


# ---- warp --------------------------------------------------------------------------------------------------


def run_warp(source, valid, prediction, margin, target_width):
    shape = source.shape[0], target_width
    warped = np.full(shape, 5, dtype=np.float32)
    content = np.full(shape, 5, dtype=np.uint8)
    columns = np.full(shape, 5, dtype=np.int32)
    _native.warp(source, valid, prediction, margin, warped, content, columns)
    return warped, content, columns


def run_unwarp(offset, prediction, margin):
    unwarped_offset = np.full(offset.shape, 5, dtype=np.int32)
    _native.unwarp_offsets(offset, prediction, margin, unwarped_offset)
    return unwarped_offset


PREDICTIONS = {
    "none": lambda rng, shape: np.zeros(shape),
    "whole": lambda rng, shape: 256 * rng.integers(-9, 9, shape),
    "half": lambda rng, shape: 256 * rng.integers(-9, 9, shape) + rng.integers(127, 130, shape),
    "smooth": lambda rng, shape: rng.integers(-200, 200, shape).cumsum(axis=1) - 700,
    "folded": lambda rng, shape: rng.integers(-600, 300, shape).cumsum(axis=1),
    "steps": lambda rng, shape: rng.choice([-2000, -1024, -1023, 0, 1, 1025, 5000], shape),
    "extreme": lambda rng, shape: rng.choice([INT32.min, INT32.min + 1, -1, 0, INT32.max - 1, INT32.max], shape),
}
margins = st.sampled_from([0, 1, 16, 33, 65535])


@property_test
@given(
    size=st.tuples(st.integers(0, 3), st.integers(1, 40)),
    widths=st.tuples(st.integers(0, 60), st.integers(0, 70)),
    margin=margins,
    kind=st.sampled_from(list(PREDICTIONS)),
    invalid=shares,
    seed=seeds,
)
def test_the_warp_is_the_oracles(size, widths, margin, kind, invalid, seed):
    rng = np.random.default_rng(seed)
    source_width, target_width = widths
    shape = size[0], source_width
    valid = np.where(rng.random(shape) < invalid, 0, rng.integers(1, 256, shape)).astype(np.uint8)
    prediction = PREDICTIONS[kind](rng, size).astype(np.int32)
    # Whole grey values are interpolated exactly in 32 bits.
    for source, tolerance in ((rng.integers(0, 256, shape), 0.0), (rng.uniform(0, 255, shape), 1e-4)):
        given = source.astype(np.float32), valid, prediction, margin, target_width
        image, *others = run_warp(*given)
        expected, *expected_others = oracle.warp(*given)
        np.testing.assert_allclose(image, expected, rtol=0, atol=tolerance)
        np.testing.assert_array_equal(others, expected_others)


@pytest.mark.parametrize("slope", [-40, 0, 3, 256])
@pytest.mark.parametrize("margin", [0, 5])
def test_a_linear_image_is_warped_exactly(slope, margin):
    """Grey values 3 + c / 2 of source column c, at 1/256 of 64 + (256 + slope) x for reference column x.

    Beyond its sides the source goes on as its outermost pixels.
    """
    reference = np.arange(50)
    source = np.tile(3 + np.arange(90) / 2, (2, 1)).astype(np.float32)
    prediction = np.tile(64 + slope * reference, (2, 1)).astype(np.int32)
    image, content, columns = run_warp(
        source, np.full(source.shape, 255, np.uint8), prediction, margin, 50 + margin
    )
    place = np.concatenate([64 / 256 + np.arange(-margin, 0), (64 + (256 + slope) * reference) / 256])
    inside = (place >= 0) & (place <= 89)
    assert inside.sum() > 40
    np.testing.assert_array_equal(image, np.tile(3 + np.clip(place, 0, 89) / 2, (2, 1)))
    # A pixel reaches half a column to either side.
    nearest = np.floor(place + 0.5)
    shown = (nearest >= 0) & (nearest < 90)
    np.testing.assert_array_equal(content, np.tile(np.where(shown, 255, 0), (2, 1)))
    np.testing.assert_array_equal(columns, np.tile(np.where(shown, nearest, -1), (2, 1)))


def test_nothing_is_predicted_without_reference():
    with pytest.raises(ValueError, match="reference column"):
        run_warp(np.zeros((2, 5), np.float32), np.zeros((2, 5), np.uint8), np.zeros((2, 0), np.int32), 3, 6)
    run_warp(np.zeros((0, 5), np.float32), np.zeros((0, 5), np.uint8), np.zeros((0, 0), np.int32), 3, 6)


@property_test
@given(
    size=st.tuples(st.integers(0, 3), st.integers(0, 40)),
    margin=margins,
    kind=st.sampled_from(list(PREDICTIONS)),
    offsets=st.sampled_from(["near", "far", "extreme"]),
    seed=seeds,
)
def test_offsets_are_unwarped_as_the_oracle_does(size, margin, kind, offsets, seed):
    rng = np.random.default_rng(seed)
    prediction = PREDICTIONS[kind](rng, size).astype(np.int32)
    offset = {
        "near": rng.integers(-5000, 5000, size) + 256 * margin,
        "far": rng.integers(-(1 << 25), 1 << 25, size),
        "extreme": rng.choice([INT32.min + 1, -(1 << 24), 1 << 24, INT32.max], size),
    }[offsets].astype(np.int32)
    offset[rng.random(size) < 0.2] = oracle.OFFSET_INVALID
    np.testing.assert_array_equal(
        run_unwarp(offset, prediction, margin), oracle.unwarp_offsets(offset, prediction, margin)
    )


@pytest.mark.parametrize("residual", [-700, -256, -1, 0, 100, 512])
@pytest.mark.parametrize("slope", [-30, 0, 200])
def test_unwarping_adds_what_is_predicted_where_the_match_lies(residual, slope):
    """Of a linear prediction, to the last 1/256 pixel; of a residual of 0, the prediction itself."""
    columns = np.arange(80)
    prediction = np.tile(700 + slope * columns, (3, 1)).astype(np.int32)
    margin = 16
    offset = np.full_like(prediction, 256 * margin + residual)
    exact = residual + 700 + np.floor(slope * (256 * columns + residual) / 256)
    inner = slice(3, -3)
    np.testing.assert_array_equal(
        run_unwarp(offset, prediction, margin)[:, inner], np.tile(exact, (3, 1))[:, inner]
    )


@property_test
@given(
    kind=st.sampled_from(["whole", "half", "smooth", "folded", "steps"]),
    margin=st.sampled_from([0, 16]),
    seed=seeds,
)
def test_unwarping_leads_to_the_column_that_was_warped(kind, margin, seed):
    """A match with target pixel w of the warped image is one with the source column that w shows."""
    rng = np.random.default_rng(seed)
    prediction = PREDICTIONS[kind](rng, (2, 60)).astype(np.int32)
    source = np.zeros((2, 90), np.float32)
    columns = run_warp(source, np.ones(source.shape, np.uint8), prediction, margin, 60 + 2 * margin)[2]
    target = rng.integers(margin, 60 + margin, (2, 60))  # of every reference pixel
    own = np.arange(60)
    unwarped_offset = run_unwarp((256 * (target - own)).astype(np.int32), prediction, margin)
    place = np.floor(own + unwarped_offset / 256 + 0.5)
    shown = np.take_along_axis(columns, target, axis=1)
    np.testing.assert_array_equal(np.where((place < 0) | (place >= 90), -1, place), shown)


# ---- means of offsets --------------------------------------------------------------------------------------


def run_mean(backend, offset, radius, max_step):
    mean = np.full(offset.shape, 5, dtype=np.int32)
    _native.mean_offsets(backend, offset, radius, max_step, mean)
    return mean


@property_test
@given(
    size=st.tuples(st.integers(0, 5), st.integers(0, 25)),
    kind=st.sampled_from(list(PREDICTIONS)),
    radius=st.sampled_from([0, 1, 3, 10]),
    max_step=st.sampled_from([0, 1, 768, 1 << 20]),
    seed=seeds,
)
def test_means_are_the_oracles(size, kind, radius, max_step, seed):
    offset = PREDICTIONS[kind](np.random.default_rng(seed), size).astype(np.int32)
    expected = oracle.mean_offsets(offset, radius, max_step)
    for backend in BACKENDS:
        np.testing.assert_array_equal(run_mean(backend, offset, radius, max_step), expected)


def test_the_mean_of_a_plane_is_the_plane():
    offset = (70 * np.arange(40) - 50 * np.arange(30)[:, None] - 1000).astype(np.int32)
    mean = run_mean("scalar", offset, 3, 360)
    np.testing.assert_array_equal(mean[3:-3, 3:-3], offset[3:-3, 3:-3])
    assert (mean[0] != offset[0]).any()


def test_means_leave_out_what_is_of_another_surface():
    """Noise of both surfaces is averaged, and nothing crosses the step between them, however large it is."""
    rng = np.random.default_rng(0)
    noise = rng.integers(-300, 301, (40, 40))
    far = np.tile(np.arange(40) >= 20, (40, 1))
    for step in (1400, -3000, INT32.max - 300):
        offset = np.where(far, step, 0) + noise
        mean = run_mean("scalar", offset.astype(np.int32), 3, 768)
        assert np.abs(mean - np.where(far, step, 0)).max() < 150
    ends = np.where(far, INT32.max, INT32.min).astype(np.int32)
    np.testing.assert_array_equal(run_mean("scalar", ends, 3, 768), ends)


# ---- from level to level -----------------------------------------------------------------------------------

fine_sizes = st.tuples(st.integers(0, 9), st.integers(0, 33))


def coarse(fine):
    return tuple((size + 1) // 2 for size in fine)


def run_upsample(offset, max_step, shape):
    """Of every version, which give the same."""
    found = [np.full(shape, 5, dtype=np.int32) for _ in BACKENDS]
    for backend, fine in zip(BACKENDS, found, strict=True):
        _native.upsample_offsets(backend, offset, max_step, fine)
        np.testing.assert_array_equal(fine, found[0])
    return found[0]


def run_windows(least, most, predicted, depth, clearance, own_clearance):
    base = np.full(predicted.shape, 5, dtype=np.int32)
    _native.search_windows(least, most, predicted, depth, clearance, own_clearance, base)
    return base


@property_test
@given(
    shape=fine_sizes,
    kind=st.sampled_from(list(PREDICTIONS)),
    max_step=st.sampled_from([0, 300, 1024, 1 << 20]),
    seed=seeds,
)
def test_offsets_of_the_finer_level_are_the_oracles(shape, kind, max_step, seed):
    offset = PREDICTIONS[kind](np.random.default_rng(seed), coarse(shape)).astype(np.int32)
    np.testing.assert_array_equal(
        run_upsample(offset, max_step, shape), oracle.upsample_offsets(offset, max_step, shape)
    )


@pytest.mark.parametrize("shape", [(19, 39), (20, 40)])
def test_a_plane_is_a_plane_at_the_finer_level(shape):
    """Pixel x of the coarser level has its middle between 2 x and 2 x + 1 of the finer one."""
    rows, columns = (np.arange(size) for size in coarse(shape))
    offset = (32 * columns - 64 * rows[:, None] + 1000).astype(np.int32)
    y, x = np.mgrid[: shape[0], : shape[1]]
    plane = 32 * (x - 0.5) / 2 - 64 * (y - 0.5) / 2 + 1000
    fine = run_upsample(offset, 300, shape)
    np.testing.assert_array_equal(fine[1:-1, 1:-1], plane[1:-1, 1:-1])
    np.testing.assert_array_equal(run_upsample(offset, 50, shape)[2:-2, 2:-2], offset[y // 2, x // 2][2:-2, 2:-2])


@property_test
@given(
    shape=fine_sizes,
    reach=st.sampled_from([0, 3, 30, 1e9]),
    limits=st.sampled_from([(32, 0, 0), (32, 4, 6), (32, 16, 16), (64, 4, 6), (1024, 500, 0)]),
    seed=seeds,
)
def test_search_windows_are_the_oracles(shape, reach, limits, seed):
    rng = np.random.default_rng(seed)
    predicted = rng.integers(-20000, 20000, shape)
    middle = rng.integers(-20000, 20000, coarse(shape)) / 512
    least, most = ((middle + reach * sign * rng.random(middle.shape)).astype(np.float32) for sign in (-1, 1))
    bounds = least, most, predicted.astype(np.int32)
    np.testing.assert_array_equal(run_windows(*bounds, *limits), oracle.search_windows(*bounds, *limits))


def test_windows_hold_what_fits():
    """By as much as the clearance, in the middle of the window where there is nothing else."""
    least, most = (np.array([row], np.float32) for row in ([-3, -3, -20], [2, 5, 20]))
    base = run_windows(least, most, np.zeros((2, 6), np.int32), 32, 4, 6)
    # -6 to 4, -6 to 10 and -40 to 40 pixels; at most 12 fit on either side of the middle.
    np.testing.assert_array_equal(base, np.repeat([[-16, -16, -16]], 2, axis=1).repeat(2, axis=0))
    base = run_windows(least, most, np.full((2, 6), 10 * 256, np.int32), 32, 4, 6)
    # 10 pixels further, the former two lie from -16 on; the window moves by 4. The last has 18 more before it.
    np.testing.assert_array_equal(base, np.repeat([[-20, -20, -26]], 2, axis=1).repeat(2, axis=0))


def test_disparities_are_offsets_less_their_shift():
    offset = np.array([[0, 256, -257, 1, oracle.OFFSET_INVALID, INT32.max]], np.int32)
    shifts = (np.arange(256) / 4096).astype(np.float32)
    disparity = np.full(offset.shape, 5, np.float32)
    _native.to_disparity(offset, shifts, disparity)
    expected = [0, -1, 257 / 256 - 255 / 4096, -1 / 256 - 1 / 4096, np.nan, -(2.0**23) - 255 / 4096]
    np.testing.assert_allclose(disparity[0], expected, rtol=1e-7)


# ---- the whole chain ---------------------------------------------------------------------------------------


def run_match(backend, images, bases_, image, p1, p2, max_slant, check: tuple[int, int], depth, edges):
    """In bands of rows between `edges`, the last of which but one is matched first, then those above and below.

    `images` are the census of reference and target and what the target shows, `bases_` base and surface.
    """
    reference, target, columns, width = images
    height = len(image)
    offset = np.full(image.shape, 5, dtype=np.int32)
    bands = list(itertools.pairwise(edges))
    middle = max(len(bands) - 2, 0)

    def given(number):
        """Arrays of a band and the rows beside it, and its place."""
        first, end = bands[number]
        low, high = max(first - 1, 0), min(end + 1, height)
        arrays = (np.ascontiguousarray(array[low:high]) for array in (reference, target, columns, *bases_, image))
        return *arrays, (first - low, end - low, first, height - end)

    def state():
        return np.full(_native.sweep_bytes(backend, image.shape[1], depth), 77, np.uint8)

    def swept(numbers, backward):
        states = [state()]
        for number in numbers:
            *arrays, place = given(number)
            states.append(states[-1].copy())
            arguments = [*arrays[:2], *arrays[3:], depth, p1, p2, max_slant, *place, backward, states[-1]]
            _native.sweep(backend, *arguments)
        return states

    def match(number, forward, backward):
        *arrays, (first, end, above, below) = given(number)
        scratch = np.full((2, (end - first) * image.shape[1], depth), 77, dtype=np.uint8)
        found = np.full((end - first, image.shape[1]), 5, dtype=np.int32)
        limits = p1, p2, max_slant, *check
        place = first, above, below
        arguments = [*arrays[:3], width, *arrays[3:], *limits, *place, forward, backward, scratch, found]
        _native.match(backend, *arguments)
        offset[slice(*bands[number])] = found

    downwards = swept(range(middle), backward=False)
    upwards = swept(range(len(bands) - 1, middle, -1), backward=True)
    forward, backward = downwards.pop(), upwards.pop()
    match(middle, forward, backward)
    for number in range(middle + 1, len(bands)):
        match(number, forward, upwards.pop())
    for number in range(middle - 1, -1, -1):
        match(number, downwards.pop(), backward)
    return offset


@functools.lru_cache(maxsize=1)  # backends follow one another
def chain_of_oracles(size, depth, columns, kind, content):
    """Input of the matcher, and what the oracles make of it one after the other."""
    rng = np.random.default_rng(depth + size[1])
    left, right = (
        rng.choice(np.array(GREYS["full"], np.int16), (size[0] + 6, width + 8)) for width in (size[1], size[1] + 5)
    )
    base = bases(rng, size, kind)
    valid = [np.where(rng.random(shape) < 0.1, 0, 1).astype(np.uint8) for shape in (size, (size[0], size[1] + 5))]
    if content == "from side to side":
        # Rows with content on other sides than the next, and some without.
        first, end = np.sort(rng.integers(0, size[1] + 1, (2, size[0], 1)), axis=0)
        column = np.arange(size[1])
        valid[0][(column < first) | (column >= end)] = 0
    reference, target = oracle.census(left, valid[0]), oracle.census(right, valid[1])
    image = (left[3:-3, 4:-4] // 64).astype(np.uint8)
    p2 = p2_table(rng, 10, 30, 120)
    surface, shown = base, unwarped(target.shape)
    if columns != "same":
        surface = base + rng.integers(-3, 4, size).cumsum(axis=1).astype(np.int32)
        shown = source_columns(rng, target.shape, columns, 2 * size[1]), 2 * size[1]
    cost = oracle.matching_cost(reference, target, base, depth)
    sums = oracle.aggregation(cost, surface, image, 10, p2, 2, oracle.spans(reference))
    expected = oracle.selection(sums, base, reference, target, *shown, 2, 5)
    return (right, valid[1]), (reference, target, *shown), (base, surface), image, p2, expected


@every_backend
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("depth", "columns"), [*((depth, "same") for depth in DEPTHS), (32, "torn"), (64, "stretched")]
)
@pytest.mark.parametrize("kind", ["smooth", "rough", "jumps"])
@pytest.mark.parametrize("content", ["all over", "from side to side"])
def test_the_matcher_is_the_chain_of_oracles(backend, size, depth, columns, kind, content):
    picture, images, bases_, image, p2, expected = chain_of_oracles(size, depth, columns, kind, content)
    np.testing.assert_array_equal(run_census(backend, *picture), images[1])
    # In one piece, and in bands of rows: to the bit the same.
    for rows in {1, 2, 3, max(size[0], 1)}:
        edges = [*range(0, size[0], rows), size[0]] if size[0] else [0, 0]
        offset = run_match(backend, images, bases_, image, 10, p2, 2, (2, 5), depth, edges)
        np.testing.assert_array_equal(offset, expected)
