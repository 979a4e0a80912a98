"""Seeds of matching: where points lie in a pair, what is predicted between them, and which image is left."""

from dataclasses import replace

import numpy as np
import oracle
import pytest
from rendered import disparities, scene_of_pair

from colmap_sph import _native
from colmap_sph import synthetic as syn
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import RectifiedPair, Surface
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


def full_of_seeds(plane: tuple[float, float, float]) -> np.ndarray:
    """Seeds at random over and beyond an image of 120 x 90 pixels, on a plane of disparities."""
    places = np.random.default_rng(0).uniform(-40, 160, (1500, 2))
    return np.column_stack([places, plane[0] + places @ plane[1:]])


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_a_plane_full_of_seeds_is_found(scale: float) -> None:
    """In pixels of the level, of which that of column 0 has its centre at column 1.5 where the scale is 4."""
    plane = 7.0, 0.25, -0.125
    shape = int(90 / scale), int(120 / scale)
    columns, rows = ((np.arange(size) + 0.5) * scale - 0.5 for size in shape[::-1])
    exact = (plane[0] + plane[1] * columns + plane[2] * rows[:, None]) / scale
    error = interpolated_disparity(full_of_seeds(plane), shape, scale) - exact
    assert np.abs(error).max() < 1.0 / scale
    assert abs(error.mean()) < 0.02


def test_a_level_is_an_image_of_its_own() -> None:
    """Seeds of full resolution in pixels of four times the size are those of a smaller image."""
    seeds = random_seeds(60)
    smaller = np.column_stack([(seeds[:, :2] + 0.5) / 4 - 0.5, seeds[:, 2] / 4])
    np.testing.assert_allclose(
        interpolated_disparity(seeds, (23, 31), 4.0), interpolated_disparity(smaller, (23, 31), 1.0), rtol=1e-4
    )


def test_rows_and_columns_are_alike_and_order_is_nothing() -> None:
    seeds = random_seeds(60)
    disparity = interpolated_disparity(seeds, (23, 31), 4.0)
    turned = interpolated_disparity(seeds[::-1][:, [1, 0, 2]], (31, 23), 4.0)
    np.testing.assert_allclose(turned.T, disparity, atol=1e-4)


def test_disparities_add_up() -> None:
    seeds, others = random_seeds(60), random_seeds(60)
    others[:, 2] = 5 + np.arange(60)
    both = seeds + others * (0, 0, 1)
    parts = [interpolated_disparity(given, (23, 31), 4.0) for given in (seeds, others)]
    np.testing.assert_allclose(interpolated_disparity(both, (23, 31), 4.0), sum(parts), atol=1e-4)


@pytest.mark.parametrize("neighbours", [1, 3, 12, 32])
@pytest.mark.parametrize("count", [1, 5, 64, 200])
def test_planes_of_seeds_are_the_oracles(neighbours: int, count: int) -> None:
    seeds = random_seeds(count)
    seeds[count // 2 :, :2] = np.round(seeds[count // 2 :, :2] / 8) * 8  # some are as near as others
    planes = np.empty((9, 13), np.float32)
    weights = (neighbours, 7.5, 0.125, 0.1)
    columns, rows, values = np.ascontiguousarray(seeds.T)
    _native.seed_planes(columns, rows, values, *weights, 10, planes)
    np.testing.assert_allclose(planes, oracle.seed_planes(seeds, *weights, 10, planes.shape), rtol=1e-5, atol=1e-4)


def test_seeds_out_of_this_world_harm_nobody() -> None:
    planes = np.empty((9, 13), np.float32)
    for value in (np.nan, np.inf, 1e300):
        columns, rows, values = np.full((3, 5), value)
        _native.seed_planes(columns, rows, values, 12, 7.5, 0.125, 0.1, 10, planes)


def test_near_seeds_count_more_than_far_ones() -> None:
    """Two groups, far from each other: each side of the image has its own group's disparity, the middle none's."""
    rng = np.random.default_rng(0)
    places = np.concatenate([rng.uniform((0, 0), (10, 90), (40, 2)), rng.uniform((110, 0), (120, 90), (40, 2))])
    seeds = np.column_stack([places, np.repeat([-20.0, 60.0], 40)])
    disparity = interpolated_disparity(seeds, (90, 120), 1.0)
    assert np.abs(disparity[10:-10, :10] + 20).max() < 2
    assert np.abs(disparity[10:-10, -10:] - 60).max() < 2


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
    seen = exact[least >= 0]
    # 256 of them, from the first to the last.
    assert len(found) == min(len(seen), 256)
    kept = np.linspace(0, len(seen) - 1, len(found)).astype(int)
    assert np.abs(found - seen[kept]).max() <= 0.125 + 1e-9


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
    return "".join(one.name for one in finer_first(shared_points(Scene(views, points), *views), *views))


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
        shared = shared_points(Scene((first, second), points), first, second)
        views = finer_first(shared, first, second)
        assert "".join(one.name for one in views) == expected
