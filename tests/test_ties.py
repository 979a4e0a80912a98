"""Ties: what a pair's rows disagree by is measured as it was put in, and tolerances grow by it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import SIDES, disparities, exact_disparity, grey, pixel_rays, scene_of_pair

from colmap_sph import synthetic as syn
from colmap_sph.pipeline.checks.self_check import judge_rows
from colmap_sph.pipeline.report import RunReport
from colmap_sph.pipeline.stages.pair_files import facts_of_pair, read_pair, read_pair_with_ties, write_pair
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.confirm import ConfirmOptions, confirm_depth
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.poses.ties import MAX_TIES, Ties, filled_residuals, find_corners, find_ties, row_residual
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import PairDisparity, image_coordinates
from colmap_sph.stereo.vote import VoteOptions, vote_depth


@cache
def rendered(surface):
    """A rendered pair with its exact disparity: (views, images, geometry, disparity, synthetic pair)."""
    pair = syn.convergent_pair()
    scene, left, right = scene_of_pair(pair)
    geometry = rectify_pair(scene, left, right, RectificationOptions(surface=surface))
    disparity, seen = exact_disparity(pair.surfaces, left, right, geometry, "left")
    disparity = np.where(seen, disparity, np.nan).astype(np.float32)
    images = [grey(pair.render(side)) for side in SIDES]
    return (left, right), images, geometry, disparity, pair


@pytest.fixture(params=["spherical", "frame"])
def matched(request):
    return rendered(request.param)


def ties_of(matched, right_view=None):
    (left, right), images, geometry, disparity, _ = matched
    other = (right_view or right, images[1])
    return find_ties((left, images[0]), other, geometry, disparity, find_corners(images[0]))


def test_ties_of_exact_poses_lie_where_the_surface_is(matched):
    (left, right), _, geometry, _, pair = matched
    ties = ties_of(matched)
    assert 50 < len(ties) <= MAX_TIES
    residual = row_residual(ties)
    assert residual is not None and residual < 0.05
    # By the surfaces, not by the disparity map: where the point that a left place shows is in the right image.
    along = (ties.left[:, 0] + geometry.left_origin) / geometry.columns_per_radian
    across = (ties.left[:, 1] + geometry.row_origin) / geometry.rows_per_radian
    if geometry.surface == "spherical":
        along = np.arctan(geometry.flatness * along) / geometry.flatness
        rays = np.stack([np.sin(along), np.cos(along) * np.sin(across), np.cos(along) * np.cos(across)], axis=1)
    else:
        rays = np.stack([along, across, np.ones_like(along)], axis=1)
    camera = rays @ geometry.rectified_from_world @ left.R.T @ left.K.T
    pixel = camera[:, :2] / camera[:, 2:]
    distance = syn.trace_points(pair.surfaces, pair.left, pixel).distance
    points = left.center + distance[:, None] * pixel_rays(left, *pixel.T)
    exact, _, _ = disparities(geometry, left, right, points)
    errors = ties.left[:, 0] - ties.right[:, 0] - exact
    assert np.median(np.abs(errors)) < 0.1
    assert np.mean(np.abs(errors) < 0.4) > 0.95


def exact_right_places(matched, geometry, left_places):
    """Where the points that places in the left image show are in the right one: by the surfaces, (n, 2)."""
    (left, right), _, _, _, pair = matched
    pixel = image_coordinates(left, geometry, "left", left_places)
    distance = syn.trace_points(pair.surfaces, pair.left, pixel).distance
    points = left.center + distance[:, None] * pixel_rays(left, *pixel.T)
    return right.project(points)[0]


def test_what_was_matched_coarsely_is_measured_finely(matched):
    """A third of the rows and columns: fine windows know places in the images at least twice as well as coarse."""
    (left, right), images, fine, disparity, _ = matched
    coarse = fine.resampled(1 / 3)
    few = (disparity[::3, ::3] / 3)[: coarse.height, : coarse.left_width]
    errors = []
    for finer in (1.0, 3.0):
        photos = (left, images[0]), (right, images[1])
        ties = find_ties(*photos, coarse, few, find_corners(images[0]), finer)
        assert len(ties) > 20
        # Rectified pixels are those of the coarse geometry: corners lie where they are, rows agree.
        assert np.abs(ties.row_shifts).max() < 0.5
        there = image_coordinates(right, coarse, "right", ties.right)
        errors.append(there - exact_right_places(matched, coarse, ties.left))
    coarsely, finely = (np.median(np.linalg.norm(error, axis=1)) for error in errors)
    assert finely < 0.1
    assert finely < coarsely / 2


@pytest.mark.parametrize("pixels", [0.5, -1.25])
def test_a_camera_turned_about_the_baseline_shows_its_turn(pixels):
    """On the sphere such a turn moves all rows of the right image alike: by its angle times rows per radian."""
    matched = rendered("spherical")
    (_, right), _, geometry, _, _ = matched
    angle = pixels / geometry.rows_per_radian
    turn = cv2.Rodrigues(angle * geometry.rectified_from_world[0])[0]
    turned = replace(right, R=right.R @ turn, t=-right.R @ turn @ right.center)
    straight = ties_of(matched)
    ties = ties_of(matched, right_view=turned)
    assert len(ties) > 0.7 * len(straight)
    assert np.median(ties.row_shifts) == pytest.approx(pixels, abs=0.03)
    assert row_residual(ties) == pytest.approx(abs(pixels), abs=0.05)


def test_mismatches_and_noise_do_not_count():
    rng = np.random.default_rng(2)
    left = rng.uniform(0, 1000, (300, 2)).astype(np.float32)
    shifts = rng.normal(0, 0.5, 300)
    shifts[:30] = rng.uniform(3, 6, 30)
    right = (left + np.column_stack([np.zeros(300), shifts])).astype(np.float32)
    assert row_residual(Ties(left, right, np.full(300, 0.1, np.float32))) == pytest.approx(0.5, abs=0.06)
    # Windows that know their rows to half a pixel explain it all.
    assert row_residual(Ties(left, right, np.full(300, 0.6, np.float32))) == 0
    assert row_residual(Ties(left[:20], right[:20], np.zeros(20, np.float32))) is None


def test_no_texture_no_ties(matched):
    (left, right), images, geometry, disparity, _ = matched
    flat = np.full_like(images[0], 128)
    assert len(find_ties((left, flat), (right, flat), geometry, disparity, find_corners(flat))) == 0
    assert len(find_ties((left, images[0]), (right, images[1]), geometry, disparity, np.empty((0, 2)))) == 0
    nothing = np.full_like(disparity, np.nan)
    assert len(find_ties((left, images[0]), (right, images[1]), geometry, nothing, find_corners(images[0]))) == 0


def test_no_window_no_ties(matched):
    """A strip of a few rows holds none, and neither does an image without a corner."""
    (left, right), images, geometry, disparity, _ = matched
    corners = find_corners(images[0])
    strip = replace(geometry, height=5)
    assert len(find_ties((left, images[0]), (right, images[1]), strip, disparity[:5], corners)) == 0
    assert len(find_ties((left, images[0]), (right, images[1]), geometry, disparity, corners[:0])) == 0


def test_corners_are_where_squares_have_them():
    image = np.full((200, 300), 60, np.uint8)
    image[50:120, 80:200] = 190
    corners = find_corners(image)
    for true in ((80, 50), (200, 50), (80, 120), (200, 120)):
        assert np.hypot(*(corners[:8] - true).T).min() < 2.5


def test_tiny_images_have_no_corners():
    assert find_corners(np.zeros((5, 5), np.uint8)).shape == (0, 2)


def test_ties_are_kept_with_the_pair(tmp_path: Path, matched):
    _, _, geometry, disparity, _ = matched
    ties = ties_of(matched)
    pair = PairDisparity("a", "b", geometry, disparity)
    told = write_pair(tmp_path / "pair.sph", pair, "key", ties)
    assert facts_of_pair(tmp_path / "pair.sph", "key", "a", "b", geometry) == told
    assert told.row_residual == row_residual(ties) / geometry.columns_per_radian
    _, read = read_pair_with_ties(tmp_path / "pair.sph")
    for name in ("left", "right", "sigma"):
        assert np.array_equal(getattr(read, name), getattr(ties, name))
    assert write_pair(tmp_path / "pair.sph", pair, "key").row_residual is None
    assert len(read_pair_with_ties(tmp_path / "pair.sph")[1]) == 0
    assert read_pair(tmp_path / "pair.sph").disparity.shape == disparity.shape


def test_pairs_with_few_ties_have_the_median_of_the_others():
    assert filled_residuals([0.1, None, 0.3, 0.2]) == [0.1, 0.2, 0.3, 0.2]
    assert filled_residuals([None, None]) == [0, 0]


def facing_view(name: str, x: float) -> View:
    K = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    return View(1, name, 64, 48, K, np.eye(3), np.array([-x, 0, 0]), np.empty(0, np.int64))


def test_a_votes_standard_deviation_grows_by_the_residual():
    """σ_Z = Z σ_d / d on the plane, with σ_d = hypot(0.2 px times image pixels to a rectified one, s)."""
    left, right = facing_view("a", 0), facing_view("b", 1)
    scene_points = np.column_stack([np.zeros((101, 2)), np.linspace(9, 11, 101)])
    left, right = (replace(view, point_indices=np.arange(101)) for view in (left, right))
    geometry = rectify_pair(Scene((left, right), scene_points), left, right, RectificationOptions(surface="frame"))
    disparity = np.full((geometry.height, geometry.left_width), 10 - geometry.disparity_origin, np.float32)
    pair = PairDisparity("a", "b", geometry, disparity)
    focal = geometry.columns_per_radian
    disparity += np.float32(focal / 10 - 10)
    options = VoteOptions(disparity_sigma=0.2)
    exact = vote_depth(left, [pair], options)
    rough = vote_depth(left, [pair], options, None, [0.6 / focal])
    place = (24, 40)
    sigma = 0.2 * left.K[0, 0] / focal
    assert 0.16 < sigma < 0.2
    assert exact.depth[place] == pytest.approx(10, rel=1e-4)
    assert exact.sigma[place] == pytest.approx(10 * sigma / (focal / 10), rel=1e-3)
    assert rough.sigma[place] == pytest.approx(10 * np.hypot(sigma, 0.6) / (focal / 10), rel=1e-3)
    # Half the rectified pixels per pixel, and twice the standard deviation of each: four times as much in depth.
    coarse = replace(pair, geometry=geometry.resampled(0.5), disparity=disparity[::2, ::2] / np.float32(2))
    soft = vote_depth(left, [coarse], options)
    assert soft.sigma[place] == pytest.approx(4 * exact.sigma[place], rel=1e-2)


@pytest.mark.parametrize(("residual", "confirmed"), [(0.0, False), (0.004, False), (0.012, True)])
def test_points_may_come_back_farther_by_twice_the_residual(residual, confirmed):
    """A partner's depth that is off shifts the point by f b (1/z - 1/z'): 4 pixels here, against 2 + 2 s."""
    view, partner = facing_view("a", 0), facing_view("b", 1)
    shape = (48, 64)

    def estimate(depth):
        sigma = np.full(shape, 1.0, np.float32)
        return DepthEstimate(np.full(shape, depth, np.float32), sigma, np.full(shape, 2, np.uint8))

    off = 1 / (1 / 10 + 0.04)
    options = ConfirmOptions(min_consistent=1, min_surface=0)
    found = confirm_depth(view, estimate(10), [(partner, estimate(off))], options, None, [residual])
    assert (found.depth[20:28, 30:40] > 0).all() == confirmed
    assert (found.depth[20:28, 30:40] > 0).any() == confirmed


def test_a_run_tells_which_images_are_imprecise(matched):
    _, _, _, _, pair = matched
    scene, left, right = scene_of_pair(pair)
    focal = left.K[0, 0]
    report = RunReport()
    judge_rows(report, scene, {(left.name, right.name): 0.7 / focal})
    assert report.row_residual == pytest.approx(0.7, abs=1e-3)
    assert report.row_residuals[left.name] == pytest.approx(0.7, abs=1e-3)
    assert "Rows of pairs disagree by 0.70 pixels (0.2 expected)" in report.imprecision
    sound = RunReport()
    judge_rows(sound, scene, {(left.name, right.name): 0.1 / focal})
    assert sound.imprecision == ""
    judge_rows(sound, scene, {(left.name, right.name): None})
    assert sound.row_residual == pytest.approx(0.1, abs=1e-3)
