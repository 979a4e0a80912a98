"""Seeds of matching: where points lie in a pair, what is predicted between them, and which image is left."""

from dataclasses import replace

import numpy as np
import pytest
from rendered import disparities, scene_of_pair

from colmap_sph import synthetic as syn
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import RectifiedPair, Surface
from colmap_sph.stereo.search import seeds
from colmap_sph.stereo.search.seeds import finer_first, interpolated_disparity, seeds_of_points, shared_points

# ---- between seeds -----------------------------------------------------------------------------------------


def random_seeds(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((0, 0, -40), (120, 90, 60), (count, 3))


@pytest.mark.parametrize("count", [1, 2, 3, 12, 200])
@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_equal_seeds_say_the_same_everywhere(count: int, scale: float) -> None:
    given = random_seeds(count)
    given[:, 2] = -12.5
    disparity = interpolated_disparity(given, (20, 31), scale)
    assert disparity.dtype == np.float32
    np.testing.assert_allclose(disparity, np.full((20, 31), -12.5 / scale), rtol=1e-5)


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_a_plane_is_continued_by_as_much_as_slopes_are_free(scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exactly where nothing holds them back. Pixel 0 of a level of scale 4 has its centre at 1.5."""
    given = random_seeds(200)
    given[:, 2] = 7 + 0.25 * given[:, 0] - 0.125 * given[:, 1]
    columns, rows = ((np.arange(size) + 0.5) * scale - 0.5 for size in (31, 23))
    exact = (7 + 0.25 * columns - 0.125 * rows[:, None]) / scale
    error = np.abs(interpolated_disparity(given, (23, 31), scale) - exact) * scale
    assert np.median(error) < 0.15
    monkeypatch.setattr(seeds, "_STIFFNESS", 0.0)
    np.testing.assert_allclose(interpolated_disparity(given, (23, 31), scale), exact, atol=1e-3)


@pytest.mark.parametrize("count", [1, 2, 5, 60])
def test_planes_between_seeds_are_those_of_weighted_least_squares(count: int) -> None:
    """Pixel by pixel: the nearest seeds, weighed by distance, and one more row for each slope, which is none."""
    given = random_seeds(count, seed=3)
    scale = 4.0
    disparity = interpolated_disparity(given, (9, 13), scale)
    places = (given[:, :2] + 0.5) / scale - 0.5
    for row, column in np.ndindex(9, 13):
        step = places - (column, row)
        near = np.argsort(np.hypot(*step.T), kind="stable")[: seeds._NEIGHBOURS]
        weight = 1 / ((step[near] ** 2).sum(axis=1) + seeds._ALIKE**2)
        root = np.sqrt(weight)[:, None]
        held = np.sqrt(seeds._STIFFNESS * weight.sum())
        rows = np.vstack([root * np.column_stack([np.ones(len(near)), step[near]]), [0, held, 0], [0, 0, held]])
        values = np.concatenate([root[:, 0] * given[near, 2] / scale, [0, 0]])
        assert disparity[row, column] == pytest.approx(np.linalg.lstsq(rows, values)[0][0], abs=1e-4)


# ---- seeds of points ---------------------------------------------------------------------------------------

PAIRS = {
    "convergent": syn.convergent_pair(10.0, focal_length=300.0, size=(240, 180)),
    "forward": syn.forward_motion_pair(1.0, focal_length=240.0, size=(240, 180)),
}


def rectified(name: str, surface: Surface) -> tuple[Scene, View, View, RectifiedPair]:
    scene, left, right = scene_of_pair(PAIRS[name])
    return scene, left, right, rectify_pair(scene, left, right, RectificationOptions(surface=surface))


@pytest.mark.parametrize(
    ("name", "surface"), [("convergent", "spherical"), ("convergent", "frame"), ("forward", "spherical")]
)
def test_seeds_lie_where_the_points_are_seen(name: str, surface: Surface) -> None:
    """Those that both images show, in their order, to a quarter of a pixel."""
    scene, left, right, pair = rectified(name, surface)
    points = shared_points(scene, left, right)
    disparity, columns, rows = disparities(pair, left, right, points)
    exact = np.column_stack([columns, rows, disparity])
    right_columns = columns - disparity
    places = [columns, rows, right_columns]
    sizes = [pair.left_width, pair.height, pair.right_width]
    room = [np.minimum(place, size - 1 - place) for place, size in zip(places, sizes, strict=True)]
    least = np.min(room, axis=0)
    assert np.abs(least).min() > 1e-6  # none on the border, where rounding would decide
    found = seeds_of_points(left, right, pair, points)
    assert len(found) > 100
    np.testing.assert_array_equal(found * 4, np.round(found * 4))
    assert np.abs(found - exact[least >= 0]).max() <= 0.125 + 1e-9


def test_points_behind_the_cameras_are_no_seeds() -> None:
    """On the plane they have places all the same, those of the points mirrored in the camera."""
    scene, left, right, pair = rectified("convergent", "frame")
    points = shared_points(scene, left, right)
    assert len(seeds_of_points(left, right, pair, points))
    mirrored = 2 * (left.center + right.center) / 2 - points
    assert not len(seeds_of_points(left, right, pair, mirrored))
    assert seeds_of_points(left, right, pair, np.zeros((0, 3))).shape == (0, 3)


# ---- which image is left -----------------------------------------------------------------------------------


def view(name: str, focal: float, distance: float, indices: list[int]) -> View:
    """A camera that looks along z, so far before the plane z = 0."""
    K = np.array([[focal, 0, 50], [0, focal, 50], [0, 0, 1.0]])
    return View(ord(name), name, 100, 100, K, np.eye(3), np.array([0, 0, distance]), np.array(indices))


def order(*views: View) -> str:
    points = np.zeros((10, 3))
    return "".join(one.name for one in finer_first(Scene(views, points), *views))


def test_shared_points_are_those_that_both_observe() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (10, 3))
    first, second = view("a", 100, 5, [1, 4, 7, 9]), view("b", 100, 5, [0, 4, 9])
    np.testing.assert_array_equal(shared_points(Scene((first, second), points), first, second), points[[4, 9]])


def test_the_finer_image_is_first() -> None:
    """The nearer one, or that of the longer lens: pixels of focal length over distance."""
    everything = list(range(10))
    for focal, distance in ((100, 4), (130, 5), (200, 9)):
        near, far = view("b", focal, distance, everything), view("a", 100, 5, everything)
        assert order(far, near) == order(near, far) == "ba"


@pytest.mark.parametrize(("focal", "expected"), [(99, "ab"), (100, "ab"), (101, "ab"), (104, "ba"), (96, "ab")])
def test_near_a_tie_the_order_stays(focal: float, expected: str) -> None:
    everything = list(range(10))
    assert order(view("a", 100, 5, everything), view("b", focal, 5, everything)) == expected


def test_without_shared_points_the_order_stays() -> None:
    assert order(view("a", 100, 5, [1, 2]), view("b", 900, 5, [3])) == "ab"


def test_half_of_the_points_decide() -> None:
    """Two views side by side: of nine points, those near the second one are few, or most."""
    first = view("a", 100, 5, list(range(9)))
    second = replace(view("b", 100, 5, list(range(9))), t=np.array([-20.0, 0, 5]))
    for at_second, expected in ((3, "ab"), (6, "ba")):
        points = np.zeros((9, 3))
        points[:at_second, 0] = 20
        views = finer_first(Scene((first, second), points), first, second)
        assert "".join(one.name for one in views) == expected
