"""The work to choose pairs grows with the number of images, not with that of pairs of them: work is counted."""

import importlib
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_sph.project.scene_reader import read_scene
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners import covisibility, frusta, pairs
from colmap_sph.stereo.partners.covisibility import Covisibility, find_covisibility
from colmap_sph.stereo.partners.pairs import PairOptions, select_pairs

K = np.array([[200.0, 0, 100], [0, 200, 100], [0, 0, 1]])
NOTHING = np.empty(0, np.int64)


def scene_of(
    centres: NDArray[np.float64], points: NDArray[np.float64], observed: list[NDArray[np.int64]]
) -> Scene:
    """Cameras that look along z."""
    views = zip(centres, observed, strict=True)
    return Scene(
        tuple(View(k, f"{k:04d}", 200, 200, K, np.eye(3), -c, rows) for k, (c, rows) in enumerate(views)), points
    )


def one_place(images: int, seed: int = 0) -> Scene:
    """Images that all see all points, of which they observe none."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-1, 1, (images, 3)) * [1, 1, 0]
    points = np.column_stack([rng.uniform(-2, 2, (2 * images, 2)), np.full(2 * images, 10.0)])
    return scene_of(centres, points, [NOTHING] * images)


def counted_work(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> dict[str, int]:
    """Pairs of images compared, and sights counted, for all images together."""
    work = {"pairs": 0, "sights": 0}
    angles, observers_of = Covisibility.angles, Covisibility._observers_of

    def count_pairs(graph: Covisibility, i: int, others: NDArray[np.int64]) -> NDArray[np.float64]:
        work["pairs"] += len(others)
        return angles(graph, i, others)

    def count_sights(graph: Covisibility, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        found = observers_of(graph, rows)
        work["sights"] += len(found[0])
        return found

    with monkeypatch.context() as patch:
        patch.setattr(Covisibility, "angles", count_pairs)
        patch.setattr(Covisibility, "_observers_of", count_sights)
        select_pairs(scene, PairOptions())
    return work


def test_images_of_one_place_take_the_same_work_each(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name, bound in (
        (covisibility, "_LEAST_SEEN", 4096),
        (covisibility, "_SEEN_IN_ALL", 0),
        (frusta, "_LEAST_IN_VIEW", 64),
        (frusta, "_IN_VIEW_OF_ALL", 0),
        (pairs, "_MOST_SHARING", 32),
    ):
        monkeypatch.setattr(module, name, bound)
    for images in (100, 400):
        work = counted_work(monkeypatch, one_place(images))
        assert 0 < work["pairs"] <= images * 64
        assert 0 < work["sights"] <= images * 4096


def test_each_image_of_a_block_is_compared_with_its_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a strip without points the frusta of neighbours alone meet."""
    strips = (np.arange(images)[:, None] * [0.5, 0.0, 0.0] for images in (100, 400))
    few, many = (
        counted_work(monkeypatch, scene_of(strip, np.empty((0, 3)), [NOTHING] * len(strip))) for strip in strips
    )
    for kind, work in few.items():
        assert many[kind] <= 4.5 * work, kind


def test_what_an_image_shares_with_all_is_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where patch-match.cfg names all images for each."""
    scene = one_place(30)
    shared = Covisibility._shared
    asked: list[int] = []

    def count(graph: Covisibility, i: int) -> NDArray[np.int64]:
        asked.append(i)
        return shared(graph, i)

    monkeypatch.setattr(Covisibility, "_shared", count)
    chosen = select_pairs(scene, PairOptions(), explicit=dict.fromkeys(scene.index_of, "__all__"))
    assert asked == list(range(30))
    assert all(len(partners) == 29 for partners in chosen.partners.values())


def test_every_nth_point_stands_for_n(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = one_place(60)
    exact = select_pairs(scene, PairOptions())
    monkeypatch.setattr(covisibility, "_LEAST_SEEN", 1000)
    monkeypatch.setattr(covisibility, "_SEEN_IN_ALL", 0)
    estimated = select_pairs(scene, PairOptions())
    assert estimated.partners.keys() == exact.partners.keys()
    for name, partners in estimated.partners.items():
        assert len(partners) == 10
        assert np.mean([partner.angle for partner in partners]) == pytest.approx(
            np.mean([partner.angle for partner in exact.partners[name]]), rel=0.5
        )
        assert all(partner.shared_points == pytest.approx(120, rel=0.1) for partner in partners)


def test_points_in_view_of_all_are_thinned_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frusta, "_LEAST_IN_VIEW", 50)
    monkeypatch.setattr(frusta, "_IN_VIEW_OF_ALL", 0)
    points, in_view = frusta.likely_in_view(one_place(100))
    assert len(points) == 200
    for rows in in_view:
        assert rows.tolist() == list(range(0, 200, 4))


def strip(images: int) -> Scene:
    """Images in a row, which see the same number of points each, turned anyhow, and points far off."""
    rng = np.random.default_rng(images)
    centres = np.column_stack([np.arange(images) * 3.0, *rng.uniform(-1, 1, (2, images))])
    points = np.column_stack(
        [rng.uniform(-5, 3 * images + 5, 10 * images), *rng.uniform(-5, 15, (2, 10 * images))]
    )
    points[::50] *= rng.uniform(-1e6, 1e6, (len(points[::50]), 1))
    scene = scene_of(centres, points, [NOTHING] * images)
    turned = []
    for view in scene.views:
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        R = q * np.sign(np.linalg.det(q)) if view.image_id % 2 else view.R
        turned.append(replace(view, R=R, t=-R @ centres[view.image_id]))
    turned[3] = replace(turned[3], t=np.full(3, np.nan))
    return replace(scene, views=tuple(turned))


def test_points_in_view_are_those_that_a_projection_of_all_finds() -> None:
    scene = strip(60)
    points, in_view = frusta.likely_in_view(scene)
    for view, rows in zip(scene.views, in_view, strict=True):
        x, y, depth = view.K @ (view.R @ points.T + view.t[:, None])
        seen = (depth > 0) & (x > 0) & (y > 0) & (x < view.width * depth) & (y < view.height * depth)
        assert rows.tolist() == np.flatnonzero(seen).tolist()
    assert sum(map(len, in_view)) > 500 and not len(in_view[3])


def test_views_are_asked_for_points_near_them_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    sees = frusta.sees

    def count(view: View, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        asked.append(len(points))
        return sees(view, points)

    monkeypatch.setattr(frusta, "sees", count)
    per_view = []
    for images in (100, 800):
        asked.clear()
        frusta.likely_in_view(strip(images))
        per_view.append(np.median(asked[-images:]))
    assert 0 < per_view[1] < 2 * per_view[0]


def test_a_camera_that_hovers_finds_who_stands_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of images stand side by side and share all points; a few others share half of them."""
    monkeypatch.setattr(pairs, "_MOST_SHARING", 20)
    points = np.column_stack([np.random.default_rng(2).uniform(-2, 2, (60, 2)), np.full(60, 10.0)])
    hovering = np.zeros((200, 3))
    hovering[:, 0] = np.arange(200) * 1e-5
    apart = np.array([[x, 0.0, 0.0] for x in np.linspace(1, 2, 20)])
    observed = [np.arange(60)] * 200 + [np.arange(30)] * 20
    chosen = select_pairs(scene_of(np.concatenate([hovering, apart]), points, observed), PairOptions()).partners
    assert all(int(partner.name) >= 200 for partner in chosen["0007"])
    assert len(chosen["0007"]) > 0


def test_angles_do_not_depend_on_how_common_points_are_found() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-2, 2, (400, 3)) + np.array([0, 0, 10])
    centres = rng.uniform(-1, 1, (50, 3)) * [1, 1, 0]
    observed = [np.flatnonzero(rng.random(400) < share) for share in rng.uniform(0.05, 0.9, 50)]
    graph = find_covisibility(scene_of(centres, points, observed), 1, None)
    together = graph.angles(0, np.arange(1, 50))
    alone = [graph.angles(0, np.array([j]))[0] for j in range(1, 50)]
    assert together.tolist() == alone
    for j in (1, 20, 49):
        common = np.intersect1d(observed[0], observed[j])
        rays = [points[common] - centre for centre in (centres[0], centres[j])]
        cosines = np.einsum("ij,ij->i", *rays) / np.prod([np.linalg.norm(each, axis=1) for each in rays], axis=0)
        assert together[j - 1] == pytest.approx(np.percentile(np.degrees(np.arccos(cosines)), 75), abs=1e-6)
        assert graph.weights(0, np.array([j])).tolist() == [len(common)]


def test_what_is_in_view_is_found_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = one_place(20)
    asked: list[str] = []
    sees = frusta.sees

    def count(view: View, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        asked.append(view.name)
        return sees(view, points)

    monkeypatch.setattr(frusta, "sees", count)
    select_pairs(scene, PairOptions())
    pairs.Overlap(scene.only(set(scene.index_of)))
    assert sorted(asked) == sorted(scene.index_of)
    pairs.Overlap(replace(scene))
    assert len(asked) == 40


@pytest.mark.parametrize("observations", [100, 10, 0])
@pytest.mark.parametrize("layout", ["block", "strip", "place"])
@pytest.mark.usefixtures("scripts_on_path")
def test_the_benchmark_of_the_choice(tmp_path, layout: str, observations: int) -> None:
    blocks = importlib.import_module("growth.blocks")
    blocks.write_model(blocks.make_block(30, observations, layout), tmp_path)
    scene = read_scene(tmp_path)
    assert len(scene.views) == 30
    assert select_pairs(scene, PairOptions()).unique_pairs()
    assert len(importlib.import_module("growth.selection").measure(30, observations, layout)) == 3
