"""Photographs that were cut into several views: they are counted once, and matched once on the whole sphere."""

from dataclasses import replace
from itertools import combinations, pairwise

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from colmap_sph import run
from colmap_sph.errors import NoResultError, RectificationError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.scene import Photograph, Scene, View
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.fusion import FusionOptions, ViewMaps, fuse_view
from colmap_sph.stereo.matching import MatchingOptions, match_pair
from colmap_sph.stereo.partners.facing import Facing
from colmap_sph.stereo.partners.frusta import sees
from colmap_sph.stereo.partners.pairs import PairOptions, overlapping_views, select_pairs
from colmap_sph.stereo.partners.stations import OWN_STATION, Stations
from colmap_sph.stereo.photographs.extent import nearer_half
from colmap_sph.stereo.photographs.owners import owned_pixels
from colmap_sph.stereo.photographs.resampling import resample_photograph
from colmap_sph.stereo.photographs.ties import find_ties_of_photographs
from colmap_sph.stereo.poses.ties import find_corners, row_residual
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import (
    PairDisparity,
    Side,
    pixel_from_rectified_ray,
    ray_angles,
    rays_of_coordinates,
)
from colmap_sph.stereo.search.seeds import seeds_of_points, shared_points
from colmap_sph.stereo.vote import VoteOptions, vote_depth
from colmap_sph.synthetic import Light, Mottled, Noise, Plane, box, render
from colmap_sph.synthetic.wide.courtyard import CourtyardOptions, make_courtyard

NONE = np.empty(0, np.int64)


def turned(axis, degrees):
    vector = np.zeros(3)
    vector["xyz".index(axis)] = np.radians(degrees)
    return cv2.Rodrigues(vector)[0]


PANORAMA = {
    "ahead": np.eye(3),
    "back": turned("y", 180),
    "down": turned("x", 90),
    "left": turned("y", 90),
    "right": turned("y", -90),
    "up": turned("x", -90),
}
FISHEYE = {"a": turned("y", -48), "b": turned("y", 48), "c": turned("x", -48), "d": turned("x", 48)}


def views_of(name, center, faces, *, focal=40.0, half=55.0, R=None):
    """Views of one photograph, each with a field of view of twice `half` degrees."""
    side = 2 * int(focal * np.tan(np.radians(half)))
    K = np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    R = np.eye(3) if R is None else R
    return [
        View(0, f"{face}/{name}", side, side, K, F @ R, -F @ R @ np.asarray(center, float), NONE, original=name)
        for face, F in faces.items()
    ]


def scene_of(views, points):
    """Sorted, numbered, and each view observes what it sees."""
    views = sorted(views, key=lambda view: view.name)
    numbered = [
        replace(view, image_id=number, point_indices=np.flatnonzero(sees(view, points)))
        for number, view in enumerate(views, 1)
    ]
    return Scene(tuple(numbered), points)


def directions(count, seed=0):
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def panoramas(*centers, **given):
    """Panoramas named p0, p1, … inside of a ball with a radius of 10 units."""
    views = [view for k, center in enumerate(centers) for view in views_of(f"p{k}", center, PANORAMA, **given)]
    return scene_of(views, 10 * directions(400))


# ---- counted once ---------------------------------------------------------------------------------------------


def test_a_scene_knows_its_photographs():
    scene = panoramas((0, 0, 0), (1, 0, 0))
    assert [photograph.name for photograph in scene.photographs] == ["p0", "p1"]
    assert [view.name for view in scene.photographs[1].views] == [f"{face}/p1" for face in sorted(PANORAMA)]
    assert scene.photograph("up/p0") is scene.photographs[0]
    np.testing.assert_array_equal(scene.photographs[0].point_indices, np.arange(400))
    assert not scene.photographs[0].viewing_direction.any()  # all around
    for angle in range(0, 90, 10):  # and any five of these, whose axes have a mean of 0.2, however that is rounded
        views = views_of("p", (0, 0, 0), PANORAMA, R=turned("y", angle) @ turned("x", angle))
        for five in combinations(views, 5):
            assert not Photograph("p", five).viewing_direction.any()
    R = turned("y", 30)
    fisheye = scene_of(views_of("f", (1, 2, 3), FISHEYE, R=R), scene.points).photographs[0]
    np.testing.assert_allclose(fisheye.viewing_direction, R[2], atol=1e-12)
    np.testing.assert_allclose(fisheye.center, (1, 2, 3), atol=1e-12)
    whole = replace(scene, views=tuple(replace(view, original="") for view in scene.views))
    assert [photograph.name for photograph in whole.photographs] == [view.name for view in scene.views]


def test_partners_are_photographs():
    scene = panoramas((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.5))
    selection = select_pairs(scene, PairOptions(num_pairs=2))
    leads = [photograph.lead.name for photograph in scene.photographs]
    assert list(selection.partners) == leads
    for name, partners in selection.partners.items():
        assert len(partners) == 2
        assert {partner.name for partner in partners} <= {*leads} - {name}
        assert all(partner.shared_points == 400 for partner in partners)
    assert len(select_pairs(scene, PairOptions(num_pairs=3)).unique_pairs()) == 6


def test_one_panorama_alone_is_told():
    with pytest.raises(NoResultError, match=r"one image only, p0; depth needs others"):
        select_pairs(panoramas((0, 0, 0)), PairOptions())


def test_shared_points_of_all_views_together_count():
    """Thirty points, five before each view of a panorama: no two views share more than these few."""
    points = 10 * np.concatenate([sign * (np.eye(3) + 0.02 * k) for k in range(5) for sign in (1, -1)])
    views = [view for k in range(2) for view in views_of(f"p{k}", (0.8 * k, 0, 0), PANORAMA, half=44)]
    scene = scene_of(views, points)
    most = max(
        len(np.intersect1d(a.point_indices, b.point_indices))
        for a in scene.photographs[0].views
        for b in scene.photographs[1].views
    )
    assert most == 5
    assert len(select_pairs(scene, PairOptions(min_shared_points=30)).unique_pairs()) == 1
    with pytest.raises(NoResultError):
        select_pairs(scene, PairOptions(min_shared_points=31))


def test_lists_name_views_and_mean_photographs():
    scene = panoramas((0, 0, 0), (1, 0, 0), (0, 1, 0))
    named = {"up/p0": ["down/p0", "left/p1"], "ahead/p0": ["right/p1", "up/p2"]}
    selection = select_pairs(scene, PairOptions(), explicit=named)
    assert [partner.name for partner in selection.partners["ahead/p0"]] == ["ahead/p1", "ahead/p2"]
    assert list(selection.partners) == ["ahead/p0"]


def test_views_of_one_photograph_are_one_witness():
    scene = panoramas((0, 0, 0), (1, 0, 0), (1.01, 0, 0), (0, 2, 0))
    stations = Stations(scene, 1.0)
    others = ["up/p1", "back/p0", "down/p3", "left/p1", "right/p2"]
    assert stations.numbers("ahead/p0", others) == [1, OWN_STATION, 2, 1, 1]  # p2 stands beside p1
    assert stations.elsewhere("ahead/p0", others)[0] == ["up/p1", "left/p1", "right/p2", "down/p3"]
    # Where nothing else is there, what stands beside is better than nothing, but not the view's own photograph.
    beside = panoramas((0, 0, 0), (0.01, 0, 0))
    assert Stations(beside, 1.0).numbers("up/p0", ["up/p1", "down/p0", "down/p1"]) == [1, OWN_STATION, 1]


def test_views_face_those_that_may_see_the_same():
    scene = panoramas((0, 0, 0), (2, 0, 0))
    facing = Facing(scene)
    for view in scene.photograph("up/p0").views:
        own, found = facing.views(view.name, ["up/p0", "up/p1"])
        assert own == []
        seen = scene.points[view.point_indices]
        assert {other.name for other in scene.photograph("up/p1").views if sees(other, seen).any()} <= {*found}
    # The middle of the room lies between them: each looks away from what the other's back sees.
    assert "down/p1" not in facing.views("up/p0", ["up/p1"])[0]
    whole = replace(scene, views=tuple(replace(view, original="") for view in scene.views))
    assert Facing(whole).views("up/p0", ["down/p1", "up/p0"]) == [["down/p1"], []]
    assert not {name for name in overlapping_views(scene, 50)["up/p0"] if name.endswith("p0")}


@pytest.mark.parametrize("faces", [PANORAMA, FISHEYE])
def test_every_ray_belongs_to_the_view_with_the_nearest_axis(faces):
    views = views_of("p", (1, 2, 3), faces, half=54)
    for view in views:
        columns, rows = np.meshgrid(np.arange(view.width), np.arange(view.height))
        pixels = np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)], axis=1)
        rays = pixels @ np.linalg.inv(view.K).T @ view.R
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        cosines = np.array([rays @ other.R[2] for other in views])
        for k, other in enumerate(views):
            if other is not view:
                cosines[k, ~sees(other, view.center + rays)] = -1
        own = cosines[views.index(view)]
        others = np.delete(cosines, views.index(view), axis=0).max(axis=0)
        owned = owned_pixels(view, [other for other in views if other is not view]).ravel()
        clear = np.abs(own - others) > 1e-9
        np.testing.assert_array_equal(owned[clear], (own > others)[clear])
        assert 0.4 < owned.mean() < 0.8


def exact_maps(scene, view, index):
    """Depth and normals of the ball of radius 10, and a grey image."""
    columns, rows = np.meshgrid(np.arange(view.width), np.arange(view.height))
    rays = np.stack([columns, rows, np.ones_like(columns)], axis=2) @ np.linalg.inv(view.K).T
    world = rays @ view.R
    a, b = (world**2).sum(axis=2), world @ view.center
    depth = (-b + np.sqrt(b**2 - a * ((view.center**2).sum() - 100))) / a
    inward = -(view.center + depth[..., None] * world) / 10
    normals = np.moveaxis(inward @ view.R.T, 2, 0)
    others = [other for other in scene.photograph(view.name).views if other is not view]
    depth[~owned_pixels(view, others)] = 0
    image = np.full((view.height, view.width, 3), 99, np.uint8)
    return ViewMaps(view, index, depth.astype(np.float32), np.ascontiguousarray(normals, np.float32), image)


def fused(scene, maps, view, least):
    """Points and visibility of a view, from all views of the other photographs."""
    others = [other.name for other in scene.views if other.photograph != view.photograph]
    names, numbers = Stations(scene, 1.0).elsewhere(view.name, others)
    options = FusionOptions(min_num_pixels=least)
    bands = fuse_view(maps[view.name], [maps[name] for name in names], options, stations=numbers)
    return tuple(np.concatenate(parts) for parts in zip(*bands, strict=True))


def test_a_cloud_has_each_ray_of_a_photograph_once():
    scene = panoramas((0, 0, 0), (1.5, 0, 0))
    maps = {view.name: exact_maps(scene, view, index) for index, view in enumerate(scene.views)}
    of_view = [view.photograph for view in scene.views]
    rays = []
    for view in scene.photograph("up/p0").views:
        points, seen = fused(scene, maps, view, 2)
        rays.append(points["xyz"] - view.center)
        starts = np.cumsum([0, *_counts(seen)])
        for start, end in pairwise(starts):
            assert {of_view[index] for index in seen[start + 1 : end]} == {"p0", "p1"}
        assert not len(fused(scene, maps, view, 3)[0])  # there are two photographs, whatever their views
    unit = np.concatenate(rays)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    nearest = cKDTree(unit).query(unit, k=2)[0][:, 1]
    # At a corner a pixel is cos² 55° / 40 wide: two samples of one ray would lie nearer to each other.
    assert np.percentile(nearest, 1) > 0.5 * np.cos(np.radians(55)) ** 2 / 40


def _counts(seen):
    """Words of each point in a `.vis`: its number of views, and these."""
    counts = []
    place = 0
    while place < len(seen):
        counts.append(1 + int(seen[place]))
        place += counts[-1]
    return counts


# ---- matched once ---------------------------------------------------------------------------------------------


def test_panoramas_share_the_whole_circle():
    scene = panoramas((0, 0, 0), (1.5, 0.2, 0))
    left, right = scene.photographs
    pair = rectify_pair(scene, left, right, RectificationOptions())
    assert pair.height == np.ceil(2 * np.pi * pair.rows_per_radian) + 1 + 2 * 32
    least = (pair.min_disparity + pair.disparity_origin) / pair.columns_per_radian
    assert pair.left_origin / pair.columns_per_radian == pytest.approx(least - np.arccos(0.1))
    most = (pair.max_disparity + pair.disparity_origin) / pair.columns_per_radian
    end = (pair.left_origin + pair.left_width - 1) / pair.columns_per_radian
    assert end == pytest.approx(min(most / 2, np.pi / 4), abs=1.5 / pair.columns_per_radian)
    with pytest.raises(RectificationError, match="plane cannot hold"):
        rectify_pair(scene, left, right, RectificationOptions(surface="frame"))


@pytest.mark.parametrize("turn", [0, 40, 100, 170])
def test_rows_are_those_planes_that_both_see(turn):
    """Fisheyes, the second of them turned: the rows are as many as the directions that both have in view."""
    views = views_of("p0", (0, 0, 0), FISHEYE, half=52)
    views += views_of("p1", (0.5, 1, 0), FISHEYE, half=52, R=turned("y", turn))
    scene = scene_of(views, 10 * directions(500))
    left, right = scene.photographs
    options = RectificationOptions(near_margin=1, far_margin=1)
    pair = rectify_pair(scene, left, right, options)
    rays = directions(20000, 3)
    rows = []
    for photograph in (left, right):
        seen = np.any([sees(view, view.center + rays) for view in photograph.views], axis=0)
        across, _ = ray_angles(rays[seen] @ pair.rectified_from_world.T)
        rows.append(np.histogram(across, 180, (-np.pi, np.pi))[0] > 0)
    common = np.flatnonzero(rows[0] & rows[1]) * np.pi / 90 - np.pi
    step = np.pi / 90
    first = pair.row_origin / pair.rows_per_radian
    last = first + (pair.height - 1) / pair.rows_per_radian
    assert first < common.min() + 2 * step
    assert last > common.max() - step
    if last - first < 2 * np.pi:
        assert first > common.min() - 2 * step
        assert last < common.max() + 3 * step


def test_each_way_has_what_its_left_image_sees_finer():
    scene = panoramas((0, 0, 0), (1.5, 0.2, 0))
    first, second = scene.photographs
    points = 10 * directions(3000, 7)
    finer = np.linalg.norm(points - first.center, axis=1) < np.linalg.norm(points - second.center, axis=1)
    for left, right, own in ((first, second, finer), (second, first, ~finer)):
        pair = rectify_pair(scene, left, right, RectificationOptions())
        rays = (points[own] - left.center) @ pair.rectified_from_world.T
        _, along = ray_angles(rays)
        column = along * pair.columns_per_radian - pair.left_origin
        away = np.abs(along) < np.arccos(0.1)
        assert ((column >= -1) & (column <= pair.left_width))[away].all()
    assert nearer_half((-1.4, 1.4), 10.0) == (-1.4, np.pi / 4)


def pattern(rays):
    """Grey values of directions: smooth, and different everywhere."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    return 128 + 50 * np.sin(4 * x + 2 * y) * np.cos(3 * z) + 40 * np.sin(5 * y - z)


def image_of(view):
    columns, rows = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([columns, rows, np.ones_like(columns)], axis=2) @ np.linalg.inv(view.K).T @ view.R
    return pattern(rays).astype(np.float32)


def test_the_sphere_is_read_from_the_views_without_a_seam():
    scene = panoramas((0, 0, 0), (1.5, 0.2, 0), half=50)
    left, right = scene.photographs
    pair = rectify_pair(scene, left, right, RectificationOptions())
    views = left.views
    ignored = np.full((views[0].height, views[0].width), 255, np.uint8)
    ignored[20:30, 20:60] = 0
    masks = [ignored, *[None] * 5]
    rectified, valid = resample_photograph([image_of(view) for view in views], views, pair, "left", masks)
    rows, columns = np.mgrid[: pair.height, : pair.left_width]
    places = np.column_stack([columns.ravel(), rows.ravel()])
    rays = rays_of_coordinates(pair, "left", places)
    expected = pattern((pair.rectified_from_world.T @ rays).T).reshape(rectified.shape)
    assert np.abs(rectified - expected)[valid > 0].max() < 1.0
    # What is ignored lies in the first view, where no other one is nearer; all else is there.
    x, y, z = pixel_from_rectified_ray(views[0], pair) @ rays
    inside = (z > 0) & (x > 20 * z) & (x < 60 * z) & (y > 20 * z) & (y < 30 * z)
    others = np.max([view.R[2] @ pair.rectified_from_world.T @ rays for view in views[1:]], axis=0)
    ignored_rays = (inside & (z > others)).reshape(valid.shape)
    assert ignored_rays.any()
    assert not valid[ignored_rays].any()
    near = cv2.dilate(ignored_rays.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert (valid[~near] == 255).all()


@pytest.fixture(scope="module")
def rendered_room():
    """Two panoramas in a yard between four walls: scene, grey images, and exact depths."""
    noise = Noise(0.05, 3, tile=512)
    ground = Plane((0, 0, 0), (0, 0, 1), Mottled(noise, (0.5, 0.5, 0.5), 0.3), (12, 12))
    wall = Mottled(noise, (0.6, 0.55, 0.5), 0.3)
    walls = [box((x, y, 0), size, (wall,)) for x, y, size in _WALLS]
    surfaces = (ground, *walls)
    level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    views = []
    for k, center in enumerate([(-0.8, 0.3, 1.6), (0.4, -0.5, 1.9)]):
        views += views_of(f"p{k}", center, PANORAMA, focal=70.0, R=turned("y", 25 * k) @ level)
    points = np.concatenate([_on_walls(300), np.column_stack([_spread(200, 4), np.zeros(200)])])
    scene = scene_of(views, points)
    images, depths = {}, {}
    for view in scene.views:
        pose = (view.K, view.R, view.t, view.width, view.height)
        picture = render(surfaces, *pose, origin=0.0, supersample=1, light=Light())
        images[view.name] = cv2.cvtColor(picture.image, cv2.COLOR_RGB2GRAY)
        depths[view.name] = picture.depth
    return scene, images, depths


_WALLS = [(0, 6, (14, 2, 6)), (0, -6, (14, 2, 6)), (6, 0, (2, 14, 6)), (-6, 0, (2, 14, 6))]


def _spread(count, half):
    return np.random.default_rng(1).uniform(-half, half, (count, 2))


def _on_walls(count):
    along, height = np.random.default_rng(2).uniform([-5, 0], [5, 6], (count, 2)).T
    side = np.arange(count) % 4
    x = np.choose(side, [along, along, np.full(count, 5.0), np.full(count, -5.0)])
    y = np.choose(side, [np.full(count, 5.0), np.full(count, -5.0), along, along])
    return np.column_stack([x, y, height])


def rectified(images, photograph, pair, side: Side):
    views = photograph.views
    shown = [images[view.name] for view in views]
    return RectifiedImage(*resample_photograph(shown, views, pair, side, [None] * len(views)))


def matched(scene, images, left, right):
    pair = rectify_pair(scene, left, right, RectificationOptions())
    disparity = match_pair(
        rectified(images, left, pair, "left"),
        rectified(images, right, pair, "right"),
        pair.min_disparity,
        pair.max_disparity,
        MatchingOptions(),
        seeds=seeds_of_points(left.lead, right.lead, pair, shared_points(scene, left, right)),
    )
    return PairDisparity(left.lead.name, right.lead.name, pair, disparity)


def test_both_ways_together_find_the_depth_of_every_view(rendered_room):
    scene, images, depths = rendered_room
    first, second = scene.photographs
    pairs = [matched(scene, images, first, second), matched(scene, images, second, first)]
    for photograph in (first, second):
        shares: dict[int, list[tuple[int, int, int]]] = {1: [], 2: []}
        for view in photograph.views:
            exact = depths[view.name]
            owned = owned_pixels(view, [other for other in photograph.views if other is not view]) & (exact > 0)
            for ways in (1, 2):
                lead = photograph.lead.name
                voted = vote_depth(view, pairs[:ways], VoteOptions(), stations=[1] * ways, lead=lead)
                assert voted.support.max() <= 1
                right = np.abs(voted.depth - exact) < 0.03 * exact
                shares[ways].append(((owned & right).sum(), (owned & (voted.depth > 0)).sum(), owned.sum()))
        right, found, shown = np.sum(shares[2], axis=0)
        assert right / found > 0.93
        # Along the baseline, and where the other one stands too near, there is nothing to see.
        assert found / shown > 0.7
        assert found > 1.15 * np.sum(shares[1], axis=0)[1]


def test_ties_are_measured_in_the_views_that_own_them(rendered_room):
    scene, images, _ = rendered_room
    first, second = scene.photographs
    found = matched(scene, images, first, second)
    lefts, rights = (
        [(view, images[view.name], find_corners(images[view.name])) for view in photograph.views]
        for photograph in (first, second)
    )
    ties = find_ties_of_photographs(lefts, rights, found.geometry, found.disparity)
    assert len(ties) > 40
    assert row_residual(ties) == pytest.approx(0, abs=0.1)
    # A second panorama that is turned by a pixel about the baseline shows as rows that disagree by as much.
    angle = 1 / 70
    axis = found.geometry.rectified_from_world[0]
    twist = cv2.Rodrigues(angle * axis)[0]
    twisted = [
        (replace(view, R=view.R @ twist, t=-view.R @ twist @ view.center), image, corners)
        for view, image, corners in rights
    ]
    worse = find_ties_of_photographs(lefts, twisted, found.geometry, found.disparity)
    assert row_residual(worse) == pytest.approx(angle * found.geometry.rows_per_radian, rel=0.25)
    none = np.full_like(found.disparity, np.nan)
    assert len(find_ties_of_photographs(lefts, rights, found.geometry, none)) == 0


# ---- from photographs to a cloud ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def courtyard(tmp_path_factory):
    """A model of three panoramas, and the workspace and report of a run."""
    root = tmp_path_factory.mktemp("courtyard")
    options = CourtyardOptions(width=256, panoramas=True, images=3, points=1200, supersample=1)
    make_courtyard(root, options)
    report = run(root / "sparse" / "0", output=root / "dense")
    return root, report


def test_a_run_matches_photographs_once(courtyard):
    root, report = courtyard
    assert report.pairs == 3
    assert not report.skipped_pairs
    assert len(report.coverage) == 18
    assert np.mean([*report.coverage.values()]) > 0.3  # much of them is sky
    assert report.overall_agreement > 0.85
    assert report.detail == 1.3  # so small they are taken for sharp, and as cut views for more than that
    files = sorted(path.name for path in (root / "dense" / "colmap_sph" / "pairs").rglob("*-*"))
    assert len(files) == 6  # both ways
    again = run(root / "sparse" / "0", output=root / "dense")
    assert (again.pairs, again.points) == (report.pairs, report.points)
    assert again.matched_pairs == report.matched_pairs


def test_no_point_of_a_run_is_seen_by_one_photograph_alone(courtyard):
    root, _ = courtyard
    scene = read_scene(root / "dense" / "sparse")
    of_index = dict(enumerate(scene.image_ids))
    photograph_of = {view.image_id: view.photograph for view in scene.views}
    assert len(set(photograph_of.values())) == 3
    words = np.fromfile(root / "dense" / "fused.ply.vis", np.uint32)[2:]
    place = points = 0
    while place < len(words):
        count = int(words[place])
        seen = [photograph_of[of_index[int(index)]] for index in words[place + 1 : place + 1 + count]]
        assert len(set(seen)) >= 2
        place += 1 + count
        points += 1
    assert points > 3000


def test_maps_of_a_run_have_no_fringes(courtyard):
    """Beside no pixel of a surface, toward its edge, there is anything farther away."""
    root, _ = courtyard
    maps = sorted((root / "dense" / "stereo" / "depth_maps").rglob("*.geometric.bin"))
    assert len(maps) > 10
    for path in maps:
        with np.errstate(divide="ignore"):
            inverse = np.pad(1 / read_depth_map(path), 1, constant_values=np.inf)
        own = inverse[1:-1, 1:-1]
        for before, beyond in ((inverse[1:-1, :-2], inverse[1:-1, 2:]), (inverse[:-2, 1:-1], inverse[2:, 1:-1])):
            for one, other in ((before, beyond), (beyond, before)):
                known = np.isfinite(own) & np.isfinite(one) & np.isfinite(other)
                with np.errstate(invalid="ignore"):
                    ends = (own > 1.11 * other) & (own < 1.09 * one) & (own - other > 2.01 * (one - own))
                assert not (known & ends).any()


def test_what_cannot_be_on_a_plane_is_said(courtyard):
    root, _ = courtyard
    options = RunOptions(rectification=RectificationOptions(surface="frame"))
    with pytest.raises(NoResultError, match="plane cannot hold an image that was cut"):
        run(workspace=root / "dense", options=options)
