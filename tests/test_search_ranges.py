"""Where pixels are searched for: ranges of pairs and of pixels against closed formulas."""

import numpy as np
import pytest

from colmap_sph.errors import RectificationError
from colmap_sph.stereo.disparity_range import columns_with_counterparts, few_digits, parallax_range
from colmap_sph.stereo.search.offsets import INVALID, SUBPIXEL
from colmap_sph.stereo.search_ranges import MAX_DEPTH, STEP, num_levels, propagate, range_depth, whole_range


def test_few_points_tell_no_range() -> None:
    least, most = parallax_range(np.full(7, 0.1), near_margin=2, far_margin=2)
    assert (least, most) == pytest.approx((np.radians(0.3), np.radians(60)))


@pytest.mark.parametrize("scale", [1e-3, 0.02, 0.7])
def test_the_range_holds_the_points_and_its_margins(scale: float) -> None:
    parallaxes = scale * np.linspace(1, 2, 1001)
    least, most = parallax_range(parallaxes, near_margin=3, far_margin=1.5)
    # All but a hundredth at either end, rounded outwards to 11 binary digits.
    assert 1.01 * scale / 1.5 * (1 - 2**-10) <= least <= 1.01 * scale / 1.5 * (1 + 1e-9)
    assert 1.99 * scale * 3 * (1 - 1e-9) <= most <= 1.99 * scale * 3 * (1 + 2**-10)


def test_points_behind_the_cameras_do_not_turn_the_range_around() -> None:
    least, most = parallax_range(np.linspace(-1, -0.5, 100), near_margin=1, far_margin=1)
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


@pytest.mark.parametrize(("low", "high"), [(0, 0), (-20, 9), (-20, 10), (5, 900), (0, 5000)])
def test_the_whole_range_is_searched_with_one_more_at_either_end(low: int, high: int) -> None:
    base, depth = whole_range((3, 4), low, high)
    assert base.shape == (3, 4) and (base == low - 1).all()
    assert depth == range_depth(low, high) and depth % STEP == 0
    assert low - 1 + depth > high + 1 or depth == MAX_DEPTH
    assert depth - STEP < high - low + 3


def test_a_slanted_surface_is_searched_for_where_it_is() -> None:
    columns = np.arange(60)
    offset = np.tile(np.round(0.3 * columns * SUBPIXEL).astype(np.int32), (50, 1))
    offset[20:25, 10:30] = INVALID
    base = propagate(offset, (99, 119), 32, -1000, 1000, 4)
    # Twice the size: 0.3 pixels per column as before, from half a pixel of the finer level on.
    truth = 2 * 0.3 * ((np.arange(119) - 0.5) / 2)
    assert base.shape == (99, 119)
    assert np.abs(base + 16 - truth)[:, 8:-8].max() <= 2


def test_a_step_is_searched_for_on_both_sides() -> None:
    """A range that fits holds both surfaces; one that does not holds each pixel's own, with room for its fit."""
    for step in (5, 40):
        offset = np.zeros((40, 60), np.int32)
        offset[:, 30:] = step * SUBPIXEL
        base = propagate(offset, (80, 120), 32, -1000, 1000, 4)
        truth = np.where(np.arange(120) < 60, 0, 2 * step)
        room = np.minimum(truth - base, base + 31 - truth)
        assert room.min() >= (4 if step == 5 else 5)
        if step == 5:
            both = slice(56, 64)
            assert (base[:, both] <= 0).all() and (base[:, both] + 31 >= 10).all()


def test_search_ranges_stay_in_the_whole_range() -> None:
    offset = np.full((40, 60), 10 * SUBPIXEL, np.int32)
    assert (propagate(offset, (80, 120), 32, -5, 20, 4) == -6).all()
    assert (propagate(offset, (80, 120), 32, 3, 60, 4) == 4).all()
    assert (propagate(offset, (80, 120), 32, -60, 22, 4) == -8).all()


def test_a_level_without_any_match_leaves_the_middle() -> None:
    offset = np.full((5, 5), INVALID, np.int32)
    assert (propagate(offset, (10, 9), 32, 10, 90, 4) == 34).all()
