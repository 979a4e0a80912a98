"""A scene is the same to the bit wherever its model lies, and is what the model is to a thousandth of a pixel."""

from dataclasses import replace

import numpy as np
import pytest
from rendered import project

from colmap_sph import synthetic as syn
from colmap_sph.pipeline.digests import digest
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair

OFFSETS = [(5e5 + 1 / 3, 5e6 + 1 / 7, 300), (4201575.762, 168864.183, 4780229.051), (-8e6, 12.5, -9e6)]
K = np.array([[1000.0, 0, 500], [0, 1010, 400], [0, 0, 1]])


def make_scene(count=12, tracks=True, scale=1.0):
    """Cameras along a strip, ten units before a cloud of points, all of which every view observes."""
    rng = np.random.default_rng(count)
    points = rng.uniform([-4, -3, 8], [4, 3, 12], (200, 3))
    views = []
    for k in range(count):
        eye = rng.uniform([-3, -1, -0.1], [3, 1, 0.1])
        R, _ = syn.look_at(eye, rng.uniform([-1, -1, 10], [1, 1, 10]), up=(0, -1, 0))
        indices = np.arange(len(points)) if tracks else np.empty(0, np.int64)
        views.append(View(k + 1, f"{k:02d}.jpg", 1000, 800, K, R, -R @ eye * scale, indices))
    return Scene(tuple(views), points * scale if tracks else np.empty((0, 3)))


def shifted(scene, offset):
    """The scene as read from a model whose poses and points were moved by `offset` in 64-bit floats."""
    offset = np.array(offset, dtype=np.float64)
    origin = np.round(offset + 5)
    views = [replace(view, t=(view.t - view.R @ offset) + view.R @ origin) for view in scene.views]
    return Scene(tuple(views), (scene.points + offset) - origin, origin)


def same_cameras(one, other):
    return all(
        np.array_equal(a.t, b.t) and np.array_equal(a.R, b.R) for a, b in zip(one.views, other.views, strict=True)
    )


@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("tracks", [True, False])
def test_cameras_do_not_depend_on_where_the_model_lies(offset, tracks):
    scene = make_scene(tracks=tracks)
    moved = shifted(scene, offset)
    near, far = anchored(scene), anchored(moved)
    assert same_cameras(near, far)
    np.testing.assert_allclose(far.points, near.points, rtol=0, atol=1e-8)
    np.testing.assert_allclose(far.origin + far.anchor - near.anchor, offset, rtol=0, atol=1e-8)


def test_the_last_digits_count_without_it():
    """What the grid is for: as read, the cameras' places relative to each other differ."""
    scene, moved = make_scene(), shifted(make_scene(), OFFSETS[0])
    near, far = (np.array([v.center - s.views[0].center for v in s.views]) for s in (scene, moved))
    assert 1e-11 < np.abs(near - far).max() < 1e-8


@pytest.mark.parametrize("scale", [1e-4, 1.0, 3e5])
@pytest.mark.parametrize("tracks", [True, False])
def test_pictures_hardly_move(scale, tracks):
    """Points project to where they did, whatever the unit of the model."""
    scene, points = make_scene(scale=scale, tracks=tracks), make_scene(scale=scale).points
    result = anchored(scene)
    shifts = []
    for view, same in zip(scene.views, result.views, strict=True):
        before, _ = project(view, points)
        after, depth = project(same, points - result.anchor)
        assert (depth > 0).all()
        shifts.append(after - before)
    assert 0 < np.abs(shifts).max() < 3e-3
    assert np.sqrt(np.mean(np.square(shifts))) < 1e-3
    np.testing.assert_array_equal(result.points + result.anchor, scene.points - result.anchor + result.anchor)


@pytest.mark.parametrize("surface", ["spherical", "frame"])
@pytest.mark.parametrize("offset", OFFSETS)
def test_rectified_pairs_do_not_depend_on_where_the_model_lies(offset, surface):
    """Nor on the last digits of the sparse points, which differ."""
    near, far = anchored(make_scene()), anchored(shifted(make_scene(), offset))
    assert not np.array_equal(near.points, far.points)
    for k in range(1, len(near.views)):
        pairs = [
            rectify_pair(s, s.views[0], s.views[k], RectificationOptions(surface=surface)) for s in (near, far)
        ]
        assert digest(pairs[0]) == digest(pairs[1])


def test_the_finest_image_sets_the_grid():
    """One camera at a thousandth of the distance: it does not move by more than its own pixels allow."""
    scene = make_scene()
    R = np.eye(3)
    near = np.array([0.0, 0.0, 7.99])
    close = np.array([[0.001, 0.0, 8.0], [-0.002, 0.001, 8.0], [0.0, 0.002, 8.0]])
    first = len(scene.points)
    view = View(99, "99.jpg", 1000, 800, K, R, -R @ near, np.arange(first, first + 3))
    result = anchored(Scene((*scene.views, view), np.vstack([scene.points, close])))
    before, _ = project(view, close)
    after, _ = project(result.view("99.jpg"), close - result.anchor)
    assert np.abs(after - before).max() < 3e-3


def test_an_outlying_camera_is_not_counted_from():
    """At a billion units from it, the others' coordinates would have few digits left."""
    scene = make_scene()
    lost = replace(scene.views[0], t=-scene.views[0].R @ np.array([1e9, 0, 0]))
    result = anchored(replace(scene, views=(lost, *scene.views[1:])))
    assert np.linalg.norm(result.anchor) < 20
    for view, same in zip(scene.views[1:], result.views[1:], strict=True):
        np.testing.assert_allclose(same.center + result.anchor, view.center, rtol=0, atol=3e-5)


@pytest.mark.parametrize("offset", [(0, 0, 0), *OFFSETS])
@pytest.mark.parametrize("tracks", [True, False])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_cameras_in_one_place_stay_there(count, tracks, offset):
    """Images of one tripod have no baseline, not one of a nanometre."""
    scene = make_scene(count, tracks)
    eye = scene.views[0].center
    scene = replace(scene, views=tuple(replace(view, t=-view.R @ eye) for view in scene.views))
    result = anchored(shifted(scene, offset))
    centers = np.array([view.center for view in result.views])
    assert np.abs(centers - centers[0]).max() < 1e-15 * (1 + np.abs(centers).max())


@pytest.mark.parametrize("offset", OFFSETS)
def test_two_cameras_without_points(offset):
    scene = make_scene(2, tracks=False)
    near, far = anchored(scene), anchored(shifted(scene, offset))
    assert same_cameras(near, far)
    baseline = np.linalg.norm(scene.views[1].center - scene.views[0].center)
    assert np.linalg.norm(far.views[1].center - far.views[0].center) == pytest.approx(baseline, rel=1e-5)


def test_round_coordinates_are_on_no_border():
    """A regular block whose coordinates are whole numbers of a fine binary step, moved by noise."""
    rng = np.random.default_rng(1)
    scene = make_scene()
    eyes = [np.round(view.center * 2**20) / 2**20 for view in scene.views]
    views = [replace(view, R=np.eye(3), t=-eye) for view, eye in zip(scene.views, eyes, strict=True)]
    exact = replace(scene, views=tuple(views))
    noisy = [replace(v, t=v.t + rng.uniform(-2e-9, 2e-9, 3)) for v in exact.views]
    assert same_cameras(anchored(exact), anchored(replace(exact, views=tuple(noisy))))
