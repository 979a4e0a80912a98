"""What a level's left image is compared with: warped, as it is at edges, and from two starts."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage

from colmap_sph.stereo.census import CENSUS_INVALID, RectifiedImage, census
from colmap_sph.stereo.matching import MatchingOptions, match_pair
from colmap_sph.stereo.search import prediction as prediction_module
from colmap_sph.stereo.search.offsets import INVALID, SUBPIXEL
from colmap_sph.stereo.search.prediction import Prediction, torn_by
from colmap_sph.stereo.search.target import Matches, Target, TargetRoom, make_target


def predicted(offset: np.ndarray, base: np.ndarray | int = -16) -> Prediction:
    """Predictions in pixels."""
    steps = np.round(np.ascontiguousarray(offset, dtype=float) * SUBPIXEL).astype(np.int32)
    return Prediction(steps, np.broadcast_to(np.int32(base), steps.shape).copy(), 32)


def unwarped(base: np.ndarray | int, shape: tuple[int, int]) -> Prediction:
    zero = np.zeros(shape, np.int32)
    return Prediction(zero, np.broadcast_to(np.int32(base), shape).copy(), 32, warps=False)


def torn_of(prediction: Prediction) -> np.ndarray:
    assert prediction.torn is not None
    return prediction.torn


def with_tears(warped: Prediction, other: Prediction) -> Prediction:
    torn = torn_by(warped.offset)
    if not torn.any():
        return warped
    return replace(warped, base=np.where(torn, other.base, warped.base), torn=torn)


# ---- tears -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("step", "torn"), [(2.9, False), (3.1, True), (-40, True)])
def test_a_step_tears_the_windows_around_it(step: float, torn: bool, axis: int) -> None:
    """Those within a window of either side of it: pixels 14 to 23 of a step between 18 and 19, and no other."""
    offset = np.zeros((40, 40))
    offset[:, 19:] = step
    prediction = predicted(offset.T if axis == 0 else offset)
    result = with_tears(prediction, unwarped(7, (40, 40)))
    if not torn:
        assert result is prediction
        return
    expected = np.zeros((40, 40), bool)
    expected[:, 14:24] = True
    found = torn_of(result)
    np.testing.assert_array_equal(found, expected.T if axis == 0 else expected)
    np.testing.assert_array_equal(result.base, np.where(found, 7, -16))
    first = np.where(found, 7, np.floor(prediction.offset / SUBPIXEL + 0.5) - 16)
    np.testing.assert_array_equal(result.first, first)


def test_a_slope_tears_nothing() -> None:
    prediction = predicted(np.broadcast_to(2.5 * np.arange(60), (20, 60)))
    assert with_tears(prediction, unwarped(0, (20, 60))).torn is None


# ---- targets -----------------------------------------------------------------------------------------------


def noise(shape: tuple[int, int], seed: int = 0) -> RectifiedImage:
    image = np.random.default_rng(seed).uniform(0, 255, shape).astype(np.float32)
    return RectifiedImage(image, np.full(shape, 255, np.uint8))


def torn_target(base: int) -> tuple[RectifiedImage, Target]:
    right = noise((20, 50))
    offset = np.zeros((20, 40))
    offset[:, 20:] = 9
    return right, make_target(right, with_tears(predicted(offset), unwarped(base, offset.shape)))


@pytest.mark.parametrize("max_bytes", [0, 1 << 20])
def test_a_target_is_the_same_where_others_were(max_bytes: int) -> None:
    room = TargetRoom(max_bytes)
    for base in (3, -20):
        right, target = torn_target(base)
        again = make_target(right, target.prediction, room)
        np.testing.assert_array_equal(again.census, target.census)
        np.testing.assert_array_equal(again.columns, target.columns)
        last = make_target(right, target.prediction, room)
        assert np.shares_memory(last.census, again.census) == (max_bytes > 0)


@pytest.mark.parametrize("base", [-20, 3, 30])
def test_torn_pixels_search_the_right_image_as_it_is(base: int) -> None:
    """Slot by slot: the census and the column of the right image's pixel, or nothing outside of it."""
    right, target = torn_target(base)
    words = census(right)
    torn = np.argwhere(torn_of(target.prediction))
    assert len(torn)
    for y, x in torn:
        for slot in range(32):
            column = x + base + slot
            place = x + target.base[y, x] + slot
            inside = place < target.census.shape[1]
            if 0 <= column < 50:
                assert target.census[y, place] == words[y, column]
                assert target.columns[y, place] == column
            else:
                assert not inside or target.census[y, place] & CENSUS_INVALID


def test_windows_far_outside_see_nothing() -> None:
    _, target = torn_target(-500)
    y, x = np.argwhere(torn_of(target.prediction)).T
    for slot in range(32):
        assert (target.census[y, x + target.base[y, x] + slot] & CENSUS_INVALID).all()


def test_matches_of_torn_pixels_lead_back_to_the_right_image() -> None:
    _, target = torn_target(-3)
    torn = torn_of(target.prediction)
    offset = np.full(torn.shape, INVALID, np.int32)
    offset[:10] = (target.base[:10] + 5) * SUBPIXEL + 77
    real = target.offsets_to_right(offset)
    np.testing.assert_array_equal(real[:10][torn[:10]], (-3 + 5) * SUBPIXEL + 77)
    assert (real[10:] == INVALID).all()


def test_the_better_match_is_where_windows_differ_less() -> None:
    """Two predictions of an image of two halves, each right on one of them."""
    right = noise((24, 60))
    left = RectifiedImage(right.image[:, 10:50].copy(), np.full((24, 40), 255, np.uint8))
    left.image[:, 20:] = right.image[:, 36:56]
    found = []
    for offset in (10, 16):
        target = make_target(right, unwarped(0, (24, 40)))
        found.append(Matches(target, census(left), np.full((24, 40), offset * SUBPIXEL, np.int32)))
    best = found[0].or_better(found[1]) / SUBPIXEL
    assert (best[:, 2:15] == 10).all()
    assert (best[:, 25:-2] == 16).all()
    assert (found[0].or_better(found[0]) == 10 * SUBPIXEL).all()


# ---- an object on a slope ----------------------------------------------------------------------------------


def texture(shape: tuple[int, int], seed: int) -> np.ndarray:
    white = np.random.default_rng(seed).normal(size=shape)
    mixed = sum(side * ndimage.gaussian_filter(white, side) for side in (1, 2))
    return (255 * (mixed - mixed.min()) / np.ptp(mixed)).astype(np.float32)


class SlopeWithObject:
    """A slope of disparities and, in its middle, a square parallel to the images before it."""

    SIDE = 60

    def __init__(self, slope: float, before: float) -> None:
        shape = (240, 400)
        self.y, self.x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
        ground = slope * (self.x - 200)
        self.is_object = self._inside(self.y, self.x)
        self.disparity = np.where(self.is_object, before, ground)
        surface, own = texture((240, 900), 0), texture(shape, 1)
        # The right image's column 0 is its column 250 here.
        left = cv2.remap(surface, self.x - ground + 250, self.y, cv2.INTER_CUBIC)
        y, x = np.mgrid[:240, :900].astype(np.float32)
        x += before - 250
        right = np.where(self._inside(y, x), cv2.remap(own, x, y, cv2.INTER_CUBIC), surface)
        self.left = self._whole(np.where(self.is_object, own, left))
        self.right = self._whole(right)
        rng = np.random.default_rng(5)
        rows, columns = rng.integers(0, 240, 300), rng.integers(0, 400, 300)
        ground_points = ~self.is_object[rows, columns]
        self.seeds = np.column_stack([columns, rows, self.disparity[rows, columns] - 250])[ground_points]

    def _inside(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.maximum(abs(y - 120), abs(x - 200)) < self.SIDE / 2

    @staticmethod
    def _whole(image: np.ndarray) -> RectifiedImage:
        return RectifiedImage(image.astype(np.float32), np.full(image.shape, 255, np.uint8))

    def right_share(self, where: np.ndarray, seeds: np.ndarray | None) -> float:
        exact = self.disparity - 250
        matched = match_pair(
            self.left,
            self.right,
            float(exact.min()) - 20,
            float(exact.max()) + 20,
            MatchingOptions(),
            seeds=None if seeds is None else seeds.astype(np.float32),
        )
        return float((np.abs(matched - exact) < 1)[where].mean())


@pytest.mark.parametrize("before", [20, 60])
def test_an_object_without_a_seed_is_found(before: float) -> None:
    """Seeds of the slope alone predict that it goes on: windows of the object are stretched then."""
    scene = SlopeWithObject(-0.5, before)
    assert scene.right_share(scene.is_object, scene.seeds) > 0.95
    assert scene.right_share(scene.is_object, None) > 0.95


def test_edges_on_a_slope_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """More of what lies within 8 pixels of them than where windows are torn apart."""
    scene = SlopeWithObject(-0.5, 20)
    near = ndimage.binary_dilation(scene.is_object, iterations=8)
    near &= ~ndimage.binary_erosion(scene.is_object, iterations=8)
    right = scene.right_share(near, None)
    monkeypatch.setattr(prediction_module, "torn_by", lambda offset: np.zeros(offset.shape, bool))
    assert right > scene.right_share(near, None) + 0.03
