"""Where pixels are searched for: ranges of pairs and of pixels against closed formulas."""

import numpy as np
import pytest
from scipy import ndimage

from colmap_sph.errors import RectificationError
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.disparity_range import columns_with_counterparts, few_digits, parallax_range
from colmap_sph.stereo.search import prediction as prediction_module
from colmap_sph.stereo.search.offsets import INVALID, SUBPIXEL
from colmap_sph.stereo.search.prediction import (
    Prediction,
    about_coarser,
    from_coarser,
    from_seeds,
    is_flat,
    near_matches,
    searched_depth,
)
from colmap_sph.stereo.search.ranges import MAX_DEPTH, STEP, num_levels, range_depth


def test_few_points_tell_no_range() -> None:
    least, most = parallax_range(np.full(7, 0.05), np.full(7, 0.2))
    assert (least, most) == pytest.approx((np.radians(0.3), np.radians(60)))


@pytest.mark.parametrize("scale", [1e-3, 0.02, 0.7])
def test_the_range_holds_the_points_and_its_margins(scale: float) -> None:
    parallaxes = scale * np.linspace(1, 2, 1001)
    least, most = parallax_range(parallaxes / 1.5, parallaxes * 3)
    # All but a hundredth at either end, rounded outwards to 11 binary digits.
    assert 1.01 * scale / 1.5 * (1 - 2**-10) <= least <= 1.01 * scale / 1.5 * (1 + 1e-9)
    assert 1.99 * scale * 3 * (1 - 1e-9) <= most <= 1.99 * scale * 3 * (1 + 2**-10)


def test_points_behind_the_cameras_do_not_turn_the_range_around() -> None:
    least, most = parallax_range(np.linspace(-1, -0.5, 100), np.linspace(-1, -0.5, 100))
    assert 0 < least <= most


def test_few_digits_do_not_depend_on_the_last_ones() -> None:
    assert few_digits(0.1, np.floor) == few_digits(0.1 + 1e-12, np.floor) <= 0.1 <= few_digits(0.1, np.ceil)
    assert few_digits(3.0, np.floor) == few_digits(3.0, np.ceil) == 3


def test_columns_without_a_counterpart_are_left_out() -> None:
    """A point at x in the left image lies at x minus its parallax in the right one."""
    left, right = columns_with_counterparts((0, 10), (-3, 6), least=1, most=2)
    assert (left, right) == ((0, 8), (-2, 6))
    with pytest.raises(RectificationError, match="do not overlap"):
        columns_with_counterparts((0, 1), (5, 6), least=1, most=2)


def test_levels_shorten_the_range_and_keep_images_large_enough() -> None:
    assert num_levels(100, 250, 128) == 0
    assert num_levels(100, 256, 128) == 2
    assert num_levels(1000, 2000, 128) == 3
    assert num_levels(10**6, 200, 128) == 2
    assert num_levels(10**6, 63, 128) == 0


RANGES = [(0, 0), (-20, 9), (-20, 10), (5, 900), (0, 5000)]


@pytest.mark.parametrize(("low", "high"), RANGES)
def test_a_range_is_searched_with_one_more_at_either_end(low: int, high: int) -> None:
    depth = range_depth(low, high)
    assert depth % STEP == 0
    assert depth >= high - low + 3 or depth == MAX_DEPTH
    assert depth - STEP < high - low + 3
    assert searched_depth(low, high, 64) == min(depth, 64)


# ---- the coarsest level ------------------------------------------------------------------------------------


def check_reach(prediction: Prediction, low: int, high: int) -> None:
    """Every pixel searches the whole range and one more at either end, and less than a step in vain."""
    depth = prediction.depth
    assert depth % STEP == 0 and depth <= MAX_DEPTH
    if depth < MAX_DEPTH:
        assert (prediction.first <= low - 1).all()
        assert (prediction.first + depth - 1 >= high + 1).all()
    farthest = max(high - prediction.offset.min() / SUBPIXEL, prediction.offset.max() / SUBPIXEL - low)
    assert depth - STEP <= 2 * farthest + 5


@pytest.mark.parametrize(("low", "high"), RANGES)
def test_without_seeds_the_middle_of_the_range_is_predicted(low: int, high: int) -> None:
    for nothing in (None, np.zeros((0, 3))):
        prediction = from_seeds(nothing, (3, 4), 1, low, high)
        np.testing.assert_array_equal(prediction.offset, np.full((3, 4), (low + high) // 2 * SUBPIXEL))
        check_reach(prediction, low, high)


@pytest.mark.parametrize(("low", "high"), RANGES)
@pytest.mark.parametrize("disparity", [-40, 30.25, -10000, 10000])
def test_seeds_are_predicted_as_far_as_the_range_goes(low: int, high: int, disparity: float) -> None:
    """At level 2, whose pixels have four times the size; to a sixteenth of a pixel."""
    seeds = np.column_stack([np.random.default_rng(0).uniform(0, 60, (20, 2)), np.full(20, disparity)])
    prediction = from_seeds(seeds, (15, 16), 2, low, high)
    expected = np.clip(-disparity / 4, low, high)
    assert np.abs(prediction.offset / SUBPIXEL - expected).max() <= 1 / 32
    check_reach(prediction, low, high)


def test_unlike_seeds_all_search_the_whole_range() -> None:
    rng = np.random.default_rng(0)
    seeds = np.column_stack([rng.uniform(0, 160, (40, 2)), rng.uniform(-30, 200, 40)])
    prediction = from_seeds(seeds, (40, 41), 2, -50, 20)
    assert np.ptp(prediction.offset) > 20 * SUBPIXEL
    check_reach(prediction, -50, 20)


# ---- the levels below --------------------------------------------------------------------------------------


def steps(offset: np.ndarray) -> np.ndarray:
    """Pixels in 1/256 pixel."""
    return np.round(offset * SUBPIXEL).astype(np.int32)


def prior_of(offset: np.ndarray) -> Prediction:
    return Prediction(steps(offset), np.zeros(offset.shape, np.int32), STEP)


def finer(slope: float, size: int) -> np.ndarray:
    """Offsets of pixels of the finer level, where slope * x are those of pixel x of the coarser one.

    Pixel x of the coarser level covers 2 x and 2 x + 1 of the finer one.
    """
    return 2 * slope * (np.arange(size) - 0.5) / 2


def warped(
    monkeypatch: pytest.MonkeyPatch,
    offset: np.ndarray,
    prior: Prediction,
    shape: tuple[int, int],
    depth: int,
    radius: int,
) -> Prediction:
    """What is searched of a level that is warped even where it is flat."""
    monkeypatch.setattr(prediction_module, "is_flat", lambda _: False)
    return from_coarser(offset, prior, shape, depth, radius, (-1000, 1000))


@pytest.mark.parametrize("slope", [0.3, -0.7])
def test_a_slanted_surface_is_predicted_where_it_is(slope: float, monkeypatch: pytest.MonkeyPatch) -> None:
    offset = np.tile(slope * np.arange(60), (50, 1))
    prediction = warped(monkeypatch, steps(offset), prior_of(0 * offset), (99, 119), 32, 4)
    assert prediction.offset.shape == prediction.base.shape == (99, 119)
    assert prediction.depth == 32
    inner = np.s_[:, 14:-14]
    assert np.abs(prediction.offset / SUBPIXEL - finer(slope, 119))[inner].max() < 0.02
    assert (prediction.base[inner] == -16).all()
    assert np.abs(prediction.first + 16 - finer(slope, 119))[inner].max() <= 0.52


@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_gaps_are_filled_along_what_was_predicted(slope: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A surface five pixels from the predicted one, and parallel to it, with holes."""
    prior = np.tile(slope * np.arange(60), (50, 1))
    offset = steps(prior + 5)
    offset[20:35, 20:40] = INVALID
    offset[5, 7] = INVALID
    prediction = warped(monkeypatch, offset, prior_of(prior), (100, 120), 32, 4)
    assert np.abs(prediction.offset / SUBPIXEL - 10 - finer(slope, 120))[:, 14:-14].max() < 0.02


def test_a_level_without_any_match_leaves_what_was_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    prior = np.tile(0.4 * np.arange(60), (50, 1))
    prediction = warped(monkeypatch, np.full(prior.shape, INVALID, np.int32), prior_of(prior), (100, 120), 64, 4)
    assert np.abs(prediction.offset / SUBPIXEL - finer(0.4, 120))[:, 14:-14].max() < 0.02


def test_one_outlier_predicts_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    offset = np.zeros((30, 30), np.int32)
    offset[12, 17] = 90 * SUBPIXEL
    prediction = warped(monkeypatch, offset, prior_of(np.zeros((30, 30))), (60, 60), 32, 4)
    assert not prediction.offset.any()
    assert (prediction.base == -16).all()


def test_noise_of_a_surface_is_averaged(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    offset = rng.normal(0, 0.3, (60, 80))
    prediction = warped(monkeypatch, steps(offset), prior_of(np.zeros((60, 80))), (120, 160), 32, 4)
    assert (prediction.offset / SUBPIXEL / 2).std() < 0.1


@pytest.mark.parametrize("depth", [32, 64])
@pytest.mark.parametrize("radius", [0, 2, 4])
def test_the_window_holds_all_offsets_around_where_they_fit(
    depth: int, radius: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks of some pixels, of which some are alike and others differ by much; windows see their median.

    What is predicted is a mean over pixels up to three columns away and three pixels off, which a smaller radius
    does not look at.
    """
    rng = np.random.default_rng(depth + radius)
    blocks = np.kron(rng.integers(-12, 13, (6, 8)), np.ones((9, 9), int))
    blocks[:, :36] //= 3
    prediction = warped(monkeypatch, steps(blocks), prior_of(0.0 * blocks), (108, 144), depth, radius)
    first, last = prediction.first, prediction.first + depth - 1
    own = 2 * ndimage.median_filter(blocks, 5, mode="nearest")
    fitting = 0
    for y, x in np.ndindex(108, 144):
        around = own[tuple(slice(max(k // 2 - radius, 0), k // 2 + radius + 1) for k in (y, x))]
        if np.ptp(around) <= depth - (12 if radius > 2 else 24):
            fitting += 1
            assert first[y, x] + 3 <= around.min() and around.max() <= last[y, x] - 2
        assert first[y, x] < own[y // 2, x // 2] < last[y, x]
    assert fitting > 108 * 144 // 3


def test_a_step_is_searched_for_on_both_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    """A window that fits holds both surfaces; one that does not holds each pixel's own, with room for its fit."""
    for step in (5, 40):
        offset = np.zeros((40, 60), np.int32)
        offset[:, 30:] = step * SUBPIXEL
        prediction = warped(monkeypatch, offset, prior_of(np.zeros((40, 60))), (80, 120), 32, 4)
        truth = np.where(np.arange(120) < 60, 0, 2 * step)
        room = np.minimum(truth - prediction.first, prediction.first + 31 - truth)
        assert room.min() >= (4 if step == 5 else 5)
        # Nothing is averaged or interpolated across it.
        if step == 40:
            np.testing.assert_array_equal(prediction.offset, np.tile(truth * SUBPIXEL, (80, 1)))
        else:
            both = slice(56, 64)
            assert (prediction.first[:, both] <= 0).all() and (prediction.first[:, both] + 31 >= 10).all()


def test_the_first_offset_is_the_rounded_prediction_and_the_base() -> None:
    offset = np.array([[-385, -384, -129, -128, 127, 128, 384]], np.int32)
    prediction = Prediction(offset, np.full((1, 7), -16, np.int32), 32)
    np.testing.assert_array_equal(prediction.first + 16, np.floor(offset / 256 + 0.5))


# ---- without warping ---------------------------------------------------------------------------------------


def middles(
    offset: np.ndarray, shape: tuple[int, int], depth: int, low: int, high: int, radius: int
) -> np.ndarray:
    prediction = about_coarser(offset, shape, depth, radius, (low, high))
    assert not prediction.warps and prediction.margin == 0 and not prediction.offset.any()
    np.testing.assert_array_equal(prediction.first, prediction.base)
    return prediction.base


@pytest.mark.parametrize(("steep", "flat"), [(0.0, True), (0.05, True), (0.2, False), (1.0, False)])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_level_is_flat_where_few_surfaces_are_steep(steep: float, flat: bool, axis: int) -> None:
    """Slopes of .4 pixels per pixel on a share of the image, .2 on the rest; edges are no slopes."""
    place = np.arange(400)
    slope = np.where(place < steep * 400, 0.4, 0.2)
    profile = np.cumsum(slope) + 30 * (place // 50 % 2)
    offset = steps(np.broadcast_to(profile, (60, 400)))
    offset = np.ascontiguousarray(offset.T if axis == 0 else offset)
    assert is_flat(offset) == flat


def test_without_warping_a_slanted_surface_is_searched_for() -> None:
    columns = np.arange(60)
    offset = np.tile(np.round(0.3 * columns * SUBPIXEL).astype(np.int32), (50, 1))
    offset[20:25, 10:30] = INVALID
    base = middles(offset, (99, 119), 32, -1000, 1000, 4)
    # Twice the size: 0.3 pixels per column as before, from half a pixel of the finer level on.
    truth = 2 * 0.3 * ((np.arange(119) - 0.5) / 2)
    assert base.shape == (99, 119)
    assert np.abs(base + 16 - truth)[:, 8:-8].max() <= 2


def test_without_warping_a_step_is_searched_for_on_both_sides() -> None:
    """A range that fits holds both surfaces; one that does not holds each pixel's own, with room for its fit."""
    for step in (5, 40):
        offset = np.zeros((40, 60), np.int32)
        offset[:, 30:] = step * SUBPIXEL
        base = middles(offset, (80, 120), 32, -1000, 1000, 4)
        truth = np.where(np.arange(120) < 60, 0, 2 * step)
        room = np.minimum(truth - base, base + 31 - truth)
        assert room.min() >= (4 if step == 5 else 5)
        if step == 5:
            both = slice(56, 64)
            assert (base[:, both] <= 0).all() and (base[:, both] + 31 >= 10).all()


def test_without_warping_windows_stay_in_the_whole_range() -> None:
    offset = np.full((40, 60), 10 * SUBPIXEL, np.int32)
    assert (middles(offset, (80, 120), 32, -5, 20, 4) == -6).all()
    assert (middles(offset, (80, 120), 32, 3, 60, 4) == 4).all()
    assert (middles(offset, (80, 120), 32, -60, 22, 4) == -8).all()


def test_without_warping_or_any_match_the_middle_is_searched() -> None:
    offset = np.full((5, 5), INVALID, np.int32)
    assert (middles(offset, (10, 9), 32, 10, 90, 4) == 34).all()


@pytest.mark.parametrize(("shape", "found"), [((80, 120), (20, 31)), ((79, 119), (0, 59)), ((79, 120), (39, 0))])
def test_what_is_far_from_all_coarser_matches_is_left_out(shape: tuple[int, int], found: tuple[int, int]) -> None:
    offset = np.full((40, 60), INVALID, np.int32)
    offset[found] = 5 * SUBPIXEL
    valid = np.where(np.arange(shape[1]) % 7 == 0, 0, 255) * np.ones((shape[0], 1))
    image = RectifiedImage(np.zeros(shape, np.float32), valid.astype(np.uint8))
    near = near_matches(image, offset).valid
    rows, columns = (np.arange(side) // 2 for side in shape)
    distance = np.maximum(abs(rows - found[0])[:, None], abs(columns - found[1]))
    np.testing.assert_array_equal(near, np.where(distance <= 8, image.valid, 0))


def test_where_nothing_was_found_nothing_is_matched() -> None:
    image = RectifiedImage(np.zeros((80, 120), np.float32), np.full((80, 120), 255, np.uint8))
    assert not near_matches(image, np.full((40, 60), INVALID, np.int32)).valid.any()
