"""Polishing of poses: disturbed poses come back, good ones stay, and what cannot be polished says so."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from projects import FOUR_NAMES, copy_four_images, read_picture

import colmap_sph
from colmap_sph.errors import NoResultError, OptionError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.pipeline.report import RunReport, Silent
from colmap_sph.project.polishing import PolishOptions
from colmap_sph.project.project import Project
from colmap_sph.project.workspace import Workspace

OFF = RunOptions(threads=2)
ON = replace(OFF, polish=PolishOptions("on"))
MATCHING = ("match pairs to polish", "polish poses", "match pairs")


# ---- runs ---------------------------------------------------------------------------------------------------


def disturbed(model_dir: Path, pixels: float) -> None:
    """Turn each camera of a model by `pixels` or so about each of its axes; the points stay."""
    rng = np.random.default_rng(3)
    model = pycolmap.Reconstruction(model_dir)
    for image_id in sorted(model.images):
        image = model.images[image_id]
        pose = image.cam_from_world()
        angle = pixels / model.cameras[image.camera_id].mean_focal_length()
        turn = pycolmap.Rotation3d(rng.choice([-angle, angle], 3))
        center = image.projection_center()
        rotation = turn * pose.rotation
        model.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ center))
    model.write_binary(model_dir)


def misses(model_dir: Path, true_dir: Path) -> float:
    """By how many pixels the rays of one and the same point miss each other, by the poses of a model (median).

    The points are those of the true model, and seen exactly where its cameras see them.
    """
    model, true = (pycolmap.Reconstruction(folder) for folder in (model_dir, true_dir))
    pairs = []
    for point in true.points3D.values():
        ids = [element.image_id for element in point.track.elements][:2]
        views = []
        for image_id in ids:
            K = true.cameras[true.images[image_id].camera_id].calibration_matrix()
            pixel = K @ (true.images[image_id].cam_from_world() * point.xyz)
            views.append((K, model.images[image_id].cam_from_world(), pixel / pixel[2]))
        pairs.append(epipolar_distance(*views))
    return float(np.median(pairs))


def epipolar_distance(
    one: tuple[np.ndarray, pycolmap.Rigid3d, np.ndarray], other: tuple[np.ndarray, pycolmap.Rigid3d, np.ndarray]
) -> float:
    """Distance of a pixel from the epipolar line of another."""
    relative = (other[1] * one[1].inverse()).matrix()
    t = relative[:, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    line = np.linalg.inv(other[0]).T @ cross @ relative[:, :3] @ np.linalg.inv(one[0]) @ one[2]
    return float(abs(line @ other[2]) / np.hypot(line[0], line[1]))


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be changed: four images with true poses in `true`, and disturbed ones in `sparse/0`, polished."""
    project = tmp_path_factory.mktemp("polish")
    copy_four_images(project)
    shutil.copytree(project / "sparse/0", project / "true")
    disturbed(project / "sparse/0", 0.7)
    colmap_sph.run(project / "sparse/0", options=ON)
    return project


@pytest.fixture
def project(pristine: Path, tmp_path: Path) -> Path:
    shutil.copytree(pristine, tmp_path / "project", symlinks=True)
    return tmp_path / "project"


def run(project: Path, options: RunOptions = ON) -> RunReport:
    return colmap_sph.run(project / "sparse/0", options=options)


class Steps(Silent):
    """Of each stage: its steps, and how many of them were told while a file was not there."""

    def __init__(self, result: Path) -> None:
        self.told: dict[str, tuple[int, int]] = {}
        self._result = result

    def start(self, stage: str, total: int) -> None:
        self._stage = stage
        self.told[stage] = total, 0

    def advance(self, seconds: float = 0.0) -> None:
        total, before = self.told[self._stage]
        self.told[self._stage] = total, before + (not self._result.exists())


def models(project: Path) -> tuple[bytes, bytes]:
    """Images of the workspace's model, and of the one that was given to the run."""
    return (project / "dense/sparse/images.bin").read_bytes(), (project / "sparse/0/images.bin").read_bytes()


def made(report: RunReport) -> dict[str, int]:
    return {stage: report.made[stage] for stage in report.made if report.made[stage]}


def test_disturbed_poses_come_back(pristine: Path) -> None:
    given = misses(pristine / "sparse/0", pristine / "true")
    assert given > 0.5
    assert misses(pristine / "dense/sparse", pristine / "true") < 0.12
    # What was given is kept, beside and where it was.
    assert misses(pristine / "dense/colmap_sph/given", pristine / "true") == pytest.approx(given)


def test_the_report_tells_what_moved(project: Path) -> None:
    report = run(project)
    assert "The poses were polished" in report.polishing
    assert sorted(report.pose_movement) == FOUR_NAMES
    assert all(0.2 < pixels < 3 for pixels in report.pose_movement.values())


def test_a_second_run_polishes_nothing_again(project: Path) -> None:
    before = models(project)
    assert made(run(project)) == {}
    assert models(project) == before
    plan = make_plan(Project(project / "sparse/0"), ON)
    assert (plan.pairs_done, plan.fuse) == (plan.pairs, False)
    assert "match pairs to polish" not in {stage.name for stage in plan.stages}


def test_without_the_option_the_given_poses_are_back(project: Path) -> None:
    plan = make_plan(Project(project / "sparse/0"), OFF)
    assert plan.pairs_done == 0
    report = run(project, OFF)
    assert (report.polishing, report.made["match pairs"]) == ("", 6)
    given = pycolmap.Reconstruction(project / "sparse/0")
    for image_id, image in pycolmap.Reconstruction(project / "dense/sparse").images.items():
        np.testing.assert_allclose(
            image.cam_from_world().matrix(), given.images[image_id].cam_from_world().matrix(), atol=1e-12
        )
    again = run(project)
    assert again.made["polish poses"] == 1
    assert misses(project / "dense/sparse", project / "true") < 0.12


def test_other_options_leave_the_polished_poses(project: Path) -> None:
    report = run(project, replace(ON, fusion=replace(ON.fusion, min_num_pixels=3)))
    assert made(report) == {"fuse": 1}


def test_a_run_that_was_ended_while_the_model_was_exchanged_goes_on(project: Path) -> None:
    """The marker is not finished then, and files of either model may lie there."""
    before = models(project)
    workspace = Workspace(project / "dense")
    marker = workspace.marker_path.read_text()
    start, end = marker.index('"images": ['), marker.index("]", marker.index('"images": ['))
    workspace.marker_path.write_text(marker[:start] + '"images": [' + marker[end:])
    (workspace.sparse_dir / "points3D.bin").unlink()
    assert "The poses were polished" in run(project).polishing
    assert models(project) == before


def test_a_changed_image_polishes_the_given_model_again(project: Path) -> None:
    """Not the polished one, in whose place the new one comes."""
    given = (project / "dense/colmap_sph/given/images.bin").read_bytes()
    path = project / "images" / FOUR_NAMES[0]
    darker = cv2.convertScaleAbs(read_picture(path), alpha=0.9)
    path.write_bytes(cv2.imencode(".jpg", darker, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())
    plan = make_plan(Project(project / "sparse/0"), ON)
    report = run(project)
    assert "The poses were polished" in report.polishing
    assert made(report) == {"undistort": 1} | {stage.name: stage.total for stage in plan.stages[3:]}
    assert misses(project / "dense/sparse", project / "true") < 0.12
    assert (project / "dense/colmap_sph/given/images.bin").read_bytes() == given
    assert made(run(project)) == {}


def test_a_model_that_the_user_changed_is_used_as_it_is(project: Path) -> None:
    disturbed(project / "dense/sparse", 0.1)
    before = models(project)
    assert "was changed since this program made it" in run(project).polishing
    assert models(project) == before
    plans = [make_plan(Project(project / "sparse/0"), ON, overwrite=overwrite) for overwrite in (False, True)]
    assert ["polish poses" in {stage.name for stage in plan.stages} for plan in plans] == [False, True]


def test_a_lost_given_model_is_made_again(project: Path) -> None:
    before = models(project)
    shutil.rmtree(project / "dense/colmap_sph/given")
    run(project)
    assert models(project) == before
    assert (project / "dense/colmap_sph/given/images.bin").is_file()


def test_overwrite_begins_with_the_given_model(project: Path) -> None:
    report = colmap_sph.run(project / "sparse/0", options=OFF, overwrite=True)
    assert report.polishing == ""
    assert not (project / "dense/colmap_sph/given/images.bin").exists()
    assert misses(project / "dense/sparse", project / "true") > 0.5


# ---- what is kept as given ----------------------------------------------------------------------------------


def change_model(project: Path, change: Callable[[pycolmap.Reconstruction], None]) -> None:
    model = pycolmap.Reconstruction(project / "sparse/0")
    change(model)
    model.write_binary(project / "sparse/0")
    shutil.rmtree(project / "dense")


def two_images(model: pycolmap.Reconstruction) -> None:
    for image_id in sorted(model.images)[2:]:
        model.deregister_frame(model.images[image_id].frame_id)


def no_tracks(model: pycolmap.Reconstruction) -> None:
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)


def far_away(model: pycolmap.Reconstruction) -> None:
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([4e5, 5e6, 100])))


def long_focus(model: pycolmap.Reconstruction) -> None:
    for camera in model.cameras.values():
        camera.focal_length_x *= 1.1
        camera.focal_length_y *= 1.1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (two_images, "fewer than 3 images"),
        (no_tracks, "no tracks"),
        (far_away, "map coordinates"),
    ],
)
def test_poses_are_kept_with_a_reason(
    project: Path, change: Callable[[pycolmap.Reconstruction], None], reason: str
) -> None:
    change_model(project, change)
    report = run(project)
    assert report.polishing.startswith("The poses are kept as given: ")
    assert reason in report.polishing
    assert report.pose_movement == {}
    plain = shutil.copytree(project, project.parent / "plain", ignore=shutil.ignore_patterns("dense"))
    run(plain, OFF)
    assert models(project)[0] == models(plain)[0]


def test_poses_without_tracks_are_polished_on_request(project: Path) -> None:
    change_model(project, no_tracks)
    report = run(project, replace(OFF, polish=PolishOptions("always")))
    assert "The poses were polished" in report.polishing
    assert "sparse points" not in report.polishing
    assert sorted(report.pose_movement) == FOUR_NAMES
    assert all(0.2 < pixels < 3 for pixels in report.pose_movement.values())
    assert misses(project / "dense/sparse", project / "true") < 0.12


def test_wrong_cameras_are_no_matter_of_poses(project: Path) -> None:
    change_model(project, long_focus)
    with pytest.raises(NoResultError, match="cameras of the model are not those that its points were made with"):
        run(project)


def test_poses_that_are_good_are_kept(project: Path) -> None:
    shutil.rmtree(project / "dense")
    shutil.rmtree(project / "sparse")
    shutil.copytree(project / "true", project / "sparse/0")
    steps = Steps(project / "nothing")
    report = colmap_sph.run(project / "sparse/0", options=ON, progress=steps)
    assert "they are good already" in report.polishing
    told, done = steps.told["polish poses"]
    assert told == done > 1  # also those that were not needed
    assert report.made["match pairs"] == 0
    assert made(run(project)) == {}


def test_a_workspace_of_the_user_is_not_polished(project: Path) -> None:
    with pytest.raises(OptionError, match="--model"):
        colmap_sph.run(workspace=project / "dense", options=ON)


# ---- cameras ------------------------------------------------------------------------------------------------


def wrong_lens(model: pycolmap.Reconstruction) -> None:
    """The lens of pictures without distortion has some, says the model."""
    for camera in model.cameras.values():
        f, _, cx, cy = camera.params
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [f, cx, cy, 0.3]


def test_cameras_are_refined_into_a_model_of_their_own(project: Path) -> None:
    change_model(project, wrong_lens)
    given = (project / "sparse/0/cameras.bin").read_bytes()
    refined = project / "dense/colmap_sph/refined"
    steps = Steps(refined)
    options = replace(OFF, polish=PolishOptions("on", cameras=True))
    report = colmap_sph.run(project / "sparse/0", output=project / "dense", options=options, progress=steps)
    # Each pair's ties, the poses, the distortion; and what comes of the cameras.
    measured = steps.told["match pairs to polish"][0] + 2
    assert steps.told["polish poses"] == (measured + 1, measured)
    poses, cameras = report.polishing.split("Cameras were refined")
    # Of the same ties: with the given cameras they fit as with the better poses, not as before any polishing.
    residuals = r"had no part in it fit to ([\d.]+) px, before ([\d.]+) px"
    best = min(map(float, re.search(residuals, poses).groups()))  # type: ignore[union-attr]
    assert f"px, with the given cameras to {best:.2f} px." in cameras
    assert f"--model {refined} --images {project / 'images'}" in report.polishing
    for camera in pycolmap.Reconstruction(refined).cameras.values():
        k1, k2 = camera.params[4:6]
        corner = np.array([1.0, 1.0]) @ np.array([camera.width, camera.height]) ** 2 / 4 / camera.params[0] ** 2
        # At the corner, of the 0.3 that were wrong.
        assert abs(k1 + k2 * corner) < 0.1
        assert camera.params[:4].tolist() == [camera.params[0], camera.params[0], 80, 60]
    assert (project / "sparse/0/cameras.bin").read_bytes() == given


def test_what_is_said_of_refined_cameras_holds_later(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From where the project lies by then, and while the refined model is there."""
    change_model(project, wrong_lens)
    options = replace(OFF, polish=PolishOptions("on", cameras=True))
    (project / "here").mkdir()
    monkeypatch.chdir(project / "here")
    report = colmap_sph.run("../sparse/0", output=".", options=options)
    assert "colmap_sph run --model colmap_sph/refined --images" in report.polishing
    assert report.polishing.endswith(f"--output {project / 'here_refined'}")
    monkeypatch.chdir(tmp_path)
    moved = project.rename(tmp_path / "moved")
    again = colmap_sph.run(moved / "sparse/0", output=moved / "here", options=options)
    assert made(again) == {}
    refined = moved / "here/colmap_sph/refined"
    assert again.polishing.endswith(
        f"--model {refined} --images {moved / 'images'} --output {moved / 'here_refined'}"
    )
    cameras = (refined / "cameras.bin").read_bytes()
    shutil.rmtree(refined)
    anew = colmap_sph.run(moved / "sparse/0", output=moved / "here", options=options)
    assert (refined / "cameras.bin").read_bytes() == cameras
    assert anew.polishing == again.polishing


def test_cameras_without_tracks_are_kept_with_the_poses(project: Path) -> None:
    change_model(project, no_tracks)
    report = run(project, replace(OFF, polish=PolishOptions("on", cameras=True)))
    assert "no tracks" in report.polishing
    assert report.polishing.endswith("So are the cameras.")
    assert not (project / "dense/colmap_sph/refined").exists()


def test_right_cameras_are_kept(project: Path) -> None:
    """Refined ones of an earlier run, with other images say, do not stay."""
    shutil.rmtree(project / "dense")
    shutil.copytree(project / "sparse/0", project / "dense/colmap_sph/refined")
    report = run(project, replace(OFF, polish=PolishOptions("on", cameras=True)))
    assert "The cameras are kept as given" in report.polishing
    assert not (project / "dense/colmap_sph/refined").exists()


def test_cameras_alone_are_refused() -> None:
    with pytest.raises(OptionError, match="poses"):
        PolishOptions(cameras=True).check()
