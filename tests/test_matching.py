"""Matching on rendered pairs against exact disparities."""

import functools
import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest
from refusals import assert_refused
from rendered import SIDES, exact_disparity, grey, scene_of_pair, whole
from scipy import ndimage

from colmap_sph import _native
from colmap_sph import synthetic as syn
from colmap_sph.errors import OptionError
from colmap_sph.pipeline.stages.match import _MATCH_BYTES
from colmap_sph.stereo import census
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.matching import (
    SINGLE_PAIR,
    MatchingOptions,
    match_pair,
    pair_scratch_bytes,
)
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.resampling import resample
from colmap_sph.stereo.search import brightness, offsets
from colmap_sph.stereo.search.bands import Scratches, scratch_bytes
from colmap_sph.stereo.search.idle import lending

SIZE = (240, 180)
FOCAL = 300.0
OPTIONS = MatchingOptions()


def rectified_images(synthetic, pair, left, right):
    return [
        RectifiedImage(*resample(grey(synthetic.render(side)), view, pair, side))
        for side, view in zip(SIDES, (left, right), strict=True)
    ]


class Matched:
    """A synthetic pair's disparity map and its truth."""

    def __init__(self, synthetic, surface="spherical", options=OPTIONS):
        scene, left, right = scene_of_pair(synthetic)
        self.pair = rectify_pair(scene, left, right, RectificationOptions(surface=surface))
        self.images = rectified_images(synthetic, self.pair, left, right)
        self.disparity = self.match(options)
        self.truth, self.seen = exact_disparity(synthetic.surfaces, left, right, self.pair, "left")
        self.found = ~np.isnan(self.disparity)
        self.error = self.pixels_off(left.K[0, 0])[self.found & self.seen]
        self.occluded = ~self.seen & ~np.isnan(self.truth)

    def pixels_off(self, focal_length):
        """Errors: of disparities on the plane, of parallax angles on the sphere, whose columns differ in width."""
        if self.pair.surface == "frame":
            return self.disparity - self.truth
        columns = np.arange(self.disparity.shape[1])

        def right_angle(disparity):
            along = (columns - disparity + self.pair.right_origin) / self.pair.columns_per_radian
            return np.arctan(self.pair.flatness * along) / self.pair.flatness

        return (right_angle(self.truth) - right_angle(self.disparity)) * focal_length

    def match(self, options):
        return self.match_range(self.pair.min_disparity, self.pair.max_disparity, options)

    def match_range(self, low, high, options):
        return match_pair(self.images[0], self.images[1], low, high, options)

    @property
    def completeness(self):
        return self.error.size / self.seen.sum()


@functools.cache
def matched_scene(name):
    return Matched(SCENES[name])


def random_image(shape, seed=0):
    """Texture of a few pixels' size, everywhere valid."""
    rng = np.random.default_rng(seed)
    values = ndimage.gaussian_filter(rng.standard_normal(shape), 1.0)
    return whole(np.clip(128 + 200 * values, 0, 255).astype(np.uint8))


# ---- rendered scenes ---------------------------------------------------------------------------------------


PLANES = [(0, 0), (25, 120), (45, 0), (45, 90), (60, 0), (60, 30), (60, 90)]


@pytest.mark.parametrize(
    ("slant", "tilt", "surface"),
    [*((*plane, "spherical") for plane in PLANES), (25, 120, "frame"), (45, 0, "frame"), (60, 30, "frame")],
)
def test_planes_are_matched_to_a_fraction_of_a_pixel(slant, tilt, surface):
    matched = Matched(syn.slanted_plane_pair(slant, tilt, focal_length=FOCAL, size=SIZE), surface)
    assert matched.completeness > 0.98
    # Unsharp masking costs 2 % of the precision on these clean pictures, and gives more at edges and in real ones.
    bound = 0.08 if slant == 60 else 0.055
    assert np.median(np.abs(matched.error)) < bound
    assert abs(np.median(matched.error)) < 0.03
    assert (np.abs(matched.error) > 1).mean() < 0.01


@pytest.mark.parametrize("depth", [10.0, 9.8, 9.7, 9.6])
def test_a_single_disparity_is_matched_between_whole_pixels(depth):
    """One disparity all over: nothing averages out a fit that leans to whole pixels."""
    matched = Matched(syn.slanted_plane_pair(0, depth=depth, focal_length=FOCAL, size=SIZE), "frame")
    assert np.ptp(matched.truth[matched.seen]) < 1e-6
    assert matched.completeness > 0.98
    assert np.median(np.abs(matched.error)) < 0.06


def test_a_steep_plane_is_matched():
    matched = Matched(syn.slanted_plane_pair(75, 60, focal_length=FOCAL, size=SIZE))
    assert matched.completeness > 0.6
    assert np.median(np.abs(matched.error)) < 0.1
    assert (np.abs(matched.error) > 1).mean() < 0.05


SCENES = {
    "convergent": syn.convergent_pair(10.0, focal_length=FOCAL, size=SIZE),
    "forward": syn.forward_motion_pair(1.0, focal_length=240.0, size=SIZE),
    "epipole inside": syn.epipole_inside_pair(1.0, focal_length=240.0, size=SIZE),
}


@pytest.mark.parametrize("name", SCENES)
def test_scenes_with_occlusions_are_matched(name):
    """Most of what both see is found and right; most of what one alone sees is left out."""
    matched = matched_scene(name)
    assert matched.completeness > 0.95
    assert np.median(np.abs(matched.error)) < 0.1
    assert abs(np.median(matched.error)) < 0.03
    assert (np.abs(matched.error) > 1).mean() < 0.04
    assert matched.found[matched.occluded].mean() < 0.2


@pytest.mark.parametrize("name", SCENES)
def test_a_pair_alone_is_matched_more_completely_and_smoothly(name):
    """A third of the gaps closed, less noise, and hardly more that is wrong or that one image alone sees."""
    alone, voting = Matched(SCENES[name], options=SINGLE_PAIR), matched_scene(name)
    assert 1 - alone.completeness < 0.67 * (1 - voting.completeness)
    assert np.median(np.abs(alone.error)) < 0.9 * np.median(np.abs(voting.error))
    assert (np.abs(alone.error) > 1).mean() < 0.025
    assert alone.found[alone.occluded].mean() < 0.2


def test_sharpened_images_are_matched_wrong_less_often(monkeypatch):
    wrong = [[(np.abs(matched_scene(name).error) > 1).sum() for name in SCENES]]
    monkeypatch.setattr(census, "_SHARPENING", 0.0)
    wrong.append([(np.abs(Matched(scene).error) > 1).sum() for scene in SCENES.values()])
    assert sum(wrong[0]) < sum(wrong[1])


def test_fractions_of_a_grey_value_are_matched():
    """Texture of a third of a grey value, which rounding would take away, and noise of a tenth."""
    rng = np.random.default_rng(0)
    texture = ndimage.gaussian_filter(rng.standard_normal((120, 320)), 1.0)
    texture *= 0.3 / texture.std()
    pictures = [128 + texture[:, shift : shift + 300] + 0.1 * rng.standard_normal((120, 300)) for shift in (0, 20)]
    inner = np.s_[10:-10, 40:-10]
    right = [
        np.abs(match_pair(whole(images[0]), whole(images[1]), 0, 60, OPTIONS) - 20)[inner] < 1
        for images in (pictures, np.round(pictures))
    ]
    assert right[0].mean() > 0.998
    assert right[1].mean() < 0.99


def test_edges_of_fine_images_are_wider_by_less():
    """Beside edges, fewer pixels that both images see are wrong, and fewer get what stands before them."""
    matched = matched_scene("convergent")
    truth = np.where(matched.seen, matched.truth, 0)
    step = ndimage.maximum_filter(matched.truth, 9) - ndimage.minimum_filter(matched.truth, 9)
    left, right = matched.images
    low, high = matched.pair.min_disparity, matched.pair.max_disparity
    wrong, nearer = [], []
    for fine in (False, True):
        disparity = match_pair(left, right, low, high, OPTIONS, fine=fine)
        error = (disparity - truth)[matched.seen & (step > 4) & ~np.isnan(disparity)]
        assert len(error) > 4000
        wrong.append((np.abs(error) > 1).mean())
        nearer.append((error > 1).mean())
    assert wrong[1] < min(0.9 * wrong[0], 0.1)
    assert nearer[1] < min(0.9 * nearer[0], 0.07)


@pytest.mark.parametrize("fine", [False, True])
def test_grey_values_tell_where_surfaces_end(monkeypatch, fine):
    """Beside edges, more is right and less is wrong than with steps so large that grey values tell nothing."""
    matched = matched_scene("convergent")
    left, right = matched.images
    low, high = matched.pair.min_disparity, matched.pair.max_disparity
    step = ndimage.maximum_filter(matched.truth, 9) - ndimage.minimum_filter(matched.truth, 9)
    rights, wrongs = [], []
    for least_step in (brightness._LEAST_STEP, 1000.0):
        monkeypatch.setattr(brightness, "_LEAST_STEP", least_step)
        options = replace(OPTIONS, max_coarsest_disparities=32)  # such small images have no other level else
        disparity = match_pair(left, right, low, high, options, fine=fine)
        error = np.abs(disparity - matched.truth)[matched.seen & (step > 4)]
        rights.append((error <= 1).mean())
        wrongs.append((error > 1).mean())
    assert rights[0] > rights[1] + 0.01
    assert wrongs[0] < 0.9 * wrongs[1]


def test_what_a_step_hides_is_left_out():
    """A board floats before a wall: a stripe beside it is seen by the left camera alone."""
    wall = syn.slanted_plane_pair(0, depth=10.0, focal_length=FOCAL, size=SIZE)
    material = syn.Mottled(syn.Noise(6.0 / FOCAL, seed=4), contrast=0.22)
    board = syn.Plane((0.3, 0.0, 6.0), (0.0, 0.0, -1.0), material, half_size=(0.8, 0.7))
    matched = Matched(replace(wall, surfaces=(*wall.surfaces, board)))
    assert matched.occluded.sum() > 1000
    assert matched.found[matched.occluded].mean() < 0.2
    assert matched.completeness > 0.95
    assert (np.abs(matched.error) > 1).mean() < 0.02
    assert np.ptp(matched.truth[matched.seen]) > 15


def test_wide_ranges_are_searched_through_the_pyramid():
    """Nearly three times the range, as where sparse points say little: hardly anything changes."""
    matched = matched_scene("convergent")
    wide = matched.match_range(matched.pair.min_disparity - 90, matched.pair.max_disparity + 90, OPTIONS)
    both = matched.found & ~np.isnan(wide)
    assert both.sum() > 0.95 * matched.found.sum()
    assert (np.abs(wide - matched.disparity)[both] < 0.5).mean() > 0.95


# ---- exact answers -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("search", [(-20, 20), (0, 31), (-200, 10), (-0.5, 0.5)])
def test_no_motion_is_exactly_zero(search: tuple[float, float]):
    image = random_image((90, 130))
    disparity = match_pair(image, image, *search, OPTIONS)
    found = ~np.isnan(disparity)
    assert found.mean() > 0.95
    np.testing.assert_array_equal(disparity[found], 0)


@pytest.mark.parametrize("shift", [-37, -8, -1, 3, 20])
@pytest.mark.parametrize("shape", [(64, 200), (71, 151), (300, 290)])
def test_whole_pixels_are_found(shape, shift):
    """Disparity is left column minus right column: content moved left by `shift` has disparity `shift`.

    Exactly, where one level finds it; to a fraction of a pixel about what a coarser level predicts, which knows no
    whole pixels of this one.
    """
    scenery = random_image((shape[0], shape[1] + 80)).image
    left = whole(np.ascontiguousarray(scenery[:, 40 : 40 + shape[1]]))
    right = whole(np.ascontiguousarray(scenery[:, 40 + shift : 40 + shift + shape[1]]))
    disparity = match_pair(left, right, -40, 40, OPTIONS)
    column = np.arange(shape[1]) - shift
    inner = (column > 12) & (column < shape[1] - 12)
    error = np.abs(disparity[:, inner] - shift)
    if min(shape) < 256:
        assert (error < 0.02).mean() > 0.95
    assert np.nanmedian(error) < 0.05
    assert (error < 0.15).mean() > 0.95
    assert (error <= 0.5).mean() > 0.99
    # Elsewhere the right image has nothing to match.
    outside = (column < -2) | (column > shape[1] + 1)
    assert (~np.isnan(disparity[:, outside])).sum() <= 0.2 * outside.sum() * shape[0]


def test_images_of_unlike_widths_are_matched():
    scenery = random_image((80, 300)).image
    left = whole(np.ascontiguousarray(scenery[:, 20:120]))
    right = whole(scenery)
    disparity = match_pair(left, right, -60, 10, OPTIONS)
    assert (disparity[5:-5, 5:-5] == -20).mean() > 0.95
    back = match_pair(right, left, -10, 60, OPTIONS)
    assert (back[5:-5, 25:115] == 20).mean() > 0.95


# ---- the median that coarser levels pass through ----------------------------------------------------------


def smoothed(offset):
    """The matcher's median of offsets in whole pixels, NaN = none."""
    smooth = np.where(np.isnan(offset), np.iinfo(np.int32).min, np.nan_to_num(offset) * 256).astype(np.int32)
    offsets.smooth(smooth)
    return np.where(smooth == np.iinfo(np.int32).min, np.nan, smooth / 256)


def test_the_median_is_the_neighbourhoods():
    offset = np.random.default_rng(0).integers(-200, 200, (41, 56)) / 256 + 4
    expected = ndimage.median_filter(offset, 5, mode="nearest")
    np.testing.assert_array_equal(smoothed(offset), expected)


def test_the_median_keeps_slopes_edges_and_thin_things_and_fills_nothing():
    offset = np.broadcast_to(np.arange(60) / 8, (40, 60)).copy()
    offset[:, 40:] += 9
    offset[10] += 30
    offset[25:, 12:18] = np.nan
    # Where one side of the window is missing or far away, the median is that of the others.
    tolerance = np.zeros(offset.shape)
    tolerance[:, [*range(3), *range(57, 60), *range(9, 21), *range(37, 43)]] = 2 / 8
    tolerance[[*range(8, 13), *range(23, 27)]] = 2 / 8
    tolerance[10] = 0
    smooth = smoothed(offset)
    np.testing.assert_array_equal(np.isnan(smooth), np.isnan(offset))
    assert (np.nan_to_num(np.abs(smooth - offset)) <= tolerance).all()


def test_the_median_drops_what_strays_on_a_surface():
    offset = np.full((20, 30), 5.0)
    offset[8, 10], offset[8, 20], offset[14, 15] = 6.5, 3.25, 12
    smooth = smoothed(offset)
    assert smooth[8, 10] == smooth[8, 20] == 5
    assert smooth[14, 15] == 12


# ---- masks, ranges, sizes ----------------------------------------------------------------------------------


def test_pixels_without_content_are_neither_matched_nor_matched_to():
    scenery = random_image((90, 160))
    left_valid, right_valid = np.full((90, 160), 255, np.uint8), np.full((90, 160), 255, np.uint8)
    left_valid[20:40, 30:70] = 0
    right_valid[50:80, 60:100] = 0
    images = RectifiedImage(scenery.image, left_valid), RectifiedImage(scenery.image, right_valid)
    disparity = match_pair(*images, -15, 15, OPTIONS)
    assert np.isnan(disparity[20:40, 30:70]).all()
    # No match lies further than the sub-pixel fit's half pixel inside the hole.
    row, column = np.nonzero(~np.isnan(disparity))
    matched = column - disparity[row, column]
    inside = (row >= 50) & (row < 80) & (matched > 59.5) & (matched < 99.5)
    assert not inside.any()
    both = (left_valid > 0) & (right_valid > 0)
    assert (np.abs(disparity[both]) < 0.02).mean() > 0.95


def test_nothing_valid_gives_nothing():
    image = random_image((64, 64))
    empty = RectifiedImage(image.image, np.zeros_like(image.valid))
    for left, right in ((image, empty), (empty, image), (empty, empty)):
        assert np.isnan(match_pair(left, right, -10, 10, OPTIONS)).all()


@pytest.mark.parametrize("search", [(500, 600), (-600, -500), (2000, 5000)])
def test_a_range_beside_the_images_gives_nothing(search: tuple[float, float]):
    image = random_image((70, 90))
    assert np.isnan(match_pair(image, image, *search, OPTIONS)).all()


@pytest.mark.parametrize("seed", range(4))
def test_disparities_stay_within_the_range_and_the_images(seed):
    """Also where there is nothing to find: two unrelated images of odd sizes."""
    rng = np.random.default_rng(seed)
    height = rng.integers(16, 300)
    widths = rng.integers(16, 300, 2)
    low = rng.uniform(-100, 50)
    high = low + rng.uniform(1, 300)
    images = [random_image((height, width), seed + k) for k, width in enumerate(widths)]
    disparity = match_pair(images[0], images[1], low, high, replace(OPTIONS, min_segment=0))
    assert disparity.shape == (height, widths[0]) and disparity.dtype == np.float32
    found = ~np.isnan(disparity)
    # Ranges are rounded up to a multiple of 32 disparities.
    assert (disparity[found] >= low - 35).all() and (disparity[found] <= high + 3).all()
    column = (np.arange(widths[0]) - disparity)[found]
    assert (column >= -0.5).all() and (column <= widths[1] - 0.5).all()


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (5, 40), (16, 16), (33, 17), (257, 16)])
def test_small_images_are_survived(shape):
    image = random_image(shape)
    disparity = match_pair(image, image, -8, 8, OPTIONS)
    assert disparity.shape == shape
    assert not disparity[~np.isnan(disparity)].any()


def test_offsets_are_drawn_away_from_whole_pixels_that_they_are_locked_to():
    """Fractions of density 1 + 0.12 cos(2 pi f) become even; those of one surface stay."""
    fraction = (np.arange(100000) + 0.5) / 100000
    drawn = np.interp(fraction, fraction + 0.12 * np.sin(2 * np.pi * fraction) / (2 * np.pi), fraction)
    offset = np.round(256 * (drawn + np.arange(drawn.size) % 9 - 4)).astype(np.int32)[None]
    shifts = offsets.evening_shifts(offset)
    for values, uneven in ((drawn, (0.1, 0.15)), (offset[0] / 256 + shifts[offset[0] & 255], (0, 0.03))):
        shares = np.histogram(values % 1, bins=8, range=(0, 1))[0] / drawn.size * 8
        assert uneven[0] < np.abs(shares - 1).max() < uneven[1]
    # Drawn to anything but whole pixels, or by more than ever seen, they are the scene's.
    for scenes in (offset + 77, offset - 128, np.round(64 * np.cos(offset / 50)).astype(np.int32)):
        assert not offsets.evening_shifts(scenes).any()
    for one in (0, 77, 128, -1):
        same = np.array([[one, offsets.INVALID]], dtype=np.int32)
        assert offsets.evening_shifts(same)[one & 255] == 0
    assert not offsets.evening_shifts(np.full((2, 2), offsets.INVALID, np.int32)).any()


def test_the_excess_is_that_of_the_level(monkeypatch):
    limits = []
    match = _native.match

    def recorded(*arguments):
        limits.append((arguments[5].shape, arguments[11], arguments[12]))
        match(*arguments)

    monkeypatch.setattr(_native, "match", recorded)
    options = replace(
        OPTIONS, max_left_right_difference=3, max_left_right_excess=7, max_coarse_left_right_excess=91
    )
    image = random_image((300, 400))
    match_pair(image, image, -8, 8, options)
    assert limits == [((75, 100), 3, 91), ((150, 200), 3, 91), ((300, 400), 3, 7)]


@pytest.mark.parametrize("angle", [2.0, 5.0, 12.0])
def test_planes_of_few_disparities_are_not_made_worse(angle, monkeypatch):
    """Their fractions are uneven by themselves."""
    scene = syn.slanted_plane_pair(angle, focal_length=FOCAL, size=SIZE)
    error = [np.median(np.abs(Matched(scene, "frame").error))]
    monkeypatch.setattr(offsets, "evening_shifts", lambda _: np.zeros(256, np.float32))
    error.append(np.median(np.abs(Matched(scene, "frame").error)))
    assert error[0] < 1.03 * error[1]


def test_small_segments_are_removed():
    images = [random_image((120, 160), seed) for seed in (1, 2)]
    for least in (0, 30):
        disparity = match_pair(images[0], images[1], -15, 15, replace(OPTIONS, min_segment=least))
        labels, count = ndimage.label(~np.isnan(disparity))
        sizes = np.bincount(labels.ravel())[1:]
        assert count > 0 or least > 0
        assert (sizes >= least).all()
        if least == 0:
            assert (sizes < 30).any()


# ---- backends and options ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["convergent", "epipole inside"])
def test_the_result_does_not_depend_on_the_backend(name, monkeypatch):
    matched = matched_scene(name)
    for kernels in _native.backends():
        monkeypatch.setenv("COLMAP_SPH_KERNELS", kernels)
        assert backend() == kernels
        np.testing.assert_array_equal(matched.match(OPTIONS), matched.disparity)


def test_an_unknown_backend_is_refused(monkeypatch):
    monkeypatch.setenv("COLMAP_SPH_KERNELS", "altivec")
    with pytest.raises(OptionError, match="COLMAP_SPH_KERNELS=altivec"):
        backend()


@pytest.mark.parametrize(
    "wrong",
    [
        {"p1": -1},
        {"p1": 64, "p2_min": 64},
        {"p2": 128},
        {"p2": -1},
        {"p2_contrast": 0},
        *[{"disparities": value} for value in (0, 16, 33, 1056, -32)],
        *[{"coarse_disparities": value} for value in (0, 48)],
        {"max_coarsest_disparities": 100},
        {"range_radius": -1},
        {"range_radius": 51},
        {"max_left_right_difference": -1},
        {"max_left_right_difference": 101},
        {"max_left_right_excess": -1},
        {"max_left_right_excess": 256},
        {"max_coarse_left_right_excess": -1},
        {"max_coarse_left_right_excess": 256},
        {"min_segment": -1},
        {"max_slant": -1},
    ],
    ids=str,
)
def test_options_out_of_bounds_are_refused(wrong):
    OPTIONS.check()
    assert_refused(MatchingOptions(**wrong), next(iter(wrong)))


@pytest.mark.parametrize("wrong", [{"p1": 31, "p2_min": 30}, {"p2_min": 130, "p2": 120}, {"p2_min": -1}], ids=str)
def test_penalties_out_of_order_are_refused(wrong):
    assert_refused(MatchingOptions(**wrong), "p2_min", "p1", "p2")


@pytest.mark.parametrize("most", [20, 300])
def test_scratch_memory_is_what_a_plan_says(most):
    """Of a short range and of one that takes a pyramid of many levels; what is compared takes the rest."""
    image = whole(np.random.default_rng(0).integers(0, 255, (320, 480)))
    scratches = Scratches()
    match_pair(image, image, 0, most, MatchingOptions(), scratches)
    (scratch,) = scratches._free
    planned = pair_scratch_bytes(320 * 480, MatchingOptions())
    assert scratch._memory.size == pytest.approx(planned - 48 * 320 * 480, rel=0.1)


@pytest.mark.parametrize("fine", [False, True])
def test_memory_is_what_a_plan_says(fine):
    """Of arrays, beside the scratch memory; the rest of what a plan takes is for OpenCV's own."""
    shape = (960, 640)
    scratches = Scratches(max_bytes=scratch_bytes(48 * shape[1], OPTIONS.disparities))
    tracemalloc.start()
    match_pair(random_image(shape), random_image(shape, 1), -200, 200, OPTIONS, scratches, fine=fine)
    peak = tracemalloc.get_traced_memory()[1] - scratches.max_bytes
    tracemalloc.stop()
    assert 0.7 * _MATCH_BYTES < peak / (shape[0] * shape[1]) < 0.95 * _MATCH_BYTES


@pytest.mark.parametrize("threads", [0, 3])
@pytest.mark.parametrize("seeds", [None, np.array([[60, 90, 5], [250, 200, 20]], np.float32)], ids=["", "seeds"])
def test_bands_of_rows_give_what_one_piece_gives(threads, seeds):
    """To the bit, also where idle threads help, of a surface with a slope and a step, whose prediction tears."""
    size = (230, 330)
    columns, rows = np.meshgrid(np.arange(330, dtype=np.float32), np.arange(230, dtype=np.float32))
    texture = cv2.GaussianBlur(np.random.default_rng(3).uniform(0, 255, (230, 420)).astype(np.float32), (0, 0), 1)
    step = np.float32(12) * (columns > 160)
    seen = 20 + np.float32(1.1) * columns + 4 * np.sin(rows / 30) + step
    images = whole(texture[:, 20:350]), whole(cv2.remap(texture, seen, rows, cv2.INTER_LINEAR))
    found = match_pair(*images, -10, 60, MatchingOptions(), seeds=seeds, fine=True)
    assert found.shape == size and np.isfinite(found).mean() > 0.7
    for most in (0, 3 << 20):
        with lending(threads):
            banded = match_pair(*images, -10, 60, MatchingOptions(), Scratches(most), seeds=seeds, fine=True)
        np.testing.assert_array_equal(banded, found)
