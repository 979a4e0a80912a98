"""Outermost pixels of surfaces, which views of wide images have in excess: fringes and rims."""

import numpy as np
import pytest

from colmap_sph.stereo.photographs.fringes import drop_fringes, drop_rims


def dropped(depth):
    """What is left of a map."""
    left = np.array(depth, np.float32)
    drop_fringes(left)
    return left


def fringe_of(depth):
    """The same pixel by pixel: in some direction, the next depth within three pixels is farther by a tenth."""
    inverse = {place: np.float32(1) / value for place, value in np.ndenumerate(depth) if value > 0}
    found = np.zeros(depth.shape, bool)
    for (row, column), own in inverse.items():
        for down in (-1, 0, 1):
            for across in (-1, 0, 1):
                beyond = [(row + k * down, column + k * across) for k in (1, 2, 3)]
                there = [(k, inverse[place]) for k, place in enumerate(beyond, 1) if place in inverse]
                before = inverse.get((row - down, column - across))
                if (down, across) == (0, 0) or before is None or not there:
                    continue
                away, farther = there[0]
                is_farther = own > np.float32(1.1) * farther and not own >= np.float32(1.1) * before
                found[row, column] |= is_farther and own - farther > away * np.float32(2) * (before - own)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_fringes_are_those_of_a_slow_search(seed):
    rng = np.random.default_rng(seed)
    depth = rng.choice([0, 4, 4.3, 5, 9], (23, 31)).astype(np.float32) * rng.uniform(0.98, 1.02, (23, 31))
    depth = depth.astype(np.float32)
    expected = np.where(fringe_of(depth), 0, depth)
    assert 50 < (expected != depth).sum() < 400
    np.testing.assert_array_equal(dropped(depth), expected)


def disc(radius):
    y, x = np.mgrid[:80, :80] - 40
    return np.hypot(x, y) <= radius


@pytest.mark.parametrize("gap", [0, 1, 2])
def test_a_disc_found_too_wide_has_its_own_size_again(gap):
    """One pixel too wide, before a wall, of which some that it hides from others is missing."""
    truth = np.where(disc(20), 5.0, 8.0)
    found = np.where(disc(21), 5.0, 8.0)
    found[disc(21 + gap) & ~disc(21)] = 0
    left = dropped(found)
    assert (np.abs(found - truth) > 0.1)[found > 0].sum() > 100
    assert not (np.abs(left - truth) > 0.1)[left > 0].any()
    assert (left[disc(19)] == 5).all()
    np.testing.assert_array_equal(left[~disc(21)], found[~disc(21)])


def test_ground_goes_on_to_the_horizon():
    """Its depth grows by more than a tenth from row to row, as far as it is known."""
    below = np.arange(60.0, 0.5, -1)[:, None]
    ground = np.broadcast_to(100 / below, (60, 50)).astype(np.float32)
    assert (ground[1:] / ground[:-1]).max() > 1.9
    np.testing.assert_array_equal(dropped(ground), ground)
    # What stands on it has edges.
    post = ground.copy()
    post[30:, 20:25] = ground[30, 0]
    left = dropped(post)
    assert (left[35:, [20, 24]] == 0).all()
    assert (left[30:, 21:24] > 0).all()
    np.testing.assert_array_equal(left[:, :20], ground[:, :20])


@pytest.mark.parametrize("line", [np.arange(40) == 7, np.eye(40, dtype=bool)])
def test_lines_of_one_pixel_stay(line):
    wire = np.where(np.broadcast_to(line, (40, 40)), 3.0, 9.0)
    np.testing.assert_array_equal(dropped(wire), wire)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 3)])
def test_maps_of_any_size(shape):
    assert (dropped(np.full(shape, 2.0)) == 2).all()
    assert not dropped(np.zeros(shape)).any()


# ---- rims ----------------------------------------------------------------------------------------------------


def without_rims(depth, mask=None):
    """What is left of a map."""
    left = np.array(depth, np.float32)
    drop_rims(left, mask)
    return left


def rims_of(depth, mask):
    """The same pixel by pixel: how much of 5 x 5 pixels, of those shown, is of its surface; the least go first."""
    shares = np.full(depth.shape, np.inf)
    for (row, column), own in np.ndenumerate(depth):
        if own > 0:
            window = np.s_[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
            same = np.abs(depth[window] - own) < np.float32(0.05) * own
            shares[row, column] = 25 * same.sum() // max(np.count_nonzero(mask[window]), same.sum())
    levels = [level for level in range(16) if (shares <= level).sum() <= 0.04 * np.count_nonzero(depth)]
    return shares <= max(levels, default=-1)


@pytest.mark.parametrize("seed", range(4))
def test_rims_are_those_of_a_slow_search(seed):
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:61, :83]
    depth = np.where(np.hypot(rows - 30, columns - 40) < 18 + 3 * seed, 4.0, 9.0) + 0.01 * rows
    depth *= rng.uniform(0.985, 1.015, depth.shape)
    depth[rng.random(depth.shape) < 0.02] = 0
    mask = np.where(columns + rows < 12, 0, 255).astype(np.uint8)
    depth = np.where(mask > 0, depth, 0).astype(np.float32)
    expected = np.where(rims_of(depth, mask), 0, depth)
    assert 20 < (expected != depth).sum() <= 0.04 * np.count_nonzero(depth)
    np.testing.assert_array_equal(without_rims(depth, mask), expected)


def test_ragged_rims_go_and_even_surfaces_stay():
    """A disc with crumbs at its rim, where nothing is known around: the crumbs go, and little of the disc."""
    rng = np.random.default_rng(3)
    ring = disc(23) & ~disc(20)
    crumbs = ring & (rng.random(ring.shape) < 0.1)
    found = np.where(disc(20) | crumbs, 5.0, 0.0)
    left = without_rims(found)
    assert crumbs.sum() > 20
    assert (left[crumbs] == 0).mean() > 0.8
    assert (left[disc(19)] == 5).all()
    assert np.count_nonzero(left) >= 0.96 * np.count_nonzero(found)


def test_a_map_of_fragments_keeps_nearly_all():
    """Each pixel of a fragment of 3 x 3 pixels is a rim, which says nothing then."""
    rows, columns = np.mgrid[:100, :120]
    fragments = np.where((rows % 6 < 3) & (columns % 6 < 3), 5.0, 0.0)
    np.testing.assert_array_equal(without_rims(fragments), fragments)
    # One pixel alone is the least likely of all.
    fragments[52, 52] = 5
    left = without_rims(fragments)
    assert left[52, 52] == 0
    assert np.count_nonzero(left) == np.count_nonzero(fragments) - 1


@pytest.mark.parametrize("is_masked", [True, False])
def test_where_the_lens_ends_there_is_no_rim(is_masked):
    """A wall seen through a small round lens; without a mask its corners would be rims."""
    wall = np.where(disc(30), 5.0, 0.0)
    left = without_rims(wall, np.where(disc(30), 255, 0).astype(np.uint8) if is_masked else None)
    assert (np.count_nonzero(left) == np.count_nonzero(wall)) == is_masked


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 3)])
def test_rims_of_maps_of_any_size(shape):
    assert (without_rims(np.full(shape, 2.0)) == 2).all()
    assert not without_rims(np.zeros(shape)).any()
