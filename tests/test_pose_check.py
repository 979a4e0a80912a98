"""A model without points, whose poses are right or wrong: what features of its images say of them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from rendered import SIDES, grey

from colmap_sph import synthetic as syn
from colmap_sph.errors import InputError, NoResultError
from colmap_sph.pipeline.checks import pose_check
from colmap_sph.pipeline.checks.pose_check import Compared, distance_of_pairs, fitting_factor
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.pipeline.reconstruct import run
from colmap_sph.project.project import Project
from colmap_sph.scene import Photograph, View
from colmap_sph.stereo.poses.features import (
    Features,
    epipolar_distances,
    find_features,
    match_features,
    with_focal_length,
)

OPTIONS = RunOptions(threads=2)


# ---- one pair ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def features() -> tuple[View, View, Features, Features]:
    """Both views of a rendered pair, and their features."""
    pair = syn.convergent_pair(15.0)
    views = [
        View(k, name, camera.width, camera.height, camera.K, camera.R, camera.t, np.empty(0, np.int64))
        for k, (name, camera) in enumerate([("a", pair.left), ("b", pair.right)])
    ]
    images = [grey(pair.render(side)) for side in SIDES]
    found = [find_features([(view, image, None)]) for view, image in zip(views, images, strict=True)]
    return views[0], views[1], found[0], found[1]


def test_features_match_in_their_epipolar_planes(features: tuple[View, View, Features, Features]) -> None:
    left, right, first, second = features
    matches = match_features(first, second)
    assert len(matches) > 50
    distances = epipolar_distances(first, second, matches, right.center - left.center)
    assert (distances <= 1).mean() > 0.9
    assert np.median(distances) < 0.2


def test_features_of_a_turned_camera_do_not(features: tuple[View, View, Features, Features]) -> None:
    left, right, first, second = features
    matches = match_features(first, second)
    turn, _ = cv2.Rodrigues(np.radians([3.0, 2.0, -2.0]))
    turned = replace(second, rays=second.rays @ turn.T)
    assert (epipolar_distances(first, turned, matches, right.center - left.center) <= 1).mean() < 0.3


def test_another_focal_length_moves_features_from_the_middle(
    features: tuple[View, View, Features, Features],
) -> None:
    view, _, found, _ = features
    longer = with_focal_length(found, view, 1.25)
    pixels, as_given = (view.K @ view.R @ rays.T for rays in (longer.rays, found.rays))
    middle = view.K[:2, 2:]
    expected = middle + (as_given[:2] / as_given[2] - middle) / 1.25
    assert np.allclose(pixels[:2] / pixels[2], expected)
    assert np.allclose(np.linalg.norm(longer.rays, axis=1), 1)


def pair_of_cameras(rng: np.random.Generator, mistaken: int = 0) -> Compared:
    """Two cameras side by side that do not turn, and 200 features, so many of which are mistaken for others."""
    K = np.array([[900.0, 0, 320], [0, 900.0, 240], [0, 0, 1]])
    points = rng.uniform((-5, -5, 18), (5, 5, 22), (200, 3))
    pair = []
    for i in range(2):
        place = np.array([-i * rng.uniform(1, 5), rng.uniform(0, 1), 0.0])
        view = View(i, f"{i}", 640, 480, K, np.eye(3), place, np.empty(0, np.int64))
        rays = points - view.center
        rays[:, :2] += rays[:, 2:] * rng.normal(0, 0.3 / 900, (200, 2))
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        pair.append((view, Features(rays, np.empty((200, 128), np.float32), np.full(200, 6.4 / 900))))
    (left, first), (right, second) = pair
    matches = np.repeat(np.arange(200)[:, None], 2, axis=1)
    matches[:mistaken, 1] = np.roll(matches[:mistaken, 1], 1)
    photographs = (Photograph(left.name, (left,)), Photograph(right.name, (right,)))
    return Compared(photographs, (first, second), matches)


def test_any_focal_length_fits_cameras_that_do_not_turn() -> None:
    """In pixels it is as near with each of them; in angles the longer the nearer."""
    rng = np.random.default_rng(3)
    factor, nearer, _ = fitting_factor([pair_of_cameras(rng) for _ in range(6)])
    assert factor < 1.05
    assert nearer > 0.9


@pytest.mark.parametrize(("mistaken", "is_far"), [(5, False), (6, True)])
def test_features_that_are_mistaken_for_each_other_tell_of_no_poses(mistaken: int, is_far: bool) -> None:
    """As long as they are so in half of the pairs at most."""
    rng = np.random.default_rng(4)
    compared = [pair_of_cameras(rng, 160 if k < mistaken else 0) for k in range(10)]
    assert (distance_of_pairs(compared) > 0.35) == is_far


def test_views_of_one_photograph_have_their_features_together() -> None:
    pair = syn.convergent_pair(15.0)
    view = View(1, "a", 160, 120, pair.left.K, pair.left.R, pair.left.t, np.empty(0, np.int64))
    right = replace(view, name="b", R=pair.right.R, t=pair.right.t)
    image = np.ascontiguousarray(grey(pair.render("left"))[:120, :160])
    alone, both = find_features([(view, image, None)]), find_features([(view, image, None), (right, image, None)])
    assert 10 < len(alone) < 750  # half of what a photograph may have
    assert len(both) == 2 * len(alone)
    assert np.allclose(both.rays[len(alone) :] @ right.R.T, alone.rays @ view.R.T)


def test_nothing_is_wanted_of_what_is_masked() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (200, 300), dtype=np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 2).astype(np.uint8)
    view = View(1, "a", 300, 200, np.diag([300.0, 300.0, 1.0]), np.eye(3), np.zeros(3), np.empty(0, np.int64))
    mask = np.zeros_like(image)
    mask[:, :150] = 255
    found = find_features([(view, image, mask)])
    assert 0 < len(found) < len(find_features([(view, image, None)]))
    assert (found.rays[:, 0] / found.rays[:, 2] <= 0.5).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1)])
def test_images_without_features_match_nothing(shape: tuple[int, int]) -> None:
    view = View(1, "a", shape[1], shape[0], np.eye(3), np.eye(3), np.zeros(3), np.empty(0, np.int64))
    none = find_features([(view, np.zeros(shape, np.uint8), None)])
    assert not len(none)
    matches = match_features(none, none)
    assert matches.shape == (0, 2)
    assert not len(epipolar_distances(none, none, matches, np.ones(3)))


# ---- whole runs --------------------------------------------------------------------------------------------


def exchange_images(project: Path) -> None:
    """Every image gets the place of one three places on, in the order of names."""
    paths = sorted(path for path in (project / "images").rglob("*") if path.is_file())
    contents = [path.read_bytes() for path in paths]
    for path, content in zip(paths, contents[3:] + contents[:3], strict=True):
        path.write_bytes(content)


def turn_cameras(project: Path, degrees: float = 4.0) -> None:
    """Every camera looks past by so much."""
    rng = np.random.default_rng(5)

    def turned(pose: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
        axis = rng.normal(size=3)
        turn = cv2.Rodrigues(np.radians(degrees) * axis / np.linalg.norm(axis))[0]
        matrix = turn @ pose.matrix()
        return pycolmap.Rigid3d(pycolmap.Rotation3d(matrix[:, :3]), matrix[:, 3])

    model = pycolmap.Reconstruction(project / "sparse/0")
    for image in model.images.values():
        image.frame.rig_from_world = turned(image.cam_from_world())
    model.write(project / "sparse/0")


def change_focal_length(project: Path, factor: float) -> None:
    model = pycolmap.Reconstruction(project / "sparse/0")
    for camera in model.cameras.values():
        camera.focal_length_x *= factor
        camera.focal_length_y *= factor
    model.write(project / "sparse/0")


def without_points(project: Path) -> None:
    model = pycolmap.Reconstruction(project / "sparse/0")
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    model.write(project / "sparse/0")


@pytest.mark.parametrize("spoil", [exchange_images, turn_cameras])
def test_wrong_poses_without_points_are_refused(project: Path, spoil: Callable[[Path], None]) -> None:
    without_points(project)
    spoil(project)
    with pytest.raises(NoResultError, match="no points to compare with, and features of its images lie"):
        run(project / "sparse/0", options=OPTIONS)
    assert not (project / "dense/fused.ply").exists()


@pytest.mark.parametrize(("factor", "undone"), [(0.9, r"1\.1\d"), (1.1, r"0\.9\d"), (1.4, r"0\.7\d")])
def test_a_wrong_focal_length_without_points_is_refused(project: Path, factor: float, undone: str) -> None:
    without_points(project)
    change_focal_length(project, factor)
    with pytest.raises(NoResultError, match=f"fit {undone} times its focal length far better"):
        run(project / "sparse/0", options=OPTIONS)


def test_poses_off_by_less_without_points_are_told(project: Path) -> None:
    without_points(project)
    turn_cameras(project, 0.5)
    assert "from each other's epipolar lines" in run(project / "sparse/0", options=OPTIONS).doubts


@pytest.mark.parametrize("shift", [0.0, 10000.0])
def test_poses_that_are_world_from_cam_are_called_so(project: Path, shift: float) -> None:
    without_points(project)
    model = pycolmap.Reconstruction(project / "sparse/0")
    for image in model.images.values():
        pose = image.cam_from_world().inverse()
        place = pose.translation + np.array([shift, 0.0, 0.0])
        image.frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, place)
    model.write(project / "sparse/0")
    with pytest.raises(NoResultError, match="fit the inverse of its poses"):
        run(project / "sparse/0", options=OPTIONS)


def test_right_poses_without_points_are_not(project: Path) -> None:
    without_points(project)
    plan = make_plan(Project(project / "sparse/0"), OPTIONS)
    assert plan.pairs > plan.pairs_done == 0
    report = run(project / "sparse/0", options=OPTIONS)
    assert report.points > 10_000
    assert not report.doubts


def test_an_image_that_cannot_be_read_tells_nothing(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every other stage goes on without it, too."""
    without_points(project)
    read = pose_check.read_whole_grey
    asked = []

    def reading(path: Path, size: tuple[int, int]) -> np.ndarray:
        asked.append(path)
        if len(asked) == 1:
            raise InputError(f"{path} cannot be read.")
        return read(path, size)

    monkeypatch.setattr(pose_check, "read_whole_grey", reading)
    assert run(project / "sparse/0", options=OPTIONS).points > 10_000
    assert len(asked) > 1


def test_images_of_something_else_are_refused(project: Path) -> None:
    """Each of something else: they have many features, of which none match."""
    without_points(project)
    rng = np.random.default_rng(2)
    for path in (project / "images").rglob("*.*"):
        picture = cv2.GaussianBlur(rng.integers(0, 256, (240, 320, 3), dtype=np.uint8), (0, 0), 1.2)
        path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())
    with pytest.raises(NoResultError, match="match in none of"):
        run(project / "sparse/0", options=OPTIONS)
