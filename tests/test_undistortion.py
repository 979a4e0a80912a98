"""Undistorted workspaces: COLMAP's model of them holds exactly, and bad input never stops the process."""

import errno
import itertools
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from process_ends import end_process, kill_process, raise_error
from projects import make_context, prepare

from colmap_sph.errors import InputError, OptionError, OutputError
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.input.good_images import with_good_images
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.preparation import Preparation
from colmap_sph.pipeline.reconstruct import check_input
from colmap_sph.pipeline.stages.photo import PhotoFile
from colmap_sph.project.given.binary_arrays import read_observations
from colmap_sph.project.given.image_places import find_images
from colmap_sph.project.given.poses import check_points_in_front
from colmap_sph.project.images.reading import image_problem
from colmap_sph.project.project import Project, open_workspace
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.state.ownership import undistorted_place
from colmap_sph.project.state.records import begin
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.undistortion.foreseen import foreseen_scene
from colmap_sph.project.undistortion.model import undistort_model
from colmap_sph.project.undistortion.originals import read_originals
from colmap_sph.project.undistortion.process import ChildProcess
from colmap_sph.project.workspace import Workspace

WIDTH, HEIGHT, FOCAL = 96, 64, 90.0
NAMES = ["a.png", "b.png", "cam/c.png", "cam/d.png"]


def make_project(
    root: Path, camera_model: str = "PINHOLE", extra: tuple[float, ...] = (), text: bool = False
) -> Path:
    """Four views of a plane with random points, and images as dark as their number; returns the model."""
    rng = np.random.default_rng(3)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, camera_model, FOCAL, WIDTH, HEIGHT)
    if extra:
        camera.params = [*camera.params[: len(camera.params) - len(extra)], *extra]
    model.add_camera_with_trivial_rig(camera)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (20, 2)), np.full(20, 3.0)])
    for image_id, name in enumerate(NAMES, start=1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.1 * image_id, 0.0, 0.0]))
        keypoints = camera.img_from_cam(points + pose.translation)
        assert keypoints is not None
        model.add_image_with_trivial_frame(pycolmap.Image(name, keypoints, 1, image_id), pose)
        path = root / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        shades = rng.integers(0, 200, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        assert cv2.imwrite(str(path), shades + np.uint8(image_id))
    for index, xyz in enumerate(points):
        elements = [pycolmap.TrackElement(image_id, index) for image_id in range(1, 5)]
        # The first point is seen by the first two images only.
        model.add_point3D(xyz, pycolmap.Track(elements[: 2 if index == 0 else 4]), np.zeros(3, np.uint8))
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(sparse)
    return sparse


def test_negative_focal_lengths_are_told_before_anything_is_made(tmp_path: Path) -> None:
    sparse = make_project(tmp_path, "PINHOLE")
    model = pycolmap.Reconstruction(sparse)
    model.camera(1).params = [FOCAL, -FOCAL, WIDTH / 2, HEIGHT / 2]
    model.write(sparse)
    with pytest.raises(InputError) as told:
        read_originals(Project(model=sparse), UndistortionOptions())
    assert f"{sparse} has a camera" in str(told.value)
    assert f"camera 1: {FOCAL:g} and -{FOCAL:g} pixels" in str(told.value)


def test_cameras_without_pixels_are_told_before_anything_is_made(tmp_path: Path) -> None:
    """The sentence spoke of images of another size; these are as they were."""
    sparse = make_project(tmp_path, "PINHOLE")
    model = pycolmap.Reconstruction(sparse)
    model.camera(1).width = model.camera(1).height = 0
    model.write(sparse)
    with pytest.raises(InputError) as told:
        prepare(sparse, tmp_path / "dense")
    assert f"{sparse} has a camera" in str(told.value) and "camera 1: 0 x 0 pixels" in str(told.value)
    assert not (tmp_path / "dense").exists()


def test_points_behind_all_images_are_told_before_anything_is_made(tmp_path: Path) -> None:
    """Of the model as it was given, and not of the one in the workspace."""
    sparse = make_project(tmp_path)
    model = pycolmap.Reconstruction(sparse)
    for image in model.images.values():
        assert image.frame is not None
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.diag([1.0, -1.0, -1.0])), np.zeros(3))
        image.frame.rig_from_world = turn * image.cam_from_world()
    model.write_binary(sparse)
    with pytest.raises(InputError, match=f"sparse points of the model in {sparse} lie behind the images"):
        prepare(sparse, tmp_path / "dense")
    assert not (tmp_path / "dense").exists()


@pytest.mark.parametrize("text", [False, True])
def test_workspace_of_undistorted_images(tmp_path: Path, text: bool) -> None:
    sparse = make_project(tmp_path, text=text)
    workspace = prepare(sparse, tmp_path / "dense")
    assert [view.name for view in read_scene(workspace.sparse_dir).views] == NAMES
    for name in NAMES:
        assert workspace.image_path(name).read_bytes() == (tmp_path / "images" / name).read_bytes()
    assert workspace.fusion_cfg_path.read_text().split() == NAMES
    # Without COLMAP's scripts, which would write over our maps.
    assert sorted(path.name for path in workspace.root.iterdir()) == ["colmap_sph", "images", "sparse", "stereo"]
    state = sorted(path.name for path in workspace.state_dir.iterdir())
    assert state == ["fusion_cfg.json", "originals.json", "state", "undistortion.json"]


@pytest.mark.parametrize("missing", [None, "left/1.png"])
def test_images_of_rigs_come_in_the_file_as_colmap_lists_them(tmp_path: Path, missing: str | None) -> None:
    """OpenMVS takes the images of fused.ply.vis by the first of these, COLMAP 4 by the second."""
    model = pycolmap.Reconstruction()
    sensors = [pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=number) for number in (1, 2)]
    for number in (1, 2):
        model.add_camera(pycolmap.Camera.create_from_model_name(number, "PINHOLE", FOCAL, WIDTH, HEIGHT))
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.1, 0.0, 0.0])))
    model.add_rig(rig)
    for number in (1, 2, 3):
        frame = pycolmap.Frame(frame_id=number, rig_id=1)
        ids = (number, number + 3)
        for sensor, image_id in zip(sensors, ids, strict=True):
            frame.add_data_id(pycolmap.data_t(sensor, image_id))
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.3 * number, 0.0, 0.0]))
        model.add_frame(frame)
        for camera_id, (side, image_id) in enumerate(zip(("left", "right"), ids, strict=True), start=1):
            image = pycolmap.Image(f"{side}/{number}.png", np.zeros((0, 2)), camera_id, image_id)
            image.frame_id = number
            model.add_image(image)
            path = tmp_path / "images" / image.name
            path.parent.mkdir(parents=True, exist_ok=True)
            if image.name != missing:
                assert cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), image_id, np.uint8))
        model.register_frame(number)
    (tmp_path / "sparse").mkdir()
    model.write_binary(tmp_path / "sparse")
    workspace = prepare(tmp_path / "sparse", tmp_path / "dense")
    in_file = [image_id for image_id, _ in read_observations(workspace.sparse_dir / "images.bin")]
    assert in_file == pycolmap.Reconstruction(workspace.sparse_dir).reg_image_ids()
    assert len(in_file) == (6 if missing is None else 5)


def test_max_image_size(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense", UndistortionOptions(48))
    view = read_scene(workspace.sparse_dir).views[0]
    assert (view.width, view.height) == (48, 32)
    np.testing.assert_allclose(view.K, [[45, 0, 24], [0, 45, 16], [0, 0, 1]])
    assert image_problem(workspace.image_path("a.png"), 48, 32) is None


@pytest.mark.parametrize(
    ("camera_model", "extra"),
    [
        ("OPENCV", (0.1, 0.01, 1e-3, -1e-3)),
        ("OPENCV", (0.0, 0.0, 0.0, 0.0)),  # COLMAP leaves such a model as it is
        ("SIMPLE_RADIAL", (0.0,)),
        ("FULL_OPENCV", (0.1, 0, 0, 0, 0, 0, 0, 0)),
        ("FOV", (0.5,)),
        ("OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.0)),  # COLMAP takes it for a pinhole
        ("SIMPLE_RADIAL_FISHEYE", (0.1,)),
        ("SIMPLE_FISHEYE", ()),
    ],
)
def test_any_camera_model_becomes_pinhole(tmp_path: Path, camera_model: str, extra: tuple[float, ...]) -> None:
    sparse = make_project(tmp_path, camera_model, extra)
    workspace = prepare(sparse, tmp_path / "dense")
    scene = read_scene(workspace.sparse_dir)
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    for view in scene.views:
        # COLMAP moved the features with the pixels: points project onto them.
        projected = (scene.points[view.point_indices] @ view.R.T + view.t) @ view.K.T
        features = [point.xy for point in model.image(view.image_id).points2D if point.has_point3D()]
        np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], features, atol=1e-3)
        assert image_problem(workspace.image_path(view.name), view.width, view.height) is None


@pytest.mark.parametrize("camera_model", ["PINHOLE", "SIMPLE_RADIAL", "FISHEYE"])
def test_what_jpeg_has_rounded_is_known_of_every_copy(tmp_path: Path, camera_model: str) -> None:
    sparse = make_project(tmp_path, camera_model, (0.1,) if camera_model == "SIMPLE_RADIAL" else ())
    for path in (tmp_path / "images").rglob("*.png"):
        picture = cv2.imread(str(path))
        assert picture is not None
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 50])[1]
        path.write_bytes(jpeg.tobytes())
    workspace = prepare(sparse, tmp_path / "dense")
    for view in read_scene(workspace.sparse_dir).views:
        file = PhotoFile(
            view,
            workspace.image_path(view.name),
            workspace.mask_path(view.name),
            undistorted_place(workspace, view.name).record,
        )
        assert file.jpeg_step == 16  # of T.81's table for brightness, table K.1


def test_a_camera_that_is_none_leaves_the_workspace_that_is_there(tmp_path: Path) -> None:
    prepare(make_project(tmp_path / "good"), tmp_path / "dense")
    sparse = make_project(tmp_path / "bad", "EQUIRECTANGULAR")
    model = pycolmap.Reconstruction(sparse)
    model.camera(1).params = [0.0, 0.0]
    model.write_binary(sparse)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match="impossible parameters"):
        prepare(sparse, tmp_path / "dense", overwrite=True)
    assert sorted(tmp_path.rglob("*")) == before


def damage(path: Path, kind: str) -> None:
    data = path.read_bytes()
    if kind == "missing":
        path.unlink()
    elif kind == "size":
        cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH + 2, 3), np.uint8))
    else:
        path.write_bytes({"empty": b"", "cut off": data[: len(data) // 2], "text": b"no image" * 9}[kind])


@pytest.mark.parametrize("kind", ["missing", "empty", "cut off", "text", "size"])
def test_bad_image_is_reported_and_left_out(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    sparse = make_project(tmp_path, "OPENCV", (0.1, 0.0, 0.0, 0.0))
    damage(tmp_path / "images" / "b.png", kind)
    workspace = prepare(sparse, tmp_path / "dense")
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warnings) == 1 and "b.png" in warnings[0]
    rest = ["a.png", "cam/c.png", "cam/d.png"]
    scene = read_scene(workspace.sparse_dir)
    assert [view.name for view in scene.views] == rest
    assert workspace.fusion_cfg_path.read_text().split() == rest
    assert not workspace.image_path("b.png").exists()
    # The point that only the first two images saw is gone; the others are still tracked three times.
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    assert model.num_points3D() == 19
    assert {point.track.length() for point in model.points3D.values()} == {3}
    assert all(len(view.point_indices) == 19 for view in scene.views)


def test_no_usable_image(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    for name in NAMES:
        damage(tmp_path / "images" / name, "size")
    with pytest.raises(InputError, match="None of the model's 4 images"):
        prepare(sparse, tmp_path / "dense")
    assert not (tmp_path / "dense").exists()


def times(workspace: Workspace) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in workspace.images_dir.rglob("*") if path.is_file()}


def test_finished_workspace_is_reused(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    before = times(workspace)
    prepare(sparse, tmp_path / "dense")
    assert times(workspace) == before
    with pytest.raises(
        InputError, match=r"dense was made with --max-image-size -1, not 48; give that, .*--overwrite"
    ):
        prepare(sparse, tmp_path / "dense", UndistortionOptions(48))
    other = make_project(tmp_path / "other", "OPENCV", (0.1, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"made from another sparse model .*--overwrite"):
        prepare(other, tmp_path / "dense")
    assert times(workspace) == before


def test_a_finished_workspace_needs_no_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that the results have filled is no reason to refuse other options."""
    sparse = make_project(tmp_path)
    monkeypatch.setattr("colmap_sph.project.undistortion.foreseen.free_space", lambda _: 0)
    with pytest.raises(OutputError, match="need about"):
        prepare(sparse, tmp_path / "dense")
    with monkeypatch.context() as patch:
        patch.setattr("colmap_sph.project.undistortion.foreseen.free_space", lambda _: 1 << 40)
        prepare(sparse, tmp_path / "dense")
    prepare(sparse, tmp_path / "dense")
    with pytest.raises(OutputError, match="need about"):
        prepare(sparse, tmp_path / "dense", overwrite=True)


def test_a_copied_project_is_known_by_its_content(tmp_path: Path) -> None:
    sparse = make_project(tmp_path / "project", "OPENCV", (0.1, 0.0, 0.0, 0.0))
    prepare(sparse, tmp_path / "project" / "dense")
    shutil.copytree(tmp_path / "project", tmp_path / "copy", copy_function=shutil.copyfile)  # with new times
    workspace = Workspace(tmp_path / "copy" / "dense")
    before = times(workspace)
    prepare(tmp_path / "copy" / "sparse" / "0", workspace.root)
    assert times(workspace) == before


@pytest.mark.parametrize("keep_time", [False, True])
def test_a_changed_image_is_undistorted_anew(tmp_path: Path, keep_time: bool) -> None:
    """Also one of the same size whose time was set back."""
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    before = times(workspace)
    path = tmp_path / "images" / "b.png"
    status = path.stat()
    path.write_bytes((tmp_path / "images" / "a.png").read_bytes())
    if keep_time:
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    prepare(sparse, tmp_path / "dense")
    assert workspace.image_path("b.png").read_bytes() == path.read_bytes()
    changed = {path for path, time in times(workspace).items() if time != before[path]}
    assert changed == {workspace.image_path("b.png")}
    assert len(read_scene(workspace.sparse_dir).views) == 4


def test_an_image_that_comes_and_goes(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    path = tmp_path / "images" / "b.png"
    away = path.rename(tmp_path / "b.png")
    workspace = prepare(sparse, tmp_path / "dense")
    assert [view.name for view in read_scene(workspace.sparse_dir).views] == ["a.png", "cam/c.png", "cam/d.png"]
    away.rename(path)
    prepare(sparse, tmp_path / "dense")
    assert [view.name for view in read_scene(workspace.sparse_dir).views] == NAMES


def test_users_own_files_in_a_workspace_stay(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """An image exchanged, a model, a list of pairs and notes: in use, and there after --overwrite."""
    sparse = make_project(tmp_path, "OPENCV", (0.1, 0.0, 0.0, 0.0))
    workspace = prepare(sparse, tmp_path / "dense")
    theirs = {
        workspace.image_path("a.png"): workspace.image_path("b.png").read_bytes(),
        workspace.sparse_dir / "points3D.bin": bytes(8),
        workspace.patch_match_cfg_path: b"a.png\nb.png\n",
        workspace.images_dir / "notes.txt": b"mine",
        workspace.masks_dir / "a.png.png": b"mine",
        workspace.state_dir / "state" / "notes.txt": b"mine",
    }
    for path, content in theirs.items():
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    prepare(sparse, workspace.root)
    assert {path: path.read_bytes() for path in theirs} == theirs
    assert f"{workspace.sparse_dir} was changed" in caplog.text
    assert f"{workspace.image_path('a.png')} or its mask was changed" in caplog.text
    caplog.clear()
    prepare(sparse, workspace.root, overwrite=True)
    # What has to make room is named, and kept beside the new one.
    model = workspace.sparse_dir / "points3D.bin"
    assert f"{model} is not what this program wrote there; it is now points3D.bin.backup" in caplog.text
    assert model.with_name("points3D.bin.backup").read_bytes() == theirs.pop(model)
    assert {path: path.read_bytes() for path in theirs} == theirs
    assert len(read_scene(workspace.sparse_dir).points) == 20
    prepare(sparse, workspace.root, UndistortionOptions(48), overwrite=True)
    moved = workspace.image_path("a.png")
    assert moved.with_name("a.png.backup").read_bytes() == theirs[moved]
    assert read_scene(workspace.sparse_dir).views[0].width == 48


@pytest.mark.parametrize("what", ["model", "images", "masks"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_input_inside_the_output_is_refused(tmp_path: Path, what: str, overwrite: bool) -> None:
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    places = {"model": sparse, "images": tmp_path / "images", "masks": None}
    places[what] = shutil.copytree(places[what] or tmp_path / "images", workspace.root / "given")
    before = sorted(tmp_path.rglob("*"))
    project = Project(places["model"], places["images"], places["masks"], workspace.root)
    with pytest.raises(InputError, match=f"--{what} .*given lies inside the workspace"):
        Preparation(project, RunOptions(), overwrite=overwrite)
    assert sorted(tmp_path.rglob("*")) == before


def test_workspace_among_the_originals_is_refused(tmp_path: Path) -> None:
    """COLMAP, asked for the features of all images, would find its images there."""
    sparse = make_project(tmp_path)
    among = tmp_path / "images/dense"
    with pytest.raises(InputError, match=r"would lie in .*images, where COLMAP would take .* another --output"):
        prepare(sparse, among)
    assert not among.exists()
    # Of an earlier version.
    prepare(sparse, tmp_path / "dense").root.rename(among)
    prepare(sparse, among)
    # Of who has all of a project in one folder.
    shutil.copytree(tmp_path / "sparse", tmp_path / "images/sparse")
    project = Project(tmp_path / "images/sparse/0", tmp_path / "images", output=tmp_path / "images/dense2")
    Preparation(project, RunOptions())


@pytest.mark.parametrize("what", ["model", "images", "masks"])
def test_input_that_is_linked_to_the_output_is_refused(tmp_path: Path, what: str) -> None:
    """Files may lie inside though their folder does not: --overwrite would remove them."""
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    places: dict[str, Path | None] = {"model": sparse, "images": tmp_path / "images", "masks": None}
    inside = {"model": workspace.sparse_dir, "images": workspace.images_dir, "masks": workspace.images_dir}[what]
    places[what] = tmp_path / "given"
    (tmp_path / "given").mkdir()
    for path in inside.iterdir():
        (tmp_path / "given" / path.name).symlink_to(path)
    project = Project(places["model"], places["images"], places["masks"], workspace.root)
    with pytest.raises(InputError, match=r"given/.* is a link into the workspace .*dense that is to be written"):
        Preparation(project, RunOptions(), overwrite=True)


def test_a_damaged_marker_is_told_and_overwrite_helps(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    made = {path: path.read_bytes() for path in [path for path in workspace.root.rglob("*") if path.is_file()]}
    whole = workspace.marker_path.read_bytes()
    for damage in (b"", whole[1:], whole[:-3]):
        workspace.marker_path.write_bytes(damage)
        with pytest.raises(InputError, match=r"undistortion\.json is damaged.*--overwrite"):
            prepare(sparse, workspace.root)
        prepare(sparse, workspace.root, overwrite=True)
        assert workspace.marker_path.read_bytes() == whole
        assert {path: path.read_bytes() for path in made if "colmap_sph" not in path.parts} == {
            path: content for path, content in made.items() if "colmap_sph" not in path.parts
        }
    # Nothing says whose the model was.
    assert (workspace.sparse_dir / "images.bin.backup3").is_file()


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_a_damaged_model_of_ours_is_made_again(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    path = workspace.sparse_dir / f"{name}.bin"
    whole = path.read_bytes()
    path.write_bytes(whole[:-3])
    prepare(sparse, workspace.root)
    assert path.read_bytes() == whole
    assert path.with_name(f"{name}.bin.backup").read_bytes() == whole[:-3]
    assert f"{path} is not what this program wrote there; it is now {name}.bin.backup" in caplog.text


class Killed(BaseException):
    """The process ends without a chance to clean up."""


@pytest.mark.parametrize("overwrite", [False, True])
def test_interrupted_undistortion_is_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overwrite: bool
) -> None:
    """Before every single file operation of the workspace; also while an earlier one makes room."""
    sparse = make_project(tmp_path, "OPENCV", (0.1, 0.0, 0.0, 0.0))
    whole = prepare(sparse, tmp_path / "whole")
    expected = contents(whole)
    for stop in itertools.count():
        dense = tmp_path / f"dense{stop}"
        if overwrite:
            shutil.copytree(whole.root, dense)
        left = iter(range(stop))

        def step(operation: Callable[..., Any], left: Iterator[int] = left) -> Callable[..., Any]:
            def counted(*arguments: Any, **options: Any) -> Any:
                if next(left, None) is None:
                    raise Killed
                return operation(*arguments, **options)

            return counted

        with monkeypatch.context() as patch:
            for name in ("replace", "rename", "unlink", "rmdir"):
                patch.setattr(Path, name, step(getattr(Path, name)))
            patch.setattr(shutil, "rmtree", lambda *_, **__: None)
            try:
                prepare(sparse, dense, overwrite=overwrite)
                break
            except Killed:
                pass
        assert contents(prepare(sparse, dense)) == expected
    assert stop > 20


def contents(workspace: Workspace) -> dict[str, bytes]:
    folders = (workspace.images_dir, workspace.sparse_dir, workspace.stereo_dir)
    paths = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(workspace.root)): path.read_bytes() for path in paths}


def test_workspace_of_an_earlier_version(tmp_path: Path) -> None:
    """Made all at once, with other facts in its marker and COLMAP's scripts: it is gone on with."""
    sparse = make_project(tmp_path, "OPENCV", (0.1, 0.0, 0.0, 0.0))
    new = prepare(sparse, tmp_path / "new")
    dense = tmp_path / "dense"
    old = Workspace(dense)
    pycolmap.undistort_images(dense, sparse, tmp_path / "images")
    marker = {"version": 1, "options": {"max_image_size": -1}, "images": "digest", "masks": None}
    marker["model"] = json.loads(new.marker_path.read_bytes())["model"]
    old.state_dir.mkdir()
    old.marker_path.write_text(json.dumps(marker))
    old.patch_match_cfg_path.write_text("a.png\nb.png\n")
    with pytest.raises(InputError, match="made with --max-image-size -1, not 48"):
        prepare(sparse, dense, UndistortionOptions(48))
    prepare(sparse, dense)
    assert not list(dense.glob("run-colmap-*"))
    assert not list(dense.rglob("*.backup*"))
    assert contents(old).keys() == contents(new).keys()
    assert old.patch_match_cfg_path.read_text() == "a.png\nb.png\n"


def test_a_model_in_a_workspace_of_an_earlier_version_that_the_user_reduced(tmp_path: Path) -> None:
    sparse = make_project(tmp_path, "OPENCV", (0.1, 0.0, 0.0, 0.0))
    new = prepare(sparse, tmp_path / "new")
    old = Workspace(tmp_path / "dense")
    pycolmap.undistort_images(old.root, sparse, tmp_path / "images")
    model = pycolmap.Reconstruction(old.sparse_dir)
    model.deregister_frame(model.image(4).frame_id)
    model.write_binary(old.sparse_dir)
    theirs = {path.name: path.read_bytes() for path in old.sparse_dir.iterdir()}
    marker = {"version": 1, "options": {"max_image_size": -1}, "images": "i", "masks": None}
    marker["model"] = json.loads(new.marker_path.read_bytes())["model"]
    old.state_dir.mkdir()
    old.marker_path.write_text(json.dumps(marker))
    prepare(sparse, old.root)
    assert {path.stem: path.read_bytes() for path in old.sparse_dir.glob("*.backup")} == theirs
    assert len(read_scene(old.sparse_dir).views) == 4


@pytest.mark.parametrize("given", [False, True])
def test_masks_in_a_workspace_of_an_earlier_version(tmp_path: Path, given: bool) -> None:
    """Those that it made are replaced; where it was given none they are the user's, and are used."""
    sparse = make_project(tmp_path, "OPENCV", (0.1, 0.0, 0.0, 0.0))
    new = prepare(sparse, tmp_path / "new")
    old = Workspace(tmp_path / "dense")
    pycolmap.undistort_images(old.root, sparse, tmp_path / "images")
    marker = {"version": 1, "options": {"max_image_size": -1}, "images": "i", "masks": "m" if given else None}
    marker["model"] = json.loads(new.marker_path.read_bytes())["model"]
    old.state_dir.mkdir()
    old.marker_path.write_text(json.dumps(marker))
    old.masks_dir.mkdir()
    mask = old.made_mask_path("a.png")
    assert cv2.imwrite(str(mask), np.full((HEIGHT, WIDTH), 255, np.uint8))
    before = mask.read_bytes()
    prepare(sparse, old.root)
    assert mask.exists() != given
    assert given or mask.read_bytes() == before
    assert not list(old.root.rglob("*.backup*"))


def test_a_mask_that_may_be_the_users_is_kept(tmp_path: Path) -> None:
    """Put there after a run that was killed between the beginning of an image and its record."""
    sparse = make_project(tmp_path, "OPENCV", (0.1, 0.0, 0.0, 0.0))
    workspace = prepare(sparse, tmp_path / "dense")
    begin(workspace.records_dir / "a.png.undistorted.json", [workspace.image_path("a.png")])
    mask = workspace.made_mask_path("a.png")
    mask.parent.mkdir()
    mask.write_bytes(b"mine")
    prepare(sparse, workspace.root)
    assert mask.with_name("a.png.png.backup").read_bytes() == b"mine"


def test_unfinished_workspace_is_not_worked_in(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    marker = json.loads(workspace.marker_path.read_bytes())
    workspace.marker_path.write_text(json.dumps(marker | {"images": []}))
    with pytest.raises(InputError, match="not finished; run with --model"):
        open_workspace(Project(workspace=workspace.root))


@pytest.mark.usefixtures("with_child_processes")
def test_colmaps_end_is_that_of_one_image(tmp_path: Path) -> None:
    """Its process is gone, with its last words; the next images get another."""
    child = ChildProcess(tmp_path)
    with pytest.raises(InputError, match=r"COLMAP ended with exit code 7 at x\.jpg \(so it ends\)"):
        child.call(end_process, "so it ends", "x.jpg")
    with pytest.raises(OutputError, match=r"x\.jpg cannot be written"):
        child.call(end_process, "Output file write error --- out of disk space?", "x.jpg")
    with pytest.raises(InputError, match="COLMAP ended by signal 11"):
        child.call(kill_process, signal.SIGSEGV, "x.jpg")
    with pytest.raises(InputError, match="what it says itself"):
        child.call(raise_error, InputError("what it says itself"), "x.jpg")
    child.call(Path.touch, tmp_path / "done", "x.jpg")
    assert (tmp_path / "done").exists()
    child.close()


@pytest.mark.usefixtures("with_child_processes")
def test_colmaps_process_may_start_before_its_folder_is_there(tmp_path: Path) -> None:
    child = ChildProcess(tmp_path / "scratch")
    child.start_for(Path.touch)
    (tmp_path / "scratch").mkdir()
    with pytest.raises(InputError, match="what it says itself"):
        child.call(raise_error, InputError("what it says itself"), "x.jpg")
    with pytest.raises(InputError, match=r"COLMAP ended with exit code 7 at x\.jpg \(so it ends\)"):
        child.call(end_process, "so it ends", "x.jpg")
    child.close()


def test_colmaps_process_loads_no_reader_of_images() -> None:
    """Runs wait for it: its module needs neither these nor what reads scenes."""
    program = f"import sys, {undistort_model.__module__}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=True)
    assert "pycolmap" in loaded.stdout.split()
    assert not {"cv2", "OpenImageIO", "scipy", "colmap_sph.scene"} & {*loaded.stdout.split()}


@pytest.mark.usefixtures("with_child_processes")
@pytest.mark.parametrize(
    ("camera_model", "extra", "size"),
    [
        ("OPENCV", (0.1, 0.01, 1e-3, -1e-3), -1),
        ("OPENCV", (0.1, 0.01, 1e-3, -1e-3), 60),
        ("PINHOLE", (), 48),
        ("SIMPLE_RADIAL_FISHEYE", (0.1,), -1),
    ],
)
def test_images_and_model_are_those_of_colmaps_undistorter(
    tmp_path: Path, camera_model: str, extra: tuple[float, ...], size: int
) -> None:
    sparse = make_project(tmp_path, camera_model, extra)
    options = UndistortionOptions(size)
    workspace = prepare(sparse, tmp_path / "dense", options)
    theirs = Workspace(tmp_path / "theirs")
    pycolmap.undistort_images(theirs.root, sparse, tmp_path / "images", undistort_options=options.for_colmap())
    for name in NAMES:
        assert workspace.image_path(name).read_bytes() == theirs.image_path(name).read_bytes()
    for name in ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"):
        assert (workspace.sparse_dir / name).read_bytes() == (theirs.sparse_dir / name).read_bytes()


def test_folder_of_someone_else_is_left_alone(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    # The project folder itself, whose images are the originals.
    with pytest.raises(InputError, match="lies inside the workspace"):
        prepare(sparse, tmp_path)
    assert (tmp_path / "images" / "a.png").is_file()
    assert not (tmp_path / "colmap_sph").exists()


def test_output_that_cannot_be_made(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    (tmp_path / "dense").write_text("a file in the way")
    with pytest.raises(OutputError, match="dense"):
        prepare(sparse, tmp_path / "dense")


def test_points_behind_a_panorama_are_seen(tmp_path: Path) -> None:
    """They lie behind its camera's plane of z = 0, as whatever is on the side that it is turned away from."""
    sparse = make_project(tmp_path, "EQUIRECTANGULAR")
    model = pycolmap.Reconstruction(sparse)
    for image in model.images.values():
        assert image.frame is not None
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.diag([1.0, -1.0, -1.0])), np.zeros(3))
        image.frame.rig_from_world = turn * image.cam_from_world()
    check_points_in_front(model, sparse)


def test_features_are_foreseen_where_they_come_to_be(tmp_path: Path) -> None:
    """A model is judged by them: by those of distorted images, a dry run would leave good images out."""
    sparse = make_project(tmp_path, "OPENCV", (-0.3, 0.1, 0.0, 0.0))
    options = UndistortionOptions()
    originals = read_originals(Project(sparse), options)
    foreseen = foreseen_scene(originals, NAMES, options)
    made = read_scene(prepare(sparse, tmp_path / "dense").sparse_dir)
    errors = [[view.reprojection_error for view in scene.views] for scene in (foreseen, made)]
    assert np.allclose(errors, 0.0, atol=1e-6)
    assert [view.K.tolist() for view in foreseen.views] == [view.K.tolist() for view in made.views]


def test_output_where_nobody_may_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sparse = make_project(tmp_path)
    monkeypatch.setattr("os.access", lambda path, _: Path(path) != tmp_path)
    project = Project(sparse, output=tmp_path / "new" / "dense")
    with pytest.raises(
        OutputError, match=f"dense cannot be created: {tmp_path} may not be written; give another --output"
    ):
        check_input(project, RunOptions())
    check_input(Project(sparse, output=tmp_path / "sparse" / "dense"), RunOptions())


@pytest.mark.parametrize("folder", ["images", "sparse/images", "sparse/0/images"])
def test_images_are_found(tmp_path: Path, folder: str) -> None:
    model_dir = tmp_path / "sparse" / "0"
    (model_dir / "images").mkdir(parents=True)
    (tmp_path / "images").mkdir()
    (tmp_path / folder / "cam").mkdir(parents=True)
    (tmp_path / folder / "cam" / "c.png").touch()
    assert find_images(model_dir, NAMES) == tmp_path / folder


@pytest.mark.parametrize("refused", ["cam", "."])
def test_images_are_found_though_a_folder_may_not_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: str
) -> None:
    """What is in it is left out by name, as a single image is that may not be read."""
    model_dir = make_project(tmp_path)
    real = Path.stat

    def stat(path: Path, **options: bool) -> os.stat_result:
        if path.is_relative_to(tmp_path / "images" / refused) and path.suffix == ".png":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path, **options)

    monkeypatch.setattr(Path, "stat", stat)
    assert find_images(model_dir, NAMES) == tmp_path / "images"


def test_images_of_a_workspace_are_its_own(tmp_path: Path) -> None:
    """They are as its model says; the originals of the same names may be distorted, and as large."""
    workspace = prepare(make_project(tmp_path), tmp_path / "dense")
    assert find_images(workspace.sparse_dir, NAMES) == workspace.images_dir


def test_images_are_found_from_a_relative_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_project(tmp_path)
    monkeypatch.chdir(tmp_path / "sparse")
    assert find_images(Path("0"), NAMES).resolve() == tmp_path / "images"


def test_images_not_found_lists_the_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        find_images(tmp_path / "sparse" / "0", NAMES)
    for folder in ("images", "sparse/images", "sparse/0/images"):
        assert str(tmp_path / folder) in str(error.value)


def test_wrong_image_folder(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    with pytest.raises(InputError, match="--images"):
        Preparation(Project(sparse, tmp_path / "nowhere", output=tmp_path / "dense"), RunOptions())


def test_options() -> None:
    with pytest.raises(OptionError, match="max_image_size"):
        UndistortionOptions(0).check()


def test_workspace_of_colmap_is_opened(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sparse = make_project(tmp_path, "OPENCV", (0.0, 0.0, 0.0, 0.0))
    pycolmap.undistort_images(tmp_path / "dense", sparse, tmp_path / "images")
    before = sorted(tmp_path.rglob("*"))
    workspace = open_workspace(Project(workspace=tmp_path / "dense"))
    assert sorted(tmp_path.rglob("*")) == before
    context = make_context(workspace)  # of an OPENCV camera without distortion
    workspace.image_path("a.png").unlink()
    assert [view.name for view in with_good_images(context, execute).scene.views] == NAMES[1:]
    assert "a.png is missing" in caplog.text


def test_what_is_no_workspace_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        open_workspace(Project(workspace=tmp_path / "nowhere"))
    with pytest.raises(InputError, match="no images folder"):
        open_workspace(Project(workspace=tmp_path))
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match="no sparse folder"):
        open_workspace(Project(workspace=tmp_path))
    (tmp_path / "sparse").mkdir()
    with pytest.raises(InputError, match="No COLMAP model"):
        open_workspace(Project(workspace=tmp_path))


def test_verify_makes_a_changed_image_again(tmp_path: Path) -> None:
    """Bit rot that still is an image looks like an image that the user has exchanged."""
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    path = workspace.image_path("a.png")
    sound = path.read_bytes()
    path.write_bytes(workspace.image_path("b.png").read_bytes())
    prepare(sparse, workspace.root)
    assert path.read_bytes() != sound
    Preparation(Project(sparse, output=workspace.root), RunOptions(), verify=True).run(execute)
    assert path.read_bytes() == sound
    assert path.with_name("a.png.backup").read_bytes() == workspace.image_path("b.png").read_bytes()


def test_masks_that_are_a_link_to_itself(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    (tmp_path / "masks").symlink_to("masks")
    with pytest.raises(InputError, match=r"mask folder .*masks does not exist"):
        prepare(sparse, tmp_path / "dense", masks=tmp_path / "masks")


def test_an_image_that_is_a_link_to_itself_is_left_out(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    (tmp_path / "images" / "b.png").unlink()
    (tmp_path / "images" / "b.png").symlink_to("b.png")
    workspace = prepare(sparse, tmp_path / "dense")
    assert [view.name for view in read_scene(workspace.sparse_dir).views] == ["a.png", "cam/c.png", "cam/d.png"]
