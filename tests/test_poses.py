"""Tracks of ties, and what they say of poses, on exact projections of known points."""

from dataclasses import replace

import numpy as np
import pytest
from rendered import SIDES, array_coordinates, pixel_rays

from colmap_sph.scene import Scene, View
from colmap_sph.stereo.poses.quality import (
    Judgement,
    common_bends,
    judged,
    movements,
    refusal,
    sound_tracks,
    usual_error,
)
from colmap_sph.stereo.poses.tracks import (
    ImageTies,
    Tracks,
    parallax_angles,
    thickness,
    track_errors,
    tracks_of_ties,
    triangulated,
    views_together,
)
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import Float, Surface, image_coordinates

WIDTH, HEIGHT, FOCAL = 400, 300, 500.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
NUM_VIEWS = 8


def look_down(number: int, turn: Float | None = None) -> View:
    """A camera of a strip, 1 unit from the next, that looks along z; `turn` are angles about its axes."""
    R = np.eye(3) if turn is None else rotation(turn)
    center = np.array([number, 0.3 * (number % 2), 0.1 * (number % 3)])
    return View(number + 1, f"{number:02}.jpg", WIDTH, HEIGHT, K, R, -R @ center, np.arange(0))


def rotation(vector: Float) -> Float:
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-300)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def make_points(number: int = 900, *, relief: float = 3.0) -> Float:
    rng = np.random.default_rng(1)
    return rng.uniform([-3, -3, 10 - relief], [NUM_VIEWS + 3, 3, 10 + relief], (number, 3))


def make_scene(points: Float | None = None, turns: Float | None = None) -> Scene:
    turns = np.zeros((NUM_VIEWS, 3)) if turns is None else turns
    points = make_points() if points is None else points
    views = [look_down(number, turn) for number, turn in enumerate(turns)]
    inside = [in_image(view.project(points)[0]) for view in views]
    views = [
        replace(view, point_indices=np.flatnonzero(seen), reprojection_error=0.5)
        for view, seen in zip(views, inside, strict=True)
    ]
    return Scene(tuple(views), points)


def in_image(pixels: Float) -> np.ndarray:
    return np.asarray(((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1))


def make_tracks(scene: Scene, noise: float = 0.0) -> Tracks:
    """Exact observations of the points, each in all views that have it in view, if that are two or more."""
    rng = np.random.default_rng(2)
    seen = np.stack([in_image(view.project(scene.points)[0]) for view in scene.views], axis=1)
    seen = seen[kept := seen.sum(axis=1) >= 2]
    points = scene.points[kept]
    track, view = np.nonzero(seen)
    pixels = np.stack([scene.views[v].project(points[[t]])[0][0] for t, v in zip(track, view, strict=True)])
    return Tracks(track, view, pixels + rng.normal(0, noise, pixels.shape))


def small_turns(pixels: float) -> Float:
    return np.random.default_rng(4).normal(0, pixels / FOCAL, (NUM_VIEWS, 3))


@pytest.mark.parametrize("surface", ["spherical", "frame"])
def test_places_on_either_surface_are_where_the_image_shows_them(surface: Surface) -> None:
    scene = make_scene(turns=small_turns(20))
    left, right = scene.views[2:4]
    pair = rectify_pair(scene, left, right, RectificationOptions(surface=surface))
    rng = np.random.default_rng(0)
    pixels = rng.uniform([50, 50], [350, 250], (20, 2))
    for side, view in zip(SIDES, (left, right), strict=True):
        places = np.column_stack(array_coordinates(pair, side, pixel_rays(view, *pixels.T)))
        np.testing.assert_allclose(image_coordinates(view, pair, side, places), pixels, atol=1e-6)


def test_ties_at_one_corner_are_one_track() -> None:
    """Corner (10.5, 20.5) of a in b and c; (30.5, 20.5) in c alone; b's own corner in c."""
    ties = {
        ("a", "b"): ImageTies(np.array([[10.5003, 20.4998]]), np.array([[1.0, 1]])),
        ("a", "c"): ImageTies(np.array([[30.5, 20.5], [10.4999, 20.5]]), np.array([[2.0, 2], [3, 3]])),
        ("b", "c"): ImageTies(np.array([[10.5, 20.5]]), np.array([[4.0, 4]])),
    }
    tracks = tracks_of_ties(ties, {"a": 0, "b": 1, "c": 2})
    found = {
        tuple(zip(tracks.view[tracks.track == k], np.floor(tracks.pixels[tracks.track == k, 0]), strict=True))
        for k in range(len(tracks))
    }
    assert found == {((0, 10), (1, 1), (2, 3)), ((0, 30), (2, 2)), ((1, 10), (2, 4))}


def test_exact_rays_meet_in_their_point() -> None:
    scene = make_scene(turns=small_turns(30))
    tracks = make_tracks(scene)
    points = triangulated(tracks, scene.views)
    distance = np.min(np.linalg.norm(points[:, None] - scene.points[None], axis=2), axis=1)
    assert distance.max() < 1e-6
    assert track_errors(tracks, points, scene.views).max() < 1e-6


def test_errors_of_tracks_are_the_noise_of_their_pixels() -> None:
    """Per degree of freedom, whatever the length of the track."""
    scene = make_scene(make_points(4000))
    tracks = make_tracks(scene, noise=0.3)
    errors = track_errors(tracks, triangulated(tracks, scene.views), scene.views)
    length = np.bincount(tracks.track)
    for number in (2, 4):
        assert np.sqrt(np.mean(errors[length == number] ** 2)) == pytest.approx(0.3, rel=0.1)


def test_parallax_is_the_angle_at_the_point() -> None:
    scene = make_scene()
    point = np.array([[0.0, 0, 10]])
    tracks = Tracks(np.zeros(2, np.int64), np.array([0, 1]), np.zeros((2, 2)))
    a, b = (scene.views[k].center - point[0] for k in (0, 1))
    angle = np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
    assert parallax_angles(tracks, point, scene.views)[0] == pytest.approx(angle)


def test_points_at_infinity_and_mismatches_are_dropped() -> None:
    far = make_points(60)
    far[:, 2] *= 100
    far[:, :2] *= 20
    scene = make_scene(np.concatenate([make_points(), far]))
    tracks = make_tracks(scene, noise=0.1)
    wrong = tracks.track % 50 == 0
    pixels = tracks.pixels + np.where(wrong[:, None], np.random.default_rng(0).normal(0, 30, (len(wrong), 2)), 0)
    kept = sound_tracks(Tracks(tracks.track, tracks.view, pixels), scene)
    points = triangulated(kept, scene.views)
    assert points[:, 2].max() < 20
    assert track_errors(kept, points, scene.views).max() < 2
    assert len(kept) > 0.9 * (triangulated(tracks, scene.views)[:, 2] < 20).sum() * 0.98


def test_views_hang_together_by_ties() -> None:
    scene = make_scene()
    tracks = make_tracks(scene)
    assert views_together(tracks, NUM_VIEWS, 5).all()
    # No track goes from the first three to the others.
    first = tracks.view[np.searchsorted(tracks.track, np.arange(len(tracks)))][tracks.track] < 3
    apart = Tracks(tracks.track, tracks.view, tracks.pixels)
    crossing = np.bincount(tracks.track[(tracks.view >= 3) == first], minlength=len(tracks)) > 0
    together = views_together(apart.only(~crossing), NUM_VIEWS, 5)
    assert together.tolist() == [False] * 3 + [True] * 5


def test_thickness_of_a_plane_is_none() -> None:
    rng = np.random.default_rng(0)
    plane = rng.uniform(-1, 1, (200, 2)) @ rng.normal(size=(2, 3))
    assert thickness(plane) < 1e-12
    assert thickness(rng.normal(size=(5000, 3))) == pytest.approx(1, abs=0.1)


def test_good_poses_are_not_touched() -> None:
    scene = make_scene()
    assert "good already" in refusal(make_tracks(scene, noise=0.05), scene, 0.15)


def test_disturbed_poses_are_worth_polishing() -> None:
    scene = make_scene()
    turned = make_scene(turns=small_turns(1.0))
    assert refusal(make_tracks(scene, noise=0.05), turned, 0.15) == ""


def test_few_ties_are_told() -> None:
    scene = make_scene(turns=small_turns(1.0))
    tracks = make_tracks(make_scene())
    assert "too few ties" in refusal(tracks.only(np.arange(len(tracks)) < 50), scene, 0.15)


def test_ties_that_fall_apart_are_told() -> None:
    scene = make_scene(make_points(4000))
    tracks = make_tracks(scene)
    early = np.bincount(tracks.track[tracks.view < 3], minlength=len(tracks)) > 0
    late = np.bincount(tracks.track[tracks.view >= 3], minlength=len(tracks)) > 0
    assert "only 5 of the 8" in refusal(tracks.only(~(early & late)), scene, 0.15)


def test_a_plane_is_told() -> None:
    points = make_points(relief=0.0)
    true, turned = make_scene(points), make_scene(points, small_turns(1.0))
    tracks = make_tracks(true, noise=0.1)
    assert "one plane" in judged(tracks, turned, true).refusal(0.05)
    # The sparse points hold what ties leave open.
    held = replace(true, points=np.concatenate([points, make_points(200)]))
    assert judged(tracks, turned, held).refusal(0.05) == ""


def test_sparse_points_far_from_their_observations_are_told() -> None:
    scene = make_scene(turns=small_turns(1.0))
    broken = replace(scene, views=tuple(replace(view, reprojection_error=5.0) for view in scene.views))
    assert "5.0 px" in refusal(make_tracks(make_scene()), broken, 0.15)


def test_the_usual_error_is_that_of_the_less_precise_tracks() -> None:
    """Ties of exact poses miss by their noise; sparse points by what the views say, half a pixel."""
    scene = make_scene()
    assert usual_error(make_tracks(scene), scene) == pytest.approx(0.5)
    # The median of few degrees of freedom lies below their deviation.
    assert 1.3 < usual_error(make_tracks(scene, noise=2.0), scene) < 2.1


def test_better_poses_are_accepted_and_worse_ones_refused() -> None:
    true, turned = make_scene(), make_scene(turns=small_turns(1.0))
    tracks = make_tracks(true, noise=0.1)
    assert judged(tracks, turned, true).refusal(0.05) == ""
    assert "not clearly better" in judged(tracks, true, turned).refusal(0.05)
    assert "not clearly better" in judged(tracks, true, true).refusal(0.05)


def test_poses_that_fit_sparse_points_worse_are_refused() -> None:
    true, turned = make_scene(), make_scene(turns=small_turns(1.0))
    worse = replace(true, views=tuple(replace(view, reprojection_error=0.6) for view in true.views))
    assert "fit the sparse points worse" in judged(make_tracks(true, 0.1), turned, worse).refusal(0.05)


def test_what_polishing_leaves_wrong_is_told() -> None:
    true, turned = make_scene(), make_scene(turns=small_turns(10.0))
    assert "check the cameras" in judged(make_tracks(true, noise=1.5), turned, true).refusal(0.05)


@pytest.mark.parametrize(
    ("movement", "sparse", "is_told"),
    [(10.7, (0.0, 0.0), True), (1.6, (0.0, 0.0), False), (2.3, (2.2, 0.3), False)],
)
def test_poses_that_move_along_what_ties_leave_open_are_refused(
    movement: float, sparse: tuple[float, float], is_told: bool
) -> None:
    """A kitchen whose cameras were turned by 2.3 pixels was moved by 10.7, and its depth lost."""
    judgement = Judgement(0.78, 0.18, 11.3, *sparse, movement, 0.18)
    assert ("ties do not tell them" in judgement.refusal(0.05)) == is_told


def test_movement_is_that_of_the_points_in_the_image() -> None:
    """A turn about the axis of view moves nothing in the middle; one across it moves everything by f times it."""
    before = make_scene()
    after = make_scene(turns=np.tile([0.002, 0, 0], (NUM_VIEWS, 1)))
    nothing = np.empty(0, np.int64)
    without_points = replace(before, views=tuple(replace(view, point_indices=nothing) for view in before.views))
    no_tracks = Tracks(nothing, nothing, np.empty((0, 2)))
    for scene, tracks in ((before, no_tracks), (without_points, make_tracks(before))):
        moved = movements(scene, after, tracks)
        assert list(moved) == [view.name for view in before.views]
        assert np.allclose(list(moved.values()), 0.002 * FOCAL, rtol=0.05)
    assert movements(without_points, after, no_tracks) == {}


@pytest.mark.parametrize("is_common", [True, False])
def test_only_a_bend_of_all_images_is_one_of_the_camera(is_common: bool) -> None:
    scene = make_scene(make_points(4000))
    tracks = make_tracks(scene, noise=0.1)
    x, y = (2 * tracks.pixels / [WIDTH, HEIGHT] - 1).T
    sign = np.ones(NUM_VIEWS) if is_common else np.random.default_rng(7).permutation([1, -1] * (NUM_VIEWS // 2))
    bend = 0.8 * sign[tracks.view, None] * np.stack([x * y, x**3 - 0.6 * x], axis=1)
    (found,) = common_bends(Tracks(tracks.track, tracks.view, tracks.pixels + bend), scene)
    assert found.views == tuple(range(NUM_VIEWS))
    assert (found.share > 0.05) == is_common
