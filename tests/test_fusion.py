"""Our fusion of exact maps against exact surfaces, of noisy ones against the oracle, and what its options do."""

import itertools
import tracemalloc
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import oracle
import pytest
from exact_maps import HEIGHT, WIDTH, make_workspace, stored_maps, write_maps
from refusals import assert_refused
from scipy.spatial import cKDTree

from colmap_sph import _native
from colmap_sph import synthetic as syn
from colmap_sph.errors import InputError, OptionError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages import fusion_parts
from colmap_sph.pipeline.stages.view_maps import MapSources, read_view_maps
from colmap_sph.project import map_files
from colmap_sph.project.map_files import write_depth_map, write_normal_map
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.scene import POINT, View, pixel_transfer
from colmap_sph.stereo import fusion
from colmap_sph.stereo.fusion import MAX_PARTNERS, FusionOptions, PackedMaps, ViewMaps, fuse_view
from colmap_sph.stereo.fusion_losses import explain_losses
from colmap_sph.stereo.photographs import owners
from colmap_sph.stereo.search.idle import lending

STONE = syn.Mottled(syn.Noise(0.1, seed=1))
SIZE = (120, 90)
EVERY_PIXEL = FusionOptions(min_num_pixels=1)
# No pixel of an image is farther from the nearest pixel's centre of another.
NO_DOUBLES = 0.75


def camera(eye, focal, target=None, size=SIZE):
    x, y, _ = eye
    R, t = syn.look_at(eye, (0.4 * x, 0.4 * y, 0) if target is None else target, up=(0, 1, 0))
    return syn.Camera(syn.pinhole(focal, *size), R, t, *size)


def maps_of(surfaces, cameras):
    """Exact maps with pictures of noise."""
    rng = np.random.default_rng(0)
    maps = []
    for index, one in enumerate(cameras):
        depth, normals, _ = syn.exact_geometry(surfaces, one, origin=0.0)
        view = View(index + 1, f"{index}.png", one.width, one.height, one.K, one.R, one.t, np.empty(0, np.int64))
        planes = np.ascontiguousarray(np.moveaxis(normals, 2, 0), dtype=np.float32)
        image = rng.integers(0, 256, (*depth.shape, 3), dtype=np.uint8)
        maps.append(ViewMaps(view, index, depth.astype(np.float32), planes, image))
    return maps


def fuse_one(maps, index, options=EVERY_PIXEL):
    """Points of one view, and the views that each lists."""
    others = [other for other in maps if other.index != index]
    parts = list(fuse_view(maps[index], others, options))
    points, words = (np.concatenate(column) for column in zip(*parts, strict=True))
    views = []
    position = 0
    for _ in points:
        count = int(words[position])
        views.append(tuple(words[position + 1 : position + 1 + count].tolist()))
        position += 1 + count
    assert position == len(words)
    return points, views


def fuse_all(maps, options=EVERY_PIXEL):
    """Points and views of the cloud, and the view that each point was made from."""
    parts = [fuse_one(maps, index, options) for index in range(len(maps))]
    points = np.concatenate([points for points, _ in parts])
    made_from = np.repeat(np.arange(len(maps)), [len(points) for points, _ in parts])
    return points, [views for _, listed in parts for views in listed], made_from


def world_points(one):
    """World points (n, 3) of the pixels (rows, columns) with a depth."""
    rows, columns = np.nonzero(one.depth > 0)
    view = one.view
    rays = np.column_stack([columns, rows, np.ones(len(rows))]) @ np.linalg.inv(view.K).T
    return (rays * one.depth[rows, columns, None] - view.t) @ view.R, rows, columns


def visible(surfaces, one, points, which=np.all):
    """Which world points a camera sees: at all places a pixel around its projection, or at `any` of them."""
    pixel, depth = one.project(points)
    seen = []
    for moved in [(0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1)]:
        place = pixel + moved
        inside = (depth > 0) & (place >= 0).all(axis=1) & (place <= [one.width - 1, one.height - 1]).all(axis=1)
        distance = syn.trace_points(surfaces, one, np.where(inside[:, None], place, 0)).distance
        seen.append(inside & (np.abs(distance - depth) < 0.02 * depth))
    return which(seen, axis=0)


def pixel_side(one, points, normals):
    """Side of the square of surface that a camera's pixel covers at world points."""
    _, depth = one.project(points)
    facing = np.abs((normals * (points - one.centre)).sum(axis=1)) / depth
    return depth / one.K[0, 0] / np.sqrt(facing)


GROUND = syn.Plane((0, 0, 0), (0.1, -0.05, 1), STONE)
YARD = [GROUND, syn.box((0.5, 0.3, -0.3), (1.5, 1.2, 1.3), [STONE], yaw=0.4)]
AROUND = [
    *(camera((x, y, 10), 150) for x, y in [(-1.5, -1), (0, -1.2), (1.6, -0.9), (-1.2, 1.1), (0.2, 1.3), (1.4, 1)]),
    camera((0.3, 0.2, 9.8), 300),
    camera((-5, 0.5, 7), 150, target=(0, 0, 0)),
]


@pytest.fixture(scope="module")
def yard():
    """A box on a plane: six views of one resolution, a fine one, an oblique one."""
    return maps_of(YARD, AROUND)


# ---- where the points are ----------------------------------------------------------------------------------


def test_points_are_pixels_of_exact_surfaces(yard):
    """Position, normal and colour of every point are those of the surface at a pixel of its view."""
    points, _, made_from = fuse_all(yard, FusionOptions())
    assert len(points) > 20_000
    for index, one in enumerate(AROUND):
        mine = points[made_from == index]
        pixel, depth = one.project(mine["xyz"].astype(float))
        columns, rows = np.rint(pixel).astype(int).T
        np.testing.assert_allclose(pixel, np.stack([columns, rows], axis=1), atol=1e-3)
        np.testing.assert_allclose(depth, yard[index].depth[rows, columns], rtol=1e-6)
        exact, normals, _ = syn.exact_geometry(YARD, one, origin=0.0)
        np.testing.assert_allclose(depth, exact[rows, columns], rtol=1e-6)
        np.testing.assert_allclose(mine["normal"], normals[rows, columns] @ one.R, atol=1e-6)
    on_ground = np.abs(points["normal"] @ (np.array([0.1, -0.05, 1]) / np.linalg.norm([0.1, -0.05, 1])) - 1) < 1e-6
    assert 0.5 < on_ground.mean() < 1
    assert np.abs(points["xyz"][on_ground].astype(float) @ [0.1, -0.05, 1]).max() < 1e-5


@pytest.fixture(scope="module")
def seen_points(yard):
    """Of each view: world points of its pixels, how many views see them, and the finest of their pixels there."""
    of_views = []
    for one, maps in zip(AROUND, yard, strict=True):
        points, rows, columns = world_points(maps)
        normals = maps.normals[:, rows, columns].T @ one.R
        seen_by, finest = np.zeros(len(points), int), np.full(len(points), np.inf)
        for other in AROUND:
            seen = visible(YARD, other, points)
            finest = np.where(seen, np.minimum(finest, pixel_side(other, points, normals)), finest)
            seen_by += seen
        of_views.append((points, seen_by, finest))
    return of_views


@pytest.mark.parametrize("max_reproj_error", [0.5, NO_DOUBLES])
@pytest.mark.parametrize("least", [1, 2, 3])
def test_no_holes(yard, seen_points, least, max_reproj_error):
    """What enough views see has a point within a pixel of the finest of them."""
    options = FusionOptions(min_num_pixels=least, max_reproj_error=max_reproj_error)
    tree = cKDTree(fuse_all(yard, options)[0]["xyz"].astype(float))
    for points, seen_by, finest in seen_points:
        enough = seen_by >= least
        assert enough.mean() > 0.5
        assert (tree.query(points[enough])[0] < finest[enough]).all()


@pytest.mark.parametrize(
    ("max_reproj_error", "share"),
    [(0.5, 1 - np.pi / 4), (None, 1 - np.pi * 0.35**2), (0.25, 1 - np.pi / 16), (NO_DOUBLES, 0)],
)
def test_points_come_from_the_finer_image(max_reproj_error, share):
    """Of the coarse image's pixels those stay that no circle about a fine pixel holds: its share of a square."""
    fine, coarse = camera((0.1, 0, 9.9), 400), camera((0, 0, 10), 150)
    maps = maps_of([GROUND], [coarse, fine])
    points, _, made_from = fuse_all(maps, FusionOptions(max_reproj_error=max_reproj_error))
    assert np.count_nonzero(made_from == 1) == fine.width * fine.height
    # Up to half a pixel beyond the centres of its outermost pixels.
    pixel, _ = fine.project(world_points(maps[0])[0])
    both = ((pixel >= -0.5) & (pixel < np.array(SIZE) - 0.5)).all(axis=1)
    assert both.sum() > 1400
    assert np.count_nonzero(made_from == 0) / both.sum() == pytest.approx(share, abs=0.02)
    if share == 0:  # nothing twice: the cloud is the fine image
        distance, _ = cKDTree(points["xyz"]).query(points["xyz"], k=2)
        assert distance[:, 1].min() > 0.9 * 9.5 / 400


def test_equal_pixels_cover_one_another_once():
    """Two images of one camera in one place: the points are one image's, all seen by both."""
    maps = maps_of([GROUND], [camera((0, 0, 10), 150)] * 2)
    points, views, made_from = fuse_all(maps, FusionOptions())
    assert len(points) == SIZE[0] * SIZE[1]
    assert len(set(made_from)) == 1
    assert {frozenset(listed) for listed in views} == {frozenset((0, 1))}


def test_the_view_with_the_smallest_pixel_makes_the_point(yard):
    """In pixels on the surface: resolution, distance and slant."""
    points, _, made_from = fuse_all(yard, FusionOptions(max_reproj_error=NO_DOUBLES))
    place, normals = points["xyz"].astype(float), points["normal"].astype(float)
    sides = np.stack([pixel_side(one, place, normals) for one in AROUND])
    own = np.take_along_axis(sides, made_from[None], axis=0)[0]
    others = np.where([visible(YARD, one, place) for one in AROUND], sides, np.inf)
    assert np.mean(others.min(axis=0) < np.inf) > 0.8
    # But for single pixels at the box's edges: a corner may lie between the places looked at.
    assert np.mean(own < 1.01 * others.min(axis=0)) > 0.999
    assert set(made_from) == set(range(len(AROUND)))


# ---- what agrees -------------------------------------------------------------------------------------------


def test_views_are_those_that_see_the_point(yard):
    """Nothing is merged through the box or around its corners: visibility by tracing, away from edges."""
    points, views, _ = fuse_all(yard)
    place = points["xyz"].astype(float)
    listed = np.array([[index in names for index in range(len(yard))] for names in views])
    for index, one in enumerate(AROUND):
        surely = visible(YARD, one, place)
        assert surely.mean() > 0.1
        assert listed[surely, index].mean() > 0.998
        perhaps = visible(YARD, one, place, which=np.any)
        assert np.count_nonzero(~perhaps) > 500
        assert not listed[~perhaps, index].any()
    assert all(len(set(names)) == len(names) for names in views)


@pytest.mark.parametrize("thickness", [0.01, 0.5])
def test_nothing_is_merged_through_a_wall(thickness):
    """Two views of either face of a wall, which is thinner or thicker than the gate of depth."""
    wall = [syn.box((0, 0, -thickness), (60, 60, thickness), [STONE])]
    above = [camera((x, 0, 10), 150) for x in (-0.5, 0.5)]
    below = [camera((x, 0, -10), 150) for x in (-0.5, 0.5)]
    maps = maps_of(wall, [above[0], below[0], above[1], below[1]])
    points, views, made_from = fuse_all(maps)
    assert {frozenset(index % 2 for index in names) for names in views} == {frozenset((0,)), frozenset((1,))}
    np.testing.assert_allclose(points["normal"][:, 2], np.where(made_from % 2 == 0, 1, -1), atol=1e-6)


GATES = [
    ("depth", 0.009, True),
    ("depth", 0.0115, False),
    ("depth", -0.009, True),
    ("depth", -0.0115, False),
    ("normal", 29.0, True),
    ("normal", 31.0, False),
    ("normal", -29.0, True),
    ("normal", 180.0, False),
]


@pytest.mark.parametrize(("gate", "change", "agrees"), GATES)
def test_gates(gate, change, agrees):
    """The default gates are 1 % of depth and 30 degrees between normals."""
    maps = maps_of([GROUND], [camera((x, 0, 10), 150) for x in (-0.2, 0.2)])
    spoilt = maps[1]
    if gate == "depth":
        spoilt = replace(spoilt, depth=spoilt.depth * np.float32(1 + change))
    else:
        angle = np.radians(change)
        # About an axis across the normal, so that it turns by the whole angle.
        x, y, z = np.array([0.1, -0.05, 1]) / np.linalg.norm([0.1, -0.05, 1]) @ spoilt.view.R.T
        axis = np.cross([x, y, z], [1, 0, 0])
        turn, _ = cv2.Rodrigues(angle * axis / np.linalg.norm(axis))
        turned = np.einsum("ij,jhw->ihw", turn, spoilt.normals).astype(np.float32)
        spoilt = replace(spoilt, normals=turned)
    _, views = fuse_one([maps[0], spoilt], 0)
    share = np.mean([len(names) == 2 for names in views])
    assert share > 0.5 if agrees else share == 0


def test_depth_without_normal_agrees_with_nothing(yard):
    empty = replace(yard[1], normals=np.zeros_like(yard[1].normals))
    _, views = fuse_one([yard[0], empty], 0)
    assert {len(names) for names in views} == {1}


def test_a_map_without_depth_has_no_say(yard):
    for value in (0, -5, np.nan, np.inf):
        empty = replace(yard[1], depth=np.full_like(yard[1].depth, value))
        _, views = fuse_one([yard[0], empty], 0)
        assert len(views) == SIZE[0] * SIZE[1]
        assert {len(names) for names in views} == {1}


def test_the_number_of_views_is_exact():
    """On a plane nothing is hidden: every pixel agrees with the views that have it inside their image."""
    cameras = AROUND[:6]
    maps = maps_of([GROUND], cameras)
    points, views, _ = fuse_all(maps)
    inside, near_rim = np.zeros(len(points), int), np.zeros(len(points), bool)
    for one in cameras:
        corner = one.project(points["xyz"].astype(float))[0] + 0.5
        inside += ((corner >= 0) & (corner <= SIZE)).all(axis=1)
        near_rim |= (np.abs(np.hstack([corner, corner - SIZE])) < 1e-3).any(axis=1)
    counts = np.array([len(names) for names in views])
    np.testing.assert_array_equal(counts[~near_rim], inside[~near_rim])
    assert set(counts) == set(range(1, 7))
    for least in range(1, 8):
        some, their_views, _ = fuse_all(maps, FusionOptions(min_num_pixels=least))
        assert some.tobytes() == points[counts >= least].tobytes()
        assert their_views == [names for names in views if len(names) >= least]


def test_no_more_partners_than_have_a_bit():
    """The 65th and later partners are not looked at, and the mean of 65 colours does not overflow."""
    one = camera((0, 0, 10), 20, size=(4, 3))
    maps = maps_of([GROUND], [one] * 70)
    white = [replace(m, image=np.full_like(m.image, 255)) for m in maps]
    points, views = fuse_one(white, 0)
    assert len(points) == 12
    assert set(views) == {tuple(range(1 + MAX_PARTNERS))}
    assert (points["rgb"] == 255).all()


# ---- against the oracle ------------------------------------------------------------------------------------


def noisy_maps(seed):
    """Views of several sizes and focal lengths, whose maps have noise, holes and outliers."""
    rng = np.random.default_rng(seed)
    cameras = [
        camera((-0.8, -0.5, 10), 60, size=(40, 31)),
        camera((0.3, 0.6, 9), 55, size=(36, 30)),
        camera((1.1, -0.4, 10), 110, size=(50, 41)),
        camera((-3.5, 0.4, 8), 60, target=(0, 0, 0), size=(33, 40)),
    ]
    # Pixels that are not square, and a principal point aside.
    cameras[1] = replace(cameras[1], K=np.array([[70.0, 0, 17], [0, 45, 16], [0, 0, 1]]))
    maps = []
    for one in maps_of(YARD, cameras):
        depth = one.depth * (1 + rng.normal(0, 0.006, one.depth.shape)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.1] = 0
        normals = one.normals + rng.normal(0, 0.2, one.normals.shape).astype(np.float32)
        normals /= np.linalg.norm(normals, axis=0)
        maps.append(replace(one, depth=depth, normals=normals, index=(7 * one.index) % 5))
    return maps


@pytest.mark.parametrize(
    "options",
    [
        FusionOptions(),
        FusionOptions(min_num_pixels=1, max_reproj_error=0.3),
        FusionOptions(min_num_pixels=3, max_reproj_error=0.6, max_depth_error=0.02, max_normal_error=20.0),
    ],
    ids=["default", "narrow", "wide"],
)
@pytest.mark.parametrize(
    ("seeds", "stations"), [([0], None), ([1], None), ([1], [0, 1, 2]), ([1], [1, 1, 2]), ([2, 3, 4], None)]
)
def test_fusion_is_the_oracles(seeds, stations, options, monkeypatch):
    """Also with more partners than a byte has bits, and where threads share the rows."""
    monkeypatch.setattr(fusion, "_BAND_ROWS", 7)
    maps = [one for seed in seeds for one in noisy_maps(seed)]
    fused = maps
    if len(seeds) > 1:
        maps = [replace(one, index=5 * number % len(maps)) for number, one in enumerate(maps)]
        fused = maps[10:11]  # one of the finest
    num_found = 0
    for one in fused:
        others = [other for other in maps if other is not one]
        numbers = list(range(1, 1 + len(others))) if stations is None else stations
        expected, clearance = oracle.fuse_view(one, others, options, numbers)
        clear = clearance > 1e-4
        assert clear.mean() > 0.98
        with lending(2):
            (points, words), *more = fuse_view(one, others, options, stations=stations)
        assert not more
        seen = (points["xyz"].astype(float) @ one.view.R.T + one.view.t) @ one.view.K.T
        found = {}
        position = 0
        for point, pixel in zip(points, np.rint(seen[:, :2] / seen[:, 2:]).astype(int).tolist(), strict=True):
            listed = tuple(words[position + 1 : position + 1 + words[position]].tolist())
            position += 1 + int(words[position])
            found[tuple(pixel)] = (*(point[name] for name in ("xyz", "normal", "rgb")), listed)
        assert position == len(words)
        assert len(found) == len(points)
        pixels = {tuple(p) for p in np.argwhere(clear.T).tolist()}
        both = sorted(found.keys() & pixels)
        assert both == sorted(expected.keys() & pixels)
        num_found += len(found)
        place, normal, rgb, views = zip(*(found[pixel] for pixel in both), strict=True)
        true_place, true_normal, true_rgb, true_views = zip(*(expected[pixel] for pixel in both), strict=True)
        assert views == true_views
        np.testing.assert_array_equal(rgb, true_rgb)
        np.testing.assert_allclose(place, true_place, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(normal, true_normal, atol=1e-6)
    assert num_found > 100


@pytest.mark.parametrize("seed", [0, 1])
def test_gates_are_the_oracles(seed):
    """Of every pixel with a depth: what keeps a partner from agreeing, how far it is from that one's centre."""
    options = FusionOptions(max_depth_error=0.008, max_normal_error=15.0)
    seen = set()
    for one, other in itertools.permutations(noisy_maps(seed), 2):
        rows, columns = np.nonzero(one.depth > 0)
        gate = np.empty(len(rows), np.uint8)
        distance = np.empty(len(rows), np.float32)
        _native.find_gates(
            one.depth,
            one.normals,
            other.depth,
            other.normals,
            pixel_transfer(one.view, other.view),
            one.view.R @ other.view.R.T,
            options.max_depth_error,
            np.cos(np.radians(options.max_normal_error)),
            rows.astype(np.int32),
            columns.astype(np.int32),
            gate,
            distance,
        )
        rays = np.linalg.solve(one.view.K, np.stack([columns, rows, np.ones(len(rows))])).T
        world = (rays * one.depth[rows, columns, None].astype(float) - one.view.t) @ one.view.R
        normals = one.normals[:, rows, columns].T.astype(float) @ one.view.R
        expected, far, clearance = oracle.gate(world, normals, other, options)
        clear = clearance > 1e-4
        np.testing.assert_array_equal(gate[clear], expected[clear])
        np.testing.assert_allclose(distance[clear], far[clear], rtol=1e-6, atol=1e-4)
        seen |= set(expected[clear].tolist())
    assert seen == {0, 1, 2, 3}


def random_maps(rng, count):
    """Views in the midst of pixels: each has some in view, and others behind or beside it."""
    maps = []
    for index in range(count):
        width, height = int(rng.integers(60, 300)), int(rng.integers(4, 30))
        R, _ = cv2.Rodrigues(rng.normal(0, 0.7, 3))
        K = syn.pinhole(float(rng.uniform(30, 120)), width, height)
        view = View(index + 1, f"{index}.png", width, height, K, R, rng.normal(0, 1, 3), np.empty(0, np.int64))
        # Steps as at the edges of things, noise, and holes; some rows are empty.
        steps = rng.uniform(0.5, 6, (height, width // 20 + 1)).repeat(20, axis=1)[:, :width]
        depth = (steps * rng.uniform(0.99, 1.01, steps.shape)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.2] = 0
        depth[rng.random(height) < 0.1] = rng.choice([0, -1, np.nan])
        normals = np.broadcast_to(R[:, 2].astype(np.float32)[:, None, None], (3, *depth.shape)).copy()
        maps.append(ViewMaps(view, index, depth, normals, np.zeros((*depth.shape, 3), np.uint8)))
    return maps


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_no_pixel_is_passed_over_that_a_partner_has_in_view(seed):
    """Blocks of pixels are passed over that are out of view as a whole: pixel by pixel the same agree."""
    gates = (0.3, -1.0)
    agree = out_of_view = 0
    for one, other in itertools.permutations(random_maps(np.random.default_rng(seed), 10), 2):
        transfer, turn = pixel_transfer(one.view, other.view), one.view.R @ other.view.R.T
        covered, colour = np.zeros(one.depth.shape, np.uint8), np.zeros((*one.depth.shape, 3), np.uint16)
        agreeing = np.zeros((1, *one.depth.shape), np.uint8)
        rays = [np.linalg.inv(maps.view.K) for maps in (one, other)]
        _native.fuse_partner(
            one.depth, one.normals, rays[0], other.depth, other.normals, rays[1], other.image, transfer, turn,
            0.0, *gates, False, 0, 0, len(one.depth), covered, agreeing, colour,
        )  # fmt: skip
        agreeing = agreeing[0]
        rows, columns = np.nonzero(one.depth > 0)
        gate, distance = np.empty(len(rows), np.uint8), np.empty(len(rows), np.float32)
        places = (rows.astype(np.int32), columns.astype(np.int32))
        _native.find_gates(
            one.depth, one.normals, other.depth, other.normals, transfer, turn, *gates, *places, gate, distance
        )
        np.testing.assert_array_equal(agreeing[rows, columns], gate == 3)
        assert agreeing.sum() == agreeing[rows, columns].sum()
        agree += int(np.count_nonzero(gate == 3))
        out_of_view += int(np.count_nonzero(gate == 0))
    assert agree > 1000
    assert out_of_view > 1000


def test_bands_are_joined_in_order(yard, monkeypatch):
    whole = list(fuse_view(yard[0], yard[1:], FusionOptions()))
    assert len(whole) == 1
    monkeypatch.setattr(fusion, "_BAND_PIXELS", 7 * SIZE[0] + 5)
    bands = list(fuse_view(yard[0], yard[1:], FusionOptions()))
    assert len(bands) == -(-SIZE[1] // 7)
    for column in range(2):
        joined = np.concatenate([band[column] for band in bands])
        assert joined.tobytes() == whole[0][column].tobytes()
    assert whole[0][0].dtype == POINT


# ---- maps on disk, masks, options --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """Six views of a plane; not to be changed."""
    return make_workspace(tmp_path_factory.mktemp("exact") / "dense")


def sources_of(workspace, view, index, masks):
    depth, normals = (of(view.name, "geometric") for of in (workspace.depth_map_path, workspace.normal_map_path))
    mask = masks and masks / f"{view.name}.png"
    return MapSources(view, index, depth, normals, workspace.image_path(view.name), mask)


def test_maps_are_read_as_they_were_written(workspace):
    view = read_scene(workspace.sparse_dir).views[2]
    maps = read_view_maps(sources_of(workspace, view, 5, None))
    assert (maps.view, maps.index) == (view, 5)
    assert maps.nbytes == 19 * WIDTH * HEIGHT
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.linalg.inv(view.K) @ np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)])
    world = view.R.T @ (rays * maps.depth.ravel() - view.t[:, None])
    normal = view.R.T @ maps.normals.reshape(3, -1)
    np.testing.assert_allclose((normal * world).sum(axis=0), 0, atol=1e-5)
    assert (normal[2] > 0.8).all()
    image = cv2.imread(str(workspace.image_path(view.name)))
    np.testing.assert_array_equal(maps.image, image)


def test_masks(workspace, tmp_path):
    """What is black is neither made a point nor seen by one; an image without a mask is used whole."""
    view = read_scene(workspace.sparse_dir).views[0]
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :50] = 0
    whole = read_view_maps(sources_of(workspace, view, 0, tmp_path))
    cv2.imwrite(str(tmp_path / f"{view.name}.png"), mask)
    masked = read_view_maps(sources_of(workspace, view, 0, tmp_path))
    assert (whole.depth > 0).all()
    np.testing.assert_array_equal(masked.depth, np.where(mask > 0, whole.depth, 0))
    cv2.imwrite(str(tmp_path / f"{view.name}.png"), mask[:-1])
    with pytest.raises(InputError, match=rf"{view.name}.*{WIDTH} x {HEIGHT}"):
        read_view_maps(sources_of(workspace, view, 0, tmp_path))


@pytest.mark.parametrize("what", ["depth", "normals", "image"])
@pytest.mark.parametrize("kind", ["missing", "cut off", "other size"])
def test_what_cannot_be_fused_is_named(what, kind, tmp_path):
    workspace = make_workspace(tmp_path / "dense")
    view = read_scene(workspace.sparse_dir).views[1]
    path = {
        "depth": workspace.depth_map_path(view.name, "geometric"),
        "normals": workspace.normal_map_path(view.name, "geometric"),
        "image": workspace.image_path(view.name),
    }[what]
    if kind == "missing":
        path.unlink()
    elif kind == "cut off":
        path.write_bytes(path.read_bytes()[:40])
    elif what == "image":
        cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    else:
        shape = (HEIGHT, WIDTH + 1) if what == "depth" else (HEIGHT, WIDTH + 1, 3)
        write_maps(workspace, view.name, **{what: np.ones(shape)})
    with pytest.raises(InputError, match=view.name if kind == "other size" else str(path)):
        read_view_maps(sources_of(workspace, view, 1, None))


def test_unknown_method():
    error = assert_refused(FusionOptions(method="pmvs"), "method")  # type: ignore[arg-type]  # as untyped code may
    assert "'best-pixel' or 'colmap', not 'pmvs'" in str(error)


def test_reprojection_takes_no_points_from_us(workspace):
    """What a narrow gate keeps apart agrees all the same; COLMAP's fusion loses it (see its tests)."""
    options = FusionOptions(max_reproj_error=0.02)
    losses = explain_losses(stored_maps(workspace), read_scene(workspace.sparse_dir), options)
    assert losses.kept > 0.9
    assert losses.reprojection == 0


def test_mask_folder_must_exist():
    with pytest.raises(OptionError, match="/nowhere/masks"):
        RunOptions(fusion=FusionOptions(mask_path=Path("/nowhere/masks"))).check()


# ---- less memory -------------------------------------------------------------------------------------------


def unit_vectors(rng, count):
    """(count, 3) float32: in all directions, along axes and planes, nearly so, and none."""
    vectors = rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-9, 1, (count, 3))
    vectors[::7] = rng.integers(-1, 2, vectors[::7].shape)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(length > 0, length, 1)).astype(np.float32)


def maps_with(normals):
    """Maps with (H, W, 3) normals, of no other meaning."""
    shape = normals.shape[:2]
    planes = np.ascontiguousarray(np.moveaxis(normals, 2, 0))
    view = View(1, "a.png", shape[1], shape[0], np.eye(3), np.eye(3), np.zeros(3), np.empty(0, np.int64))
    return ViewMaps(view, 0, np.ones(shape, np.float32), planes, np.zeros((*shape, 3), np.uint8))


@pytest.mark.parametrize("seed", range(4))
def test_packed_maps_are_the_same_to_the_bit(seed):
    rng = np.random.default_rng(seed)
    normals = unit_vectors(rng, 300 * 200).reshape(300, 200, 3)
    normals[5:9] = 0
    maps = maps_with(normals)
    packed = PackedMaps.of(maps)
    assert packed is not None
    assert packed.nbytes == 16 * normals.size // 3 < maps.nbytes
    assert packed.maps.depth is maps.depth
    np.testing.assert_array_equal(packed.unpacked().normals.view(np.uint32), maps.normals.view(np.uint32))


@pytest.mark.parametrize(
    "normal", [(0, 0, -1.001), (0.5, 0, 0), (-0.0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 0), (0, 2, 0)]
)
def test_what_is_no_unit_vector_is_not_packed(normal):
    normals = unit_vectors(np.random.default_rng(0), 200).reshape(20, 10, 3)
    normals[7, 3] = normal
    assert PackedMaps.of(maps_with(normals)) is None


def large_view(scale=1):
    size = (800 * scale, 600 * scale)
    K = syn.pinhole(500.0 * scale, *size)
    return View(1, "a.png", *size, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))


def plain_maps(view, index):
    """Maps of a plane before the camera, which only the caller has."""
    shape = (view.height, view.width)
    normals = np.zeros((3, *shape), np.float32)
    normals[2] = -1
    return ViewMaps(view, index, np.full(shape, 10, np.float32), normals, np.full((*shape, 3), 100, np.uint8))


@pytest.mark.parametrize(("partners", "reserved"), [(1, 43), (9, 44)])
def test_fusion_takes_what_is_reserved(partners, reserved, monkeypatch):
    """16 bytes per pixel of a view's maps, 19 of a partner's, 6 of colours, 1 of being covered; and the bits."""
    monkeypatch.setattr(fusion, "_BAND_PIXELS", 1 << 12)
    view = large_view()
    tracemalloc.start()
    others = (plain_maps(view, index) for index in range(1, 1 + partners))
    parts = fuse_view(plain_maps(view, 0), others, EVERY_PIXEL, stations=range(1, 1 + partners))
    points = sum(len(some) for some, _ in parts)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert points == view.num_pixels
    assert fusion_parts._bytes_to_fuse(partners) + fusion_parts._MAPS_BYTES == reserved
    assert reserved - 0.5 < peak / view.num_pixels < reserved + 0.5


@pytest.mark.parametrize("ending", ["jpg", "png"])
@pytest.mark.parametrize("of_image", [1, 2])
@pytest.mark.parametrize("of_maps", [1, 2])
@pytest.mark.parametrize("taken_by", ["nothing", "mask", "view beside"])
def test_reading_takes_what_is_reserved(ending, of_image, of_maps, taken_by, tmp_path, monkeypatch):
    """Images and maps may have more pixels than are fused."""
    monkeypatch.setattr(map_files, "_BAND_VALUES", 1 << 12)
    monkeypatch.setattr(owners, "_BAND_PIXELS", 1 << 10)
    view, map_view, file_view = large_view(), large_view(of_maps), large_view(of_image)
    if of_image > 1:
        view = replace(view, full_size=(file_view.width, file_view.height))
    paths = [tmp_path / name for name in ("depth.bin", "normals.bin", f"image.{ending}", "mask.png")]
    maps = plain_maps(map_view, 0)
    write_depth_map(paths[0], maps.depth)
    write_normal_map(paths[1], np.moveaxis(maps.normals, 0, 2))
    cv2.imwrite(str(paths[2]), np.full((file_view.height, file_view.width, 3), 100, np.uint8))
    cv2.imwrite(str(paths[3]), np.full((file_view.height, file_view.width), 255, np.uint8))
    del maps
    larger = map_view if of_maps > 1 else None
    turned = replace(view, name="b.png", R=cv2.Rodrigues(np.array([0, 1.5, 0]))[0])
    beside = (turned,) if taken_by == "view beside" else ()
    mask = paths[3] if taken_by == "mask" else None
    sources = MapSources(view, 0, paths[0], paths[1], paths[2], mask, map_view=larger, beside=beside)
    tracemalloc.start()
    read = read_view_maps(sources)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.abs(read.depth[:, 300:500] - 10).max() < 1e-5
    reserved = fusion_parts._bytes_to_read(sources)
    assert 0.4 * reserved < peak < reserved + 0.5 * view.num_pixels
