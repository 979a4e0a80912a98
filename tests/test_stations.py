"""Views that stand side by side count as one: how they are told, and what follows for choice and confirmation."""

from dataclasses import replace

import numpy as np
import pytest
from test_depth import CONFIRM, estimate, plane_depth, wall_views

from colmap_sph.scene import Scene, View
from colmap_sph.stereo.confirm import confirm_depth
from colmap_sph.stereo.partners.pairs import PairOptions, select_pairs
from colmap_sph.stereo.partners.stations import Stations

K = np.array([[200.0, 0, 100], [0, 200, 100], [0, 0, 1]])
# A degree of parallax 10 units away.
DEGREE = 10 * np.tan(np.radians(1))


def scene_at(places, *, with_points=True):
    """Views at (x, y, 0) that look along z at a wall 10 units away, which all observe."""
    x, y = np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-2, 2, 9))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 10.0)]) if with_points else np.empty((0, 3))
    views = [
        View(k + 1, name, 200, 200, K, np.eye(3), -np.array([x, y, 0.0]), np.arange(len(points)))
        for k, (name, (x, y)) in enumerate(sorted(places.items()))
    ]
    return Scene(tuple(views), points)


def test_views_closer_than_the_angle_are_one_station():
    places = {
        "a": (0, 0),
        "b1": (1, 0),
        "b2": (1 + 0.5 * DEGREE, 0),
        "c1": (0, 1),
        "c2": (0, 1.001),
        "d": (1.5, 0),
    }
    stations = Stations(scene_at(places), 1.0)
    assert stations.numbers("a", ["b1", "c1", "b2", "d", "c2"]) == [1, 2, 1, 3, 2]
    assert stations.elsewhere("a", ["b1", "c1", "b2", "d", "c2"]) == (
        ["b1", "b2", "c1", "c2", "d"],
        [1, 1, 2, 2, 3],
    )
    assert stations.numbers("b1", ["a", "b2", "c1"]) == [1, 0, 2]
    assert stations.elsewhere("b1", ["b2", "a"]) == (["a"], [1])
    assert Stations(scene_at(places), 0.4).numbers("b1", ["a", "b2", "c1"]) == [1, 2, 3]


def test_a_row_of_frames_is_no_single_station():
    """Neighbours are nearer than a degree, the ends are not: a station reaches no farther than from its first."""
    places = {f"{k:02d}": (0.6 * DEGREE * k, 0) for k in range(-5, 6)} | {"x": (0, 3)}
    scene = scene_at(places)
    others = [view.name for view in scene.views if view.name != "x"]
    numbers = Stations(scene, 1.0).numbers("x", others)
    assert len(set(numbers)) == 6
    assert max(numbers.count(number) for number in numbers) <= 3


def test_cameras_of_a_rig_that_look_apart_are_different_stations():
    scene = scene_at({"a": (0, 0), "b1": (1, 0), "b2": (1, 0)})
    for degrees, expected in ((10, [1, 1]), (45, [1, 2])):
        turned = np.radians(degrees)
        R = np.array([[np.cos(turned), 0, np.sin(turned)], [0, 1, 0], [-np.sin(turned), 0, np.cos(turned)]])
        rig = replace(scene.views[2], R=R, t=-R @ scene.views[2].center)
        assert Stations(replace(scene, views=(*scene.views[:2], rig)), 1.0).numbers("a", ["b1", "b2"]) == expected


def test_where_all_stand_together_each_counts():
    places = {"a": (0, 0), "b": (0.3 * DEGREE, 0), "c": (-0.3 * DEGREE, 0)}
    assert Stations(scene_at(places), 1.0).numbers("a", ["b", "c"]) == [1, 2]


@pytest.mark.parametrize("with_points", [True, False])
def test_stations_are_told_without_tracks(with_points):
    places = {"a": (0, 0), "b1": (1, 0), "b2": (1.0001, 0), "c": (0, 1)}
    scene = scene_at(places, with_points=with_points)
    scene = replace(scene, views=tuple(view.without_points() for view in scene.views))
    assert Stations(scene, 1.0).numbers("a", ["b1", "b2", "c"]) == [1, 1, 2]


def test_partners_come_from_different_stations_first():
    places = {
        f"{name}{k}": (x, 0.001 * k) for name, x in (("a", 0), ("b", 1), ("c", 2), ("d", -1)) for k in range(3)
    }
    for number, stations in ((1, 1), (2, 2), (3, 3), (5, 3)):
        chosen = select_pairs(scene_at(places), PairOptions(num_pairs=number)).partners["a0"]
        names = [partner.name[0] for partner in chosen]
        assert len(names) == number
        assert len(set(names[:stations])) == stations and "a" not in names


# ---- confirmation ------------------------------------------------------------------------------------------


def test_frames_from_one_place_confirm_once():
    """Three frames from one place share a mistake of the view's; nobody elsewhere does."""
    views, _ = wall_views(2)
    wrong = plane_depth(views[0], 12.0), plane_depth(views[1], 12.0)
    twins = [(views[1], estimate(wrong[1])) for _ in range(3)]
    alone = confirm_depth(views[0], estimate(wrong[0]), twins[:1], CONFIRM)
    for stations, confirmed in (([1, 1, 1], 1), (None, 3)):
        result = confirm_depth(views[0], estimate(wrong[0]), twins, CONFIRM, stations)
        assert result.support.max() == confirmed
    as_one = confirm_depth(views[0], estimate(wrong[0]), twins, CONFIRM, [1, 1, 1])
    for found, expected in zip(vars(as_one).values(), vars(alone).values(), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_station_says_what_most_of_it_say():
    """Of three frames from one place two contradict and one agrees: the station contradicts, the depth goes."""
    views, maps = wall_views(3)
    here, there, elsewhere = views
    farther, agreeing = estimate(plane_depth(there, 14.0)), estimate(maps[1])
    partners = [(there, agreeing), (there, farther), (there, farther), (elsewhere, estimate(maps[2]))]
    options = replace(CONFIRM, min_consistent=1, max_contradiction=0.5)
    middle = (slice(18, 30), slice(26, 38))
    apart = confirm_depth(here, estimate(maps[0]), partners, options, [1, 1, 1, 2])
    assert not apart.depth[middle].any()
    partners[1] = partners[0]
    result = confirm_depth(here, estimate(maps[0]), partners, options, [1, 1, 1, 2])
    assert (result.support[middle] == 2).all()
    np.testing.assert_allclose(result.depth[middle], maps[0][middle], rtol=1e-3)
