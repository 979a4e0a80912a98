"""Depth maps and visible surfaces against planes whose depth is a formula."""

import numpy as np
import pytest

from colmap_sph.errors import InputError, NoResultError, OptionError
from colmap_sph.evaluation import (
    DepthView,
    EvaluationOptions,
    PointCloud,
    compare_depth_map,
    count_views,
    evaluate_cloud,
    format_depth_maps,
    make_reference,
    mean_of_depth_maps,
    truth_at_pixel_origin,
    truth_normals_at_pixel_origin,
    visible_surface,
)

FOCAL, WIDTH, HEIGHT = 100.0, 120, 90
K = np.array([[FOCAL, 0, 60.0], [0, FOCAL, 45.0], [0, 0, 1]])


def plane_depth(normal, distance, *, shift: float) -> np.ndarray:
    """z-depth of the plane n · x = distance along the rays K⁻¹ (column + shift, row + shift, 1)."""
    column, row = np.meshgrid(np.arange(WIDTH) + shift, np.arange(HEIGHT) + shift)
    rays = np.stack([(column - K[0, 2]) / FOCAL, (row - K[1, 2]) / FOCAL, np.ones_like(row)], axis=2)
    return distance / (rays @ np.asarray(normal))


def view(name: str, x: float, depth: np.ndarray) -> DepthView:
    return DepthView(name, K, np.eye(3), np.array([-x, 0, 0]), lambda: depth.astype(np.float32))


def test_truth_moves_from_pixel_centres_to_pixel_corners_exactly():
    normal = [0.3, -0.5, 1.0]
    corner = truth_at_pixel_origin(plane_depth(normal, 10, shift=0.5), edge_tolerance=0.01)
    exact = plane_depth(normal, 10, shift=0.0)
    assert not corner[0].any() and not corner[:, 0].any()
    np.testing.assert_allclose(corner[1:, 1:], exact[1:, 1:], rtol=1e-6)


def test_truth_normals_are_those_of_the_plane():
    normal = np.array([0.3, -0.5, 1.0])
    normals = truth_normals_at_pixel_origin(plane_depth(normal, 10, shift=0.5), K, edge_tolerance=0.01)
    assert not normals[0].any() and not normals[:, 0].any()
    exact = -normal / np.linalg.norm(normal)
    np.testing.assert_allclose(normals[1:, 1:], np.broadcast_to(exact, (HEIGHT - 1, WIDTH - 1, 3)), atol=1e-6)
    step = np.full((HEIGHT, WIDTH), 10.0)
    step[:, 60:] = 9.9
    normals = truth_normals_at_pixel_origin(step, K)
    assert not normals[:, 60].any() and normals[1:, 61:].any(axis=2).all()


def test_truth_leaves_out_edges_and_nothing_else():
    depth = np.full((HEIGHT, WIDTH), 10.0)
    depth[:, 60:] = 9.9
    depth[30, 20] = 0
    corner = truth_at_pixel_origin(depth)
    missing = corner == 0
    expected = np.zeros_like(missing)
    expected[0] = True
    expected[:, 0] = True
    expected[:, 60] = True
    expected[30:32, 20:22] = True
    np.testing.assert_array_equal(missing[:, :58], expected[:, :58])
    assert missing[:, 60].all() and not missing[1:, 61:].any()


def test_scores_of_a_map_with_known_errors():
    truth = np.full((HEIGHT, WIDTH), 50.0, np.float32)
    truth[:10] = 0
    depth = truth.copy()
    depth[:10] = 7  # where no truth is, nothing is judged
    depth[10:20] = 0  # an eighth is missing
    depth[20:30] += 0.75  # a seventh of the rest is 1.5 GSD off
    depth[30:40] -= 5  # a seventh is 10 GSD off
    scores = compare_depth_map(depth, truth, gsd=0.5)
    assert scores.coverage == pytest.approx(7 / 8)
    assert scores.within == pytest.approx((5 / 7, 6 / 7, 6 / 7))
    assert scores.complete_within == pytest.approx((5 / 8, 6 / 8, 6 / 8))
    assert scores.median_error == 0
    per_pixel = compare_depth_map(depth, truth, gsd=truth / FOCAL)
    assert per_pixel.within == scores.within


def test_normals_are_compared_by_their_angle():
    truth = np.full((4, 5), 2.0, np.float32)
    exact = np.zeros((4, 5, 3), np.float32)
    exact[..., 2] = -1
    tilted = np.zeros_like(exact)
    tilted[..., 0], tilted[..., 2] = np.sin(0.1), -np.cos(0.1)
    tilted[0] = 0
    scores = compare_depth_map(truth, truth, gsd=1, normals=tilted, truth_normals=exact)
    assert scores.median_normal_angle == pytest.approx(np.degrees(0.1), abs=1e-4)
    assert scores.normal_coverage == pytest.approx(0.75)
    with pytest.raises(InputError, match="both normal maps"):
        compare_depth_map(truth, truth, gsd=1, normals=tilted)


def test_an_empty_map_has_no_median():
    truth = np.ones((4, 4), np.float32)
    empty = compare_depth_map(np.zeros_like(truth), truth, gsd=1)
    full = compare_depth_map(truth, truth, gsd=1)
    assert empty.coverage == 0 and empty.within == (0, 0, 0) and np.isnan(empty.median_error)
    assert empty.as_dict()["median_error_gsd"] is None
    mean = mean_of_depth_maps({"a": empty, "b": full})
    assert mean.coverage == 0.5 and mean.median_error == 0
    assert format_depth_maps({"a": empty, "b": full}).splitlines()[-1].startswith("mean")


def test_bad_depth_maps_are_refused():
    truth = np.ones((4, 4), np.float32)
    with pytest.raises(InputError, match="same size"):
        compare_depth_map(truth[:2], truth, gsd=1)
    with pytest.raises(InputError, match="per-pixel GSD"):
        compare_depth_map(truth, truth, gsd=truth[:2])
    with pytest.raises(OptionError, match="GSD must be positive"):
        compare_depth_map(truth, truth, gsd=0)
    with pytest.raises(OptionError, match="thresholds"):
        compare_depth_map(truth, truth, gsd=1, thresholds=(1, -2))
    with pytest.raises(NoResultError, match="no pixel"):
        compare_depth_map(truth, np.zeros_like(truth), gsd=1)


def test_visible_surface_counts_views_and_knows_what_is_hidden():
    # A wall at 10 m, and in front of its middle a screen at 5 m; the second camera stands 1 m to the right.
    wall = np.full((HEIGHT, WIDTH), 10.0)
    depths = []
    for eye in (0.0, 1.0):
        depth = wall.copy()
        # The screen reaches from -1 to 1 m: columns f (X - eye) / 5 + 60.
        left, right = (round(FOCAL * (edge - eye) / 5 + 60) for edge in (-1.0, 1.0))
        depth[:, left:right] = 5.0
        depths.append(view(f"camera {eye}", eye, depth))
    surface = visible_surface(depths, 0.05)
    counts = count_views(surface, depths)
    on_wall = surface[:, 2] > 9
    x = surface[:, 0]
    # Behind the screen the left camera misses -2 … 2 m of the wall, the right one -3 … 1: none sees -2 … 1.
    assert not np.any(on_wall & (x > -1.9) & (x < 0.9))
    assert set(counts[on_wall & (x > -2.9) & (x < -2.1)]) == {1}
    assert set(counts[on_wall & (x > 1.1) & (x < 1.9)]) == {1}
    assert set(counts[on_wall & (x > 2.1) & (x < 5.9)]) == {2}
    assert set(counts[~on_wall & (np.abs(x) < 0.9)]) == {2}


def test_a_cloud_is_judged_by_what_the_views_see():
    depth = np.full((HEIGHT, WIDTH), 10.0)
    depth[:, :30] = 0
    views = [view("left", 0.0, depth), view("right", 2.0, np.full((HEIGHT, WIDTH), 10.0))]
    options = EvaluationOptions(tau=(0.15,), min_view_count=2)
    reference = make_reference(views, options)
    # Both see x = -3 … 6; one sees -4 … 8.
    assert reference.points[:, 0].min() == pytest.approx(-3, abs=0.1)
    assert reference.points[:, 0].max() == pytest.approx(6, abs=0.1)
    x, y = np.meshgrid(np.arange(-8, 1.5, 0.1), np.arange(-4, 4, 0.1))
    wall = np.stack([x.ravel(), y.ravel(), np.full(x.size, 10.0)], axis=1)
    floating = np.array([[0.0, 0, 8.0]])
    scores = evaluate_cloud(PointCloud("cloud", np.concatenate([wall, floating])), reference, options)
    assert scores.registration is None
    # Left of -4 m nobody has truth; the floating point is wrong, everything else is right.
    assert scores.judged_count == pytest.approx(np.sum(wall[:, 0] > -4) + 1, abs=160)
    assert scores.thresholds[0].accuracy == pytest.approx(1 - 1 / scores.judged_count)
    # The cloud ends at x = 1.4: 4.4 of the 9 metres, less the rim above and below it.
    assert scores.thresholds[0].completeness == pytest.approx(4.5 / 9 * 8.2 / 9, abs=0.03)


def test_truth_that_is_missing_is_refused():
    with pytest.raises(InputError, match="no image"):
        make_reference([])
    with pytest.raises(NoResultError, match="has a pixel with a depth"):
        visible_surface([view("a", 0, np.zeros((HEIGHT, WIDTH)))], 0.1)
    with pytest.raises(NoResultError, match="lower min_view_count"):
        make_reference([view("a", 0, np.full((HEIGHT, WIDTH), 10.0))])
    with pytest.raises(InputError, match="shape"):
        visible_surface([view("a", 0, np.zeros((2, 3, 4)))], 0.1)
