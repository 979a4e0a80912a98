"""The order of place keeps together what lies together, and has no part in what comes out."""

import numpy as np
import pytest

from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.places import Places, along_hilbert_curve

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
