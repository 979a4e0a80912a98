"""Images of unlike brightness: made alike, and matched all the same."""

import numpy as np
import pytest
from rendered import whole
from scipy import ndimage

from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.matching import MatchingOptions, match_pair
from colmap_sph.stereo.search.brightness import equally_bright
from colmap_sph.stereo.search.offsets import INVALID, SUBPIXEL

SHAPE = (240, 320)
OFFSET = -12


def texture(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    values = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(shape), 1.0)
    return np.asarray(120 + 100 * values)


def shifted_pair() -> tuple[np.ndarray, np.ndarray]:
    scenery = texture((SHAPE[0], SHAPE[1] - OFFSET))
    return scenery[:, : SHAPE[1]], scenery[:, -OFFSET:]


def coarser_offset(shape: tuple[int, int] = (120, 160)) -> np.ndarray:
    return np.full(shape, OFFSET * SUBPIXEL // 2, np.int32)


def brightness(kind: str) -> np.ndarray:
    """By how much the left image is brighter, grey values."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    kinds = {"alike": 0 * x, "brighter": 0 * x + 20, "slope": x / 10 - y / 20, "bowl": 30 - (x - 160) ** 2 / 2500}
    return np.asarray(kinds[kind], dtype=float)


@pytest.mark.parametrize("kind", ["alike", "brighter", "slope", "bowl"])
@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_the_left_image_becomes_as_bright_as_the_right_one(kind: str, wrong: float) -> None:
    """Whatever it is that some matches are wrong, and others missing."""
    rng = np.random.default_rng(1)
    left, right = shifted_pair()
    offset = coarser_offset()
    offset[rng.random(offset.shape) < wrong] = 30 * SUBPIXEL
    offset[rng.random(offset.shape) < 0.2] = INVALID
    even, step = equally_bright(whole(left + brightness(kind)), whole(right), offset)
    # Away from the border, where means are of one side.
    inner = np.s_[70:-70, 70:-70]
    assert np.abs(even.image - left)[inner].max() < (0.01 if kind == "alike" and not wrong else 2.5)
    assert np.abs(even.image - left)[inner].mean() < 0.8
    assert step == 1 if kind in ("alike", "brighter") else step < 1.6


@pytest.mark.parametrize("sigma", [0.5, 4.0, 10.0])
def test_steps_are_as_large_as_the_images_differ(sigma: float) -> None:
    """.7 of the median difference, which for normal noise in both images is .67 times √2 of its deviation."""
    rng = np.random.default_rng(2)
    left, right = (image + sigma * rng.standard_normal(SHAPE) for image in shifted_pair())
    step = equally_bright(whole(left), whole(right), coarser_offset())[1]
    assert step == pytest.approx(max(0.7 * 0.6745 * np.sqrt(2) * sigma, 1), rel=0.1)


@pytest.mark.parametrize("size", [(1, 1), (2, 7), (9, 8), (33, 40)])
def test_without_matches_grey_values_are_not_compared(size: tuple[int, int]) -> None:
    image = whole(texture(size))
    shape = (size[0] + 1) // 2, (size[1] + 1) // 2
    for offset in (INVALID, 10**6):
        even, step = equally_bright(image, image, np.full(shape, offset, np.int32))
        np.testing.assert_array_equal(even.image, image.image)
        assert step == 0
    even, step = equally_bright(image, image, np.zeros(shape, np.int32))
    np.testing.assert_array_equal(even.image, image.image)
    assert step == 1
    hidden = RectifiedImage(image.image, np.zeros(size, np.uint8))
    assert equally_bright(image, hidden, np.zeros(shape, np.int32))[0] is image


@pytest.mark.parametrize("fine", [False, True])
@pytest.mark.parametrize("kind", ["brighter", "slope", "bowl"])
def test_images_of_unlike_brightness_are_matched(kind: str, fine: bool) -> None:
    left, right = shifted_pair()
    images = whole(left + brightness(kind)), whole(0.9 * right)
    disparity = match_pair(*images, -30, 40, MatchingOptions(max_coarsest_disparities=32), fine=fine)
    inner = disparity[10:-10, 20:-20]
    assert (np.abs(inner - -OFFSET) < 0.25).mean() > 0.99
