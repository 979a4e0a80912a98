"""The street canyon and the town: depth against rays cast anew, models, and what is found of the street."""

import importlib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_sph import synthetic as syn
from colmap_sph.errors import OptionError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import View

STREET = syn.CanyonOptions(width=240, height=160, images=6, points=1500, keypoint_noise=0.0)
TOWN = syn.TownOptions(
    width=120,
    height=80,
    nadir_gsd=0.8,
    oblique_gsd=0.92,
    strips=1,
    directions=4,
    direction_images=1,
    points=400,
    keypoint_noise=0.0,
    supersample=1,
)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> syn.Capture:
    return syn.make_canyon_block(tmp_path_factory.mktemp("street") / f"walk-{STREET.width}", STREET, threads=2)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> syn.Capture:
    return syn.make_town_block(tmp_path_factory.mktemp("town"), TOWN, threads=2)


# ---- rays cast anew -----------------------------------------------------------------------------------------


def depths_by_definition(surfaces: Sequence[syn.Surface], camera: syn.Camera, x, y):
    """Depth (N,) of the first surface at image coordinates, each surface by its own definition; inf where none."""
    rays = (np.linalg.inv(camera.K) @ np.stack([x, y, np.ones_like(x)])).T @ camera.R
    start = -camera.R.T @ camera.t
    return np.min([distances(surface, start, rays) for surface in surfaces], axis=0)


def distances(surface: syn.Surface, start, rays):
    if isinstance(surface, syn.ConvexPolyhedron):
        # Where a ray meets a face's plane it meets the solid, if it is inside of all others.
        found = np.full(len(rays), np.inf)
        for normal, offset in zip(surface.face_normals, surface.offsets, strict=True):
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = (offset - normal @ start) / (rays @ normal)
                place = start + distance[:, None] * rays
                inside = np.all(place @ surface.face_normals.T <= surface.offsets + 1e-9, axis=1)
            found = np.where(inside & (distance > 0) & (distance < found), distance, found)
        return found
    if isinstance(surface, syn.Ellipsoid):
        away, along = (start - surface.centre) / surface.radii, rays / surface.radii
        a, half_b, c = (along**2).sum(axis=1), along @ away, away @ away - 1
        with np.errstate(invalid="ignore"):
            distance = (-half_b - np.sqrt(half_b**2 - a * c)) / a
        return np.where(distance > 0, distance, np.inf)
    if isinstance(surface, syn.Plane):
        with np.errstate(divide="ignore"):
            distance = -start[2] / rays[:, 2]
        return np.where(distance > 0, distance, np.inf)
    assert isinstance(surface, syn.Terrain)
    # From above: the first of many steps that is below the ground, halved until it is on it.
    steps = np.arange(1, 600, 0.2)[:, None]
    below = start[2] + steps * rays[:, 2] < surface.height(
        start[0] + steps * rays[:, 0], start[1] + steps * rays[:, 1]
    )
    high = steps[np.argmax(below, axis=0), 0]
    low = high - 0.2
    for _ in range(50):
        middle = (low + high) / 2
        x, y, z = start[:, None] + middle * rays.T
        under = z < surface.height(x, y)
        low, high = np.where(under, low, middle), np.where(under, middle, high)
    return np.where(below.any(axis=0), high, np.inf)


@pytest.mark.parametrize("kind", ["street", "town"])
def test_depth_is_that_of_rays_cast_anew(kind: str, request: pytest.FixtureRequest):
    capture: syn.Capture = request.getfixturevalue(kind)
    rng = np.random.default_rng(0)
    met = 0
    for number in (0, len(capture.names) - 1):
        depth, normals = capture.truth(capture.names[number])
        row, column = rng.integers(0, depth.shape[0], 100), rng.integers(0, depth.shape[1], 100)
        expected = depths_by_definition(
            capture.surfaces, capture.cameras[number], column.astype(float), row.astype(float)
        )
        np.testing.assert_allclose(depth[row, column], np.where(np.isfinite(expected), expected, 0), rtol=1e-5)
        assert np.array_equal(depth > 0, normals.any(axis=2))
        met += int(np.isfinite(expected).sum())
    # The street has a sky, the town none.
    assert (100 < met < 190) if kind == "street" else met == 200


@pytest.mark.parametrize("kind", ["street", "town"])
def test_points_of_the_model_project_to_their_observations_and_are_seen(kind: str, request: pytest.FixtureRequest):
    capture: syn.Capture = request.getfixturevalue(kind)
    model = pycolmap.Reconstruction(capture.sparse_dir)
    assert sorted(image.name for image in model.images.values()) == sorted(capture.names)
    for image in model.images.values():
        observed = [point for point in image.points2D if point.has_point3D()]
        assert len(observed) > 50
        world = np.array([model.point3D(point.point3D_id).xyz for point in observed])
        pose = image.cam_from_world().matrix()
        in_camera = world @ pose[:, :3].T + pose[:, 3]
        homogeneous = in_camera @ image.camera.calibration_matrix().T
        places = np.array([point.xy for point in observed])
        np.testing.assert_allclose(homogeneous[:, :2] / homogeneous[:, 2:], places, atol=1e-6)
        some = slice(None, None, 40)
        camera = capture.cameras[capture.names.index(image.name)]
        nearest = depths_by_definition(capture.surfaces, camera, *places[some].T)
        np.testing.assert_allclose(nearest, in_camera[some, 2], rtol=1e-6)


@pytest.mark.parametrize("step", [1.0, 3.0])
def test_the_next_camera_of_the_street_is_inside_the_picture(step: float):
    cameras = list(syn.canyon_cameras(syn.CanyonOptions(step=step, images=16)).values())
    for camera, following in pairwise(cameras):
        assert np.linalg.norm(following.centre - camera.centre) == pytest.approx(step, rel=0.06)
        (x, y), depth = (part[0] for part in camera.project(following.centre[None]))
        assert depth > 0 and 0.2 < x / camera.width < 0.8 and 0.2 < y / camera.height < 0.8


def test_the_town_is_seen_from_all_around_and_rises_high(town: syn.Capture):
    cameras = dict(zip(town.names, town.cameras, strict=True))
    tilts = {name: np.degrees(np.arccos(-camera.R[2, 2])) for name, camera in cameras.items()}
    assert all(tilt < 10 for name, tilt in tilts.items() if name.startswith("N"))
    assert all(35 < tilt < 55 for name, tilt in tilts.items() if name.startswith("O"))
    first, second = (cameras[f"N_0_{number}.jpg"].centre for number in (0, 1))
    assert np.linalg.norm(second - first) == pytest.approx(0.2 * TOWN.width * TOWN.nadir_gsd)
    heights = town.sparse.points[:, 2]
    assert 25 < np.ptp(np.percentile(heights, [0.5, 99.5])) < 60


def test_nonsense_is_refused():
    with pytest.raises(OptionError, match=r"step = 0\.0 .*max_incidence = 95\.0 "):
        syn.CanyonOptions(step=0.0, max_incidence=95.0).check()
    with pytest.raises(OptionError, match=r"directions = 100 "):
        syn.TownOptions(directions=100).check()


# ---- what pairs find ----------------------------------------------------------------------------------------


def view_of(camera: syn.Camera, name: str) -> View:
    none = np.empty(0, np.int64)
    return View(1, name, camera.width, camera.height, camera.K, camera.R, camera.t, none)


@pytest.mark.usefixtures("scripts_on_path")
def test_what_both_images_see_is_what_no_surface_hides(street: syn.Capture):
    found = importlib.import_module("rectification_study.found")
    here, there = street.cameras[0], street.cameras[3]
    truth, other_truth = (street.truth(street.names[number])[0] for number in (0, 3))
    seen = found.seen_by_both(view_of(here, "a"), view_of(there, "b"), truth, other_truth)
    exact, _, _ = syn.exact_geometry(street.surfaces, here, origin=0.0)
    row, column = np.nonzero(exact > 0)
    points = here.back_project(np.column_stack([column, row]).astype(float), exact[row, column])
    image, depth = there.project(points)
    nearest = syn.trace_points(street.surfaces, there, image).distance
    inside = (depth > 0) & np.all((image > 0) & (image < [there.width - 1, there.height - 1]), axis=1)
    expected = np.zeros(seen.shape, bool)
    expected[row, column] = inside & (np.abs(nearest - depth) < 1e-6 * depth)
    assert 0.2 < expected.mean() < 0.8
    assert not seen[exact == 0].any()
    # At outlines the four pixels around hold both surfaces.
    assert (seen != expected).mean() < 0.03
    assert (seen & ~expected).sum() > 0.5 * (seen != expected).sum()


@pytest.mark.usefixtures("scripts_on_path")
def test_found_and_right_are_counted_in_percent_gsd_and_pixels_of_the_other_image():
    found = importlib.import_module("rectification_study.found")
    K = syn.pinhole(300.0, 60, 40)
    left = View(1, "a", 60, 40, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))
    # Disparity is 300 * 0.5 / 15 = 10 pixels: 50 of 60 columns are seen in both.
    right = View(2, "b", 60, 40, K, np.eye(3), np.array([-0.5, 0, 0]), np.empty(0, np.int64))
    truth = np.full((40, 60), 15.0, np.float32)

    def counted(factor: float) -> dict[str, int]:
        return found.count_pair((left, right), (truth * np.float32(factor), truth * 0), (truth, truth))

    # The last row and column have no four pixels around them.
    seen, half = counted(1.0)["seen"], counted(1.0)["found"]
    assert 39 * 49 <= half <= 39 * 50 and 39 * 49 <= seen - half <= 39 * 50
    assert counted(1.0) == dict.fromkeys(found.COUNTED, half) | {"seen": seen}
    # 0.5 % of depth is 1.5 GSD and a twentieth of a pixel; 5 % is half a pixel, 15 % more than one.
    assert counted(1.005)["within_1_percent"] == half and counted(1.005)["within_1_gsd"] == 0
    assert counted(1.05)["within_1_pixel"] == half and counted(1.05)["within_1_percent"] == 0
    assert counted(1.15)["within_1_pixel"] == 0 and counted(1.15)["found"] == half
    assert found.count_pair((left, right), None, (truth, truth)) == dict.fromkeys(found.COUNTED, 0) | {
        "seen": seen
    }
    assert found.shares(counted(1.005))["within_1_gsd_of_found"] == 0
    assert found.shares(counted(1.005))["found"] == half / seen


def rows_of(text: str) -> dict[str, list[float]]:
    """Rows of printed tables by their first cell; cells that are no numbers are NaN."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if "|" in line]
    return {row[0]: [float(cell) if cell[:1].isdigit() else np.nan for cell in row[1:]] for row in rows}


@pytest.mark.usefixtures("scripts_on_path")
def test_pairs_of_a_given_model_are_measured_with_its_exact_depth(tmp_path: Path) -> None:
    """In its unit; not without."""
    measure = importlib.import_module("measure_pairs")
    given = {"output": tmp_path, "model": tmp_path / "sparse", "depth_scale": 0.005}
    files = measure.files_of(measure.Measurement(**given, exact_depth=tmp_path / "depth"), tmp_path)
    assert (files.model, files.exact_depth, files.depth_scale) == (tmp_path / "sparse", tmp_path / "depth", 0.005)
    with pytest.raises(OptionError, match="--model needs --exact-depth"):
        measure.files_of(measure.Measurement(**given), tmp_path)


@pytest.mark.usefixtures("scripts_on_path")
def test_a_walk_down_the_street_is_reconstructed(street: syn.Capture, capsys: pytest.CaptureFixture[str]):
    scenes = importlib.import_module("rectification_study.scenes")
    scenes.write_exact_depth(street.names, street.cameras, street.surfaces, street.root / "depth")
    (street.root / "done").touch()
    measure = importlib.import_module("measure_pairs")
    capsys.readouterr()
    measure.main(measure.Measurement(street.root.parent, "walk", STREET.width, run=RunOptions(threads=2)))
    rows = rows_of(capsys.readouterr().out)
    pairs, not_rectified, found, _, _, within_1_pixel, _ = rows["1"]
    assert (pairs, not_rectified) == (5, 0)
    assert found > 0.75 and within_1_pixel > 0.93
    _, found, within_1_percent, _, of_sky = rows["geometric"]
    # A percent of the depth of what is far ahead is a twentieth of a pixel in pictures as small.
    assert found > 0.65 and within_1_percent > 0.45

    # The same from the maps themselves and the exact depth at their pixels, away from edges.
    workspace = Workspace(street.root.parent / f"walk-{STREET.width}-spherical")
    known = covered = right = sky = in_sky = 0
    for name in street.names:
        truth, _ = street.truth(name)
        depth = read_depth_map(workspace.depth_map_path(name, "geometric"))
        around = np.stack([np.roll(truth, shift, (0, 1)) for shift in ((1, 0), (-1, 0), (0, 1), (0, -1))])
        smooth = (truth > 0) & np.all(np.abs(around - truth) < 0.05 * truth, axis=0)
        both = smooth & (depth > 0)
        known, covered = known + smooth.sum(), covered + both.sum()
        sky, in_sky = sky + (truth == 0).sum(), in_sky + (depth[truth == 0] > 0).sum()
        right += (np.abs(depth[both] / truth[both] - 1) <= 0.01).sum()
    assert covered / known == pytest.approx(found, abs=0.05)
    assert in_sky / sky == pytest.approx(of_sky, abs=0.05)
    assert right / covered == pytest.approx(within_1_percent, abs=0.05)
