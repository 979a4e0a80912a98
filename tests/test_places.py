"""The order of place keeps together what lies together, and has no part in what comes out."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.places import Places, along_hilbert_curve
from colmap_sph.stereo.partners.reads import best_order, loads_in_order

K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])


def grid_scene(columns: int, rows: int, rotation: np.ndarray, *, tracks: bool) -> Scene:
    """Views over a grid of ground points 10 below, named strip by strip; each observes the point below it."""
    places = np.array([(x, y, 0.0) for y in range(rows) for x in range(columns)]) @ rotation.T
    views = [
        View(
            k, f"{k:04d}", 100, 100, K, rotation.T, -rotation.T @ place, np.array([k] if tracks else [], np.int64)
        )
        for k, place in enumerate(places)
    ]
    return Scene(tuple(views), places - 10 * rotation[:, 2])


def test_the_curve_goes_from_cell_to_cell_beside_it() -> None:
    cells = np.stack(np.meshgrid(np.arange(32), np.arange(32)), axis=-1).reshape(-1, 2)
    along = along_hilbert_curve(cells, 5)
    assert sorted(along.tolist()) == list(range(32 * 32))
    steps = np.abs(np.diff(cells[np.argsort(along)], axis=0)).sum(axis=1)
    assert (steps == 1).all()


@pytest.mark.parametrize("tracks", [True, False])
def test_views_are_in_squares(tracks: bool) -> None:
    """Of every 64 in order the extent is that of a square of them, though names go along strips of 40."""
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    scene = grid_scene(40, 40, rotation, tracks=tracks)
    ordered = Places(scene).sorted(scene.index_of)
    assert sorted(ordered) == list(scene.index_of) and ordered != list(scene.index_of)
    centers = np.array([scene.view(name).center for name in ordered])
    radii = [np.ptp(centers[first : first + 64] @ rotation, axis=0).max() for first in range(0, 1600, 64)]
    assert np.median(radii) < 16


def test_pairs_lie_between_their_views() -> None:
    scene = grid_scene(16, 16, np.eye(3), tracks=True)
    pairs = [(f"{k:04d}", f"{k + 1:04d}") for k in range(255) if k % 16 != 15]
    ordered = Places(scene).sorted_pairs(pairs)
    assert sorted(ordered) == pairs
    middles = np.array([scene.view(a).center + scene.view(b).center for a, b in ordered]) / 2
    assert np.median(np.linalg.norm(np.diff(middles, axis=0), axis=1)) < 2


@pytest.mark.parametrize("case", ["one", "one place", "far away", "impossible"])
def test_any_scene_has_an_order(case: str) -> None:
    """The same for all names that are given, in whichever order."""
    scene = grid_scene(4, 1 if case == "one" else 3, np.eye(3), tracks=case != "one place")
    views = list(scene.views[: 1 if case == "one" else None])
    if case == "one place":
        views = [View(v.image_id, v.name, 100, 100, K, v.R, np.zeros(3), v.point_indices) for v in views]
    points = scene.points.copy()
    points[-1] = {"far away": 1e12, "impossible": np.nan}.get(case, points[-1])
    places = Places(Scene(tuple(views), points))
    names = [view.name for view in views]
    assert sorted(places.sorted(names)) == names
    assert places.sorted(reversed(names)) == places.sorted(names)


# ---- strips, and what is loaded ----------------------------------------------------------------------------


def test_strips_go_there_and_back() -> None:
    """Of a grid of 24 x 12 views: one of the orders goes along its rows three at a time, another along columns."""
    scene = grid_scene(24, 12, np.eye(3), tracks=True)
    orders = list(Places(scene).in_strips(scene.index_of))
    assert all(sorted(order) == list(scene.index_of) for order in orders)
    found = set()
    for order in orders:
        centers = np.array([scene.view(name).center[:2] for name in order])
        for axis, views in ((1, 3 * 24), (0, 3 * 12)):
            strips = np.split(centers, range(views, len(centers), views))
            if all(np.ptp(strip[:, axis]) == 2 for strip in strips):
                along = [strip[:, 1 - axis] for strip in strips]
                is_straight = all((np.diff(each) >= 0).all() or (np.diff(each) <= 0).all() for each in along)
                if is_straight and all(one[-1] == other[0] for one, other in pairwise(along)):
                    found.add(axis)
    assert found == {0, 1}
    assert list(Places(scene).in_strips([])) == [[]] * len(orders)


def least_loads(asked: list[str], room: int) -> int:
    """Fewest loads by a cache that has to keep what it was asked for last: all that it could do is tried."""

    @cache
    def from_here(place: int, kept: frozenset[str]) -> int:
        if place == len(asked):
            return 0
        name = asked[place]
        if name in kept:
            return from_here(place + 1, kept)
        kept |= {name}
        choices = [kept] if len(kept) <= room else [kept - {gone} for gone in kept if gone != name]
        return 1 + min(from_here(place + 1, choice) for choice in choices)

    return from_here(0, frozenset())


@pytest.mark.parametrize("seed", range(30))
def test_loads_are_the_fewest_that_are_possible(seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = list("abcdef")
    partners = {name: rng.choice(names, 2, replace=False).tolist() for name in names}
    sizes = dict.fromkeys(names, 2.0)
    for room in (2, 3, 4):
        asked = [name for item in names for name in (item, *partners[item])]
        assert loads_in_order(names, partners, sizes, 2.0 * room) == 2.0 * least_loads(asked, room)


def test_the_best_order_is_taken() -> None:
    """Of a row of views, each of which looks at the next one: from one end to the other."""
    names = [f"{k:02d}" for k in range(20)]
    partners = {name: [other] for name, other in pairwise(names)}
    mixed = np.random.default_rng(0).permutation(names).tolist()
    sizes = dict.fromkeys(names, 1.0)
    assert best_order([mixed, names, mixed], partners, sizes, 2.0) == names
    assert best_order([mixed, names], partners, sizes, 20.0) == mixed  # the first of equals
