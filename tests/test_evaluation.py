"""Scores of clouds against answers that arithmetic gives."""

import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import assert_refused
from scipy.special import erf

from colmap_sph.errors import InputError, NoResultError, OptionError, OutputError
from colmap_sph.evaluation import (
    EvaluationOptions,
    Mesh,
    PointCloud,
    evaluate_cloud,
    format_clouds,
    make_reference,
    write_json,
)
from colmap_sph.evaluation.geometry_io import require
from colmap_sph.evaluation.neighbours import PointIndex, thin, voxel_centroids, voxel_keys

FIXED = EvaluationOptions(tau=(0.05, 0.25), register=False)


def plane(columns: int = 100, rows: int = 80, spacing: float = 0.1) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns) * spacing, np.arange(rows) * spacing, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def scores_of(cloud: np.ndarray, reference: np.ndarray | Mesh, options: EvaluationOptions = FIXED):
    truth = reference if isinstance(reference, Mesh) else PointCloud("reference", reference)
    return evaluate_cloud(PointCloud("cloud", cloud), make_reference(truth, options), options)


def test_a_copy_is_perfect():
    scores = scores_of(plane(), plane())
    assert scores.cloud_to_reference.mean == 0 and scores.cloud_to_reference.maximum == 0
    assert all(one.accuracy == one.completeness == one.f_score == 1 for one in scores.thresholds)
    assert scores.point_count == scores.judged_count == scores.reference_count == 8000


def test_a_lifted_plane_is_its_height_away():
    scores = scores_of(plane() + np.array([0, 0, 0.12]), plane())
    assert scores.cloud_to_reference.mean == pytest.approx(0.12, rel=1e-12)
    assert scores.cloud_to_reference.standard_deviation == pytest.approx(0, abs=1e-12)
    strict, loose = scores.thresholds
    assert (strict.accuracy, strict.completeness, strict.f_score) == (0, 0, 0)
    assert (loose.accuracy, loose.completeness, loose.f_score) == (1, 1, 1)


def test_half_a_plane_is_accurate_and_half_complete():
    reference = plane(columns=100)
    scores = scores_of(reference[reference[:, 0] < 4.95], reference)
    strict, loose = scores.thresholds
    assert strict.accuracy == loose.accuracy == 1
    assert strict.completeness == pytest.approx(0.5)
    assert strict.f_score == pytest.approx(2 / 3)
    # The two next columns of the reference lie within 0.25 m of the cloud's rim.
    assert loose.completeness == pytest.approx(0.52)


def test_noise_has_the_distances_of_the_half_normal_distribution():
    sigma = 0.1
    corners = np.array([[0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0.0]])
    mesh = Mesh("ground", corners, np.array([[0, 1, 2], [0, 2, 3]]))
    random = np.random.default_rng(3)
    cloud = np.column_stack([random.random((100_000, 2)) * 50, random.normal(0, sigma, 100_000)])
    options = EvaluationOptions(tau=(0.05, 0.1, 0.2), register=False, crop="none", truth_spacing=0.2)
    scores = scores_of(cloud, mesh, options)
    assert scores.cloud_to_reference.mean == pytest.approx(sigma * math.sqrt(2 / math.pi), rel=0.01)
    assert scores.cloud_to_reference.standard_deviation == pytest.approx(
        sigma * math.sqrt(1 - 2 / math.pi), rel=0.01
    )
    for one in scores.thresholds:
        assert one.accuracy == pytest.approx(erf(one.tau / sigma / math.sqrt(2)), abs=0.005)


def test_a_cap_replaces_larger_distances():
    reference = plane()
    outlier = np.array([[5.0, 4.0, 10.0]])
    options = replace(FIXED, crop="none", distance_cap=0.5)
    scores = scores_of(np.concatenate([reference, outlier]), reference, options)
    assert scores.cloud_to_reference.maximum == 0.5
    assert scores.cloud_to_reference.mean == pytest.approx(0.5 / 8001)
    uncapped = scores_of(np.concatenate([reference, outlier]), reference, replace(FIXED, crop="none"))
    assert uncapped.cloud_to_reference.maximum == pytest.approx(10, rel=1e-3)


def test_cropping_leaves_out_what_the_reference_does_not_cover():
    beside, above = np.array([[-3.0, 4, 0]]), np.array([[5.0, 4, 30]])
    cloud = np.concatenate([plane(), beside, above])
    judged = {crop: scores_of(cloud, plane(), replace(FIXED, crop=crop)).judged_count for crop in
              ("none", "horizontal", "box", "auto")}  # fmt: skip
    assert judged == {"none": 8002, "horizontal": 8001, "box": 8000, "auto": 8000}
    las = PointCloud("ground.las", plane(), z_is_up=True)
    scores = evaluate_cloud(PointCloud("cloud", cloud), make_reference(las, FIXED), FIXED)
    assert scores.judged_count == 8001


def test_tau_counts_in_gsd_where_one_is_given():
    options = EvaluationOptions(gsd=0.1, register=False)
    scores = scores_of(plane() + np.array([0, 0, 0.15]), plane(), options)
    assert [one.tau for one in scores.thresholds] == pytest.approx([0.1, 0.2, 0.4])
    assert [one.accuracy for one in scores.thresholds] == [0, 1, 1]
    assert "acc 2 GSD" in format_clouds([scores])


def test_eth3d_weighs_space_and_not_points():
    # Ten good points share one voxel, one bad point has another: 10/11 of the points, half of the space.
    good = np.tile([[0.5, 0.5, 0.5]], (10, 1)) + np.arange(10)[:, None] * 1e-3
    cloud = np.concatenate([good, [[20.5, 0.5, 0.5]]])
    reference = np.concatenate([good, [[40.5, 0.5, 0.5]]])
    points = scores_of(cloud, reference, EvaluationOptions(tau=(0.1,), register=False))
    voxels = scores_of(cloud, reference, EvaluationOptions(tau=(0.1,), register=False, definition="eth3d"))
    assert points.thresholds[0].accuracy == pytest.approx(10 / 11)
    assert points.thresholds[0].completeness == pytest.approx(10 / 11)
    assert voxels.thresholds[0].accuracy == pytest.approx(0.5)
    assert voxels.thresholds[0].completeness == pytest.approx(0.5)


def test_tanks_and_temples_thins_to_centroids_of_half_tau():
    # A hundred points in one voxel of τ/2 become one; distances must be below τ, not equal to it.
    clump = np.random.default_rng(0).random((100, 3)) * 0.02
    far = np.array([[0.0, 0, 5], [0, 5, 0], [5, 0, 0], [5, 5, 5.0]])
    options = EvaluationOptions(tau=(0.125,), register=False, definition="tanks-and-temples", crop="none")
    scores = scores_of(np.concatenate([clump, far]), np.concatenate([clump, far[:1]]), options)
    assert scores.thresholds[0].accuracy == pytest.approx(2 / 5)
    assert scores.thresholds[0].completeness == 1
    lifted = scores_of(far + np.array([0, 0, 0.125]), far, options)
    assert lifted.thresholds[0].accuracy == 0


def test_distances_to_a_mesh_are_exact():
    # A tetrahedron and points whose distances are known: above a face, beyond an edge, beyond a corner.
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    points = np.array([[1, 1, -0.5], [1.5, -1, -1], [-1, -1, -1], [2, 2, 2], [0, 0, 3.0]])
    exact = [0.5, math.sqrt(2), math.sqrt(3), 3 / math.sqrt(3), 0]
    reference = make_reference(Mesh("solid", vertices, faces), EvaluationOptions(truth_spacing=0.05))
    np.testing.assert_allclose(reference.distances(points, threads=1, bound=np.inf), exact, atol=1e-12)


def test_results_do_not_depend_on_the_number_of_threads():
    random = np.random.default_rng(5)
    cloud, reference = random.random((5000, 3)) * [9, 9, 1], random.random((5000, 3)) * [9, 9, 1]
    one, two = (scores_of(cloud, reference, EvaluationOptions(threads=count)) for count in (1, 2))
    assert replace(one, seconds=0, registration=None) == replace(two, seconds=0, registration=None)
    np.testing.assert_array_equal(one.registration.matrix, two.registration.matrix)


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 60))
@settings(max_examples=40)
def test_nearest_distances_are_those_of_brute_force(seed, cloud_count, query_count):
    random = np.random.default_rng(seed)
    points = random.normal(size=(cloud_count, 3)) * 10.0 ** random.integers(-3, 4) + random.normal(size=3) * 1e5
    queries = points[random.integers(0, cloud_count, query_count)] + random.normal(size=(query_count, 3))
    expected = np.linalg.norm(queries[:, None] - points[None], axis=2).min(axis=1)
    np.testing.assert_allclose(PointIndex(points).distances(queries), expected, rtol=1e-12)


def test_voxels():
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.3, 0.4], [1.2, 0.1, 0.1], [0.3, 0.1, 2.2]]) + 5e6
    assert len(set(voxel_keys(points, 1.0))) == 3
    assert sorted(thin(points, 1.0)) == [0, 2, 3]
    np.testing.assert_allclose(voxel_centroids(points, 100.0), [points.mean(axis=0)], rtol=1e-15)
    with pytest.raises(OptionError, match="too small"):
        voxel_keys(points * 1e9, 1e-9)


def test_evaluation_imports_no_stage():
    code = "import sys, colmap_sph.evaluation; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    ours = [name for name in done.stdout.split() if name.startswith("colmap_sph")]
    others = [name for name in ours if not name.startswith(("colmap_sph.evaluation", "colmap_sph.platforms"))]
    assert others == ["colmap_sph", "colmap_sph.errors"]


def test_a_missing_library_is_named():
    with pytest.raises(InputError, match=r"needs no_such_library: pip install no_such_library"):
        require("no_such_library")


def test_scores_survive_json(tmp_path: Path):
    scores = scores_of(plane(), plane(), EvaluationOptions())
    write_json(tmp_path / "scores.json", [scores.as_dict()])
    loaded = json.loads((tmp_path / "scores.json").read_text())[0]
    assert loaded["point_count"] == 8000
    assert loaded["thresholds"][0]["f_score"] == 1
    assert np.allclose(loaded["registration"]["reference_from_cloud"], np.eye(4), atol=1e-4)
    with pytest.raises(OutputError, match=r"scores\.json cannot be written"):
        write_json(tmp_path / "absent" / "scores.json", [])


def test_the_table_names_each_cloud():
    text = format_clouds([scores_of(plane(), plane()), scores_of(plane() + np.array([0, 0, 0.1]), plane())])
    lines = text.splitlines()
    assert sum(line.startswith("cloud ") for line in lines) == 3
    assert "100.00 %" in text and "not registered" in text
    assert format_clouds([]) == ""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tau": (0.1, 0.0)}, "tau must be a positive number, not 0"),
        ({"tau": (-1.0,)}, "tau must be"),
        ({"tau": (float("nan"),)}, "tau must be"),
        ({"gsd": 0.0}, "gsd must be"),
        ({"voxel_size": -1.0}, "voxel_size must be"),
        ({"distance_cap": 0.0}, "distance_cap must be"),
        ({"registration_distance": math.inf}, "registration_distance must be"),
        ({"truth_spacing": 0.0}, "truth_spacing must be"),
        ({"definition": "dtu"}, "definition must be"),
        ({"crop": "polygon"}, "crop must be"),
        ({"reference_shift": (1.0, math.nan, 0.0)}, "reference_shift must be"),
        ({"min_view_count": 0}, "min_view_count must"),
        ({"threads": -1}, "threads must"),
    ],
)
def test_options_out_of_bounds_are_named(change, message):
    error = assert_refused(EvaluationOptions(**change), *change)
    assert str(error).startswith(message)


def test_bad_clouds_are_named():
    with pytest.raises(InputError, match="nothing is empty"):
        PointCloud("nothing", np.empty((0, 3)))
    broken = plane()
    broken[7, 2] = np.nan
    with pytest.raises(InputError, match="a: 1 of 8000 points have coordinates that are NaN"):
        PointCloud("a", broken)
    with pytest.raises(InputError, match="no faces"):
        Mesh("m", plane(), np.empty((0, 3), np.int64))
    with pytest.raises(InputError, match="degenerate"):
        make_reference(Mesh("m", plane(), np.array([[0, 0, 1]])))


def test_clouds_that_do_not_meet_say_where_they_are():
    with pytest.raises(InputError, match=r"do not overlap: cloud lies around \(105, 4, 0\)"):
        scores_of(plane() + np.array([100, 0, 0]), plane())
    # The boxes meet, the points do not.
    with pytest.raises(NoResultError, match="no point of cloud lies within"):
        scores_of(np.array([[-5.0, 4, 0], [15, 4, 0]]), plane())


def test_map_coordinates_against_a_local_model_say_what_to_do():
    offset = np.array([500_000.0, 5_400_000, 300])
    utm = PointCloud("lidar.laz", plane() + offset, crs="projected (UTM 33N)", z_is_up=True)
    cloud = PointCloud("fused.ply", plane())
    with pytest.raises(
        InputError, match=r"lidar\.laz is in map coordinates \(projected \(UTM 33N\)\).*--reference-shift"
    ):
        evaluate_cloud(cloud, make_reference(utm, FIXED), FIXED)
    shifted = replace(FIXED, reference_shift=tuple(offset))
    assert evaluate_cloud(cloud, make_reference(utm, shifted), shifted).thresholds[0].f_score == 1
    degrees = PointCloud("lidar.laz", plane(), crs="geographic (WGS 84)")
    with pytest.raises(InputError, match="reproject"):
        evaluate_cloud(cloud, make_reference(degrees, FIXED), FIXED)


@pytest.mark.parametrize("width", [40, 60, 80, 100, 146])
def test_tables_fit_a_width(width: int) -> None:
    """Columns that find no room stand below; none is lost, and each has its row's name."""
    scores = [scores_of(plane(), plane()), scores_of(plane() + np.array([0, 0, 0.1]), plane())]
    text = format_clouds(scores, width)
    wide = format_clouds(scores).split("\n\n")[1].splitlines()
    tables = text.split("\n\n")[1:-1]
    assert all(len(line) <= width for table in tables for line in table.splitlines())
    if width > 40:  # what is told of a distance stands side by side
        told = [sorted(re.findall(r"(acc|comp|F) ([\d.]+ m)", table)) for table in tables]
        assert all(len(each) % 3 == 0 for each in told) and sum(map(len, told)) == 6
    columns = [re.split(r" {2,}", line) for line in wide]
    for row, cells in enumerate(columns):
        parts = [re.split(r" {2,}", table.splitlines()[row]) for table in tables]
        assert {part[0] for part in parts} == {cells[0]}
        assert [cell for part in parts for cell in part[1:]] == cells[1:]
