"""Views cut from fisheyes and panoramas: names, rigs, pictures, masks, range maps, and what goes wrong."""

import json
import shutil
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import no_room_beyond
from projects import prepare

from colmap_sph.app import cli
from colmap_sph.errors import InputError, OutputError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.pipeline.stages import undistort as undistort_stage
from colmap_sph.pipeline.stages.wide import range_maps as range_maps_stage
from colmap_sph.pipeline.stages.wide.range_maps import RangeStage
from colmap_sph.project.files import remove_temporary_files
from colmap_sph.project.project import Project
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.undistortion.process import ChildProcess
from colmap_sph.project.wide import cutting, layout, range_maps
from colmap_sph.project.wide.cuts import cuts_of
from colmap_sph.project.wide.layout import faces_of
from colmap_sph.project.wide.projection import Lens, camera_rays
from colmap_sph.project.wide.range_maps import CHANNELS, ViewMaps, range_and_normals, read_range_map
from colmap_sph.project.wide.table import TABLE_NAME, read_cuts
from colmap_sph.project.workspace import Workspace
from colmap_sph.synthetic import Camera, exact_geometry
from colmap_sph.synthetic.light import Light
from colmap_sph.synthetic.render import exact_picture
from colmap_sph.synthetic.wide.courtyard import (
    CourtyardOptions,
    build_courtyard,
    courtyard_cameras,
    courtyard_gsd,
    make_courtyard,
)

FISHEYE = CourtyardOptions(width=180, images=4, points=1500, supersample=2)
PANORAMA = CourtyardOptions(width=320, images=4, points=1500, supersample=2, panoramas=True)
OPTIONS = {"fisheye": FISHEYE, "panorama": PANORAMA}
FACES = {
    "fisheye": {"upper_left", "upper_right", "lower_left", "lower_right"},
    "panorama": {"front", "right", "back", "left", "up", "down"},
}


@pytest.fixture(scope="module")
def courtyard(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    root = tmp_path_factory.mktemp(request.param)
    make_courtyard(root, OPTIONS[request.param])
    return request.param, root


@pytest.fixture(scope="module")
def fisheyes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("fisheyes")
    make_courtyard(root, CourtyardOptions(width=120, images=4, points=300, supersample=1))
    return root


@pytest.fixture
def project(fisheyes: Path, tmp_path: Path) -> Path:
    """A copy to do with as a test likes."""
    for folder in ("images", "sparse"):
        shutil.copytree(fisheyes / folder, tmp_path / folder)
    return tmp_path


def model_in(root: Path) -> Path:
    return root / "sparse" / "0"


def rename(root: Path, names: dict[str, str]) -> None:
    """Give images of a project other names, in the model and on disk."""
    model = pycolmap.Reconstruction(model_in(root))
    for image in model.images.values():
        new = names.get(image.name, image.name)
        (root / "images" / new).parent.mkdir(parents=True, exist_ok=True)
        (root / "images" / image.name).rename(root / "images" / new)
        image.name = new
    model.write_binary(model_in(root))


# ---- names and rigs ------------------------------------------------------------------------------------------


def test_names_of_views(project: Path) -> None:
    rename(project, {"C_0_00.png": "cam/x/a.png", "C_0_01.png": "b.c.png"})
    names = {
        view.name: view for view in read_scene(prepare(model_in(project), project / "dense").sparse_dir).views
    }
    assert "cam/x/upper_left/a.png" in names
    assert names["lower_right/b.c.png"].original == names["lower_right/b.c.png"].photograph == "b.c.png"
    assert len(names) == 16


@pytest.mark.usefixtures("with_child_processes")
def test_views_need_no_process_for_colmap(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would load for half a second: COLMAP undistorts neither these images nor their model."""

    def start(*_: object) -> None:
        raise AssertionError("a process for COLMAP is started")

    monkeypatch.setattr(ChildProcess, "_start", start)
    assert len(read_scene(prepare(model_in(project), project / "dense").sparse_dir).views) == 16


def test_no_two_views_have_one_name(project: Path) -> None:
    # Two that differ by their ending alone, and one that is called like the view of another.
    rename(
        project,
        {
            "C_0_00.png": "a.png",
            "C_0_01.png": "a.jpg",
            "C_1_00.png": "upper_left/a.png",
            "C_1_01.png": "lower_left",
        },
    )
    cuts = cuts_of(pycolmap.Reconstruction(model_in(project)), "here", scale=0.7, max_size=-1)
    assert len(cuts.views) == 16
    assert set(cuts.of) == {"a.png", "a.jpg", "upper_left/a.png", "lower_left"}
    folders = {str(folder) for name in cuts.views for folder in Path(name).parents}
    assert not folders & set(cuts.views)


def test_rigs_and_tracks_are_kept(project: Path) -> None:
    """Two cameras, one a fisheye and one a pinhole, in a rig of which each instant has both."""
    old = pycolmap.Reconstruction(model_in(project))
    fisheye = old.camera(1)
    new = pycolmap.Reconstruction()
    fisheye.camera_id = 1
    new.add_camera(fisheye)
    new.add_camera(pycolmap.Camera(camera_id=2, model="PINHOLE", width=120, height=120, params=[60, 60, 60, 60]))
    rig = pycolmap.Rig(rig_id=1)
    sensors = {number: pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number) for number in (1, 2)}
    apart = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.3, 0.0])), np.array([0.2, 0.1, 0.0]))
    rig.add_ref_sensor(sensors[1])
    rig.add_sensor(sensors[2], apart)
    new.add_rig(rig)
    tracks: dict[int, pycolmap.Track] = {i: pycolmap.Track() for i in old.points3D}
    for number in sorted(old.images):
        source = old.image(number)
        pose = source.cam_from_world()
        frame = pycolmap.Frame(frame_id=number, rig_id=1)
        seen = {p.point3D_id: p.xy for p in source.points2D if p.has_point3D()}
        inside = {}
        for i, point in old.points3D.items():
            x, y, z = apart * (pose * point.xyz)
            if z > 0.1 and max(abs(x), abs(y)) < z:
                inside[i] = np.array([60 + 60 * x / z, 60 + 60 * y / z])
        parts = ((source.name, 1, number, seen), (f"pin/{source.name}", 2, number + 100, inside))
        for _, camera_id, image_id, _ in parts:
            frame.add_data_id(pycolmap.data_t(sensors[camera_id], image_id))
        frame.rig_from_world = pose
        new.add_frame(frame)
        for name, camera_id, image_id, observed in parts:
            image = pycolmap.Image(name, np.array(list(observed.values())).reshape(-1, 2), camera_id, image_id)
            image.frame_id = number
            new.add_image(image)
            for place, i in enumerate(observed):
                tracks[i].add_element(image_id, place)
        new.register_frame(number)
        (project / "images" / "pin").mkdir(exist_ok=True)
        shutil.copy(project / "images" / source.name, project / "images" / "pin" / source.name)
    for i, point in old.points3D.items():
        new.add_point3D(point.xyz, tracks[i], np.zeros(3, np.uint8))
    new.write_binary(model_in(project))

    workspace = prepare(model_in(project), project / "dense")
    made = pycolmap.Reconstruction(workspace.sparse_dir)
    assert (made.num_rigs(), made.num_frames(), made.num_cameras(), made.num_images()) == (1, 4, 5, 20)
    assert next(iter(made.rigs.values())).num_sensors() == 5
    cuts = read_cuts(workspace.sparse_dir)
    assert set(cuts) == {name for name in (image.name for image in made.images.values()) if "pin/" not in name}
    for image in made.images.values():
        cut = cuts.get(image.name)
        source = new.find_image_with_name(image.name if cut is None else cut.original)
        turn = np.eye(3) if cut is None else cut.face.R
        expected = turn @ source.cam_from_world().rotation.matrix()
        np.testing.assert_allclose(image.cam_from_world().rotation.matrix(), expected, atol=1e-12)
        np.testing.assert_allclose(image.projection_center(), source.projection_center(), atol=1e-12)

    # Nothing that an image observed is lost, and a track names none twice.
    def original(image_id: int) -> str:
        name = made.image(image_id).name
        return cuts[name].original if name in cuts else name

    for i, point in new.points3D.items():
        before = {new.image(element.image_id).name for element in point.track.elements}
        if len(before) >= 2:
            elements = made.points3D[i].track.elements
            assert {original(element.image_id) for element in elements} == before
            assert len({element.image_id for element in elements}) == len(elements)


@pytest.mark.parametrize("courtyard", ["fisheye", "panorama"], indirect=True)
def test_points_lie_where_they_are_observed(courtyard: tuple[str, Path], tmp_path: Path) -> None:
    _, root = courtyard
    workspace = prepare(model_in(root), tmp_path / "dense")
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    errors = []
    for image in model.images.values():
        camera = model.camera(image.camera_id)
        for seen in image.get_observation_points2D():
            x, y, z = image.cam_from_world() * model.points3D[seen.point3D_id].xyz
            f, _, cx, cy = camera.params
            errors.append(np.hypot(f * x / z + cx - seen.xy[0], f * y / z + cy - seen.xy[1]))
            assert 0 <= seen.xy[0] <= camera.width
            assert 0 <= seen.xy[1] <= camera.height
    # What there is is the noise of the key points, 0.3 pixels; views are 0.7 times as fine, corners finer.
    assert np.median(errors) < 0.5
    assert np.percentile(errors, 99) < 2.5


# ---- pictures and masks --------------------------------------------------------------------------------------


@pytest.mark.parametrize("courtyard", ["fisheye", "panorama"], indirect=True)
def test_views_are_pictures_of_a_pinhole(courtyard: tuple[str, Path], tmp_path: Path) -> None:
    """As rendered by that pinhole, but for the blur of the wide picture."""
    kind, root = courtyard
    workspace = prepare(model_in(root), tmp_path / "dense")
    options = OPTIONS[kind]
    surfaces = build_courtyard(courtyard_gsd(options), options.seed)
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    views = [image for image in model.images.values() if image.name.endswith("C_0_01.png")]
    assert {image.name.split("/")[0] for image in views} == FACES[kind]
    for image in views:
        camera = model.camera(image.camera_id)
        pose = image.cam_from_world()
        K = camera.calibration_matrix()
        there = Camera(K, pose.rotation.matrix(), pose.translation, camera.width, camera.height)
        expected = exact_picture(surfaces, there, light=Light())[..., ::-1]
        found = cv2.imread(str(workspace.image_path(image.name)))
        mask = cv2.imread(str(workspace.mask_path(image.name)), cv2.IMREAD_GRAYSCALE)
        assert found is not None and mask is not None
        assert found.shape == expected.shape
        inside = cv2.erode(mask, np.ones((3, 3))) == 255
        # Of the shadows, which are not in what is expected, the fine detail knows nothing.
        blurred = [
            cv2.GaussianBlur(picture.astype(np.float64).mean(axis=2), (0, 0), 1.0) for picture in (found, expected)
        ]
        here, that = (inside * (picture - cv2.GaussianBlur(picture, (0, 0), 4.0)) for picture in blurred)
        # Of a size that OpenCV need not fill up: it is half a pixel off then.
        middle = (slice(here.shape[0] // 2 - 36, here.shape[0] // 2 + 36), slice(here.shape[1] // 2 - 36, None))
        here, that = (picture[middle][:, :72].copy() for picture in (here, that))
        shift, response = cv2.phaseCorrelate(here, that)
        assert np.linalg.norm(shift) < 0.25
        assert response > 0.5


def test_masks_are_the_users_and_the_lenss(project: Path) -> None:
    masks = project / "masks"
    masks.mkdir()
    mask = np.full((120, 120), 255, np.uint8)
    mask[:, :60] = 0  # the left half
    cv2.imwrite(str(masks / "C_0_00.png.png"), mask)
    workspace = prepare(model_in(project), project / "dense", masks=masks)

    def white(name: str) -> np.ndarray:
        found = cv2.imread(str(workspace.mask_path(name)), cv2.IMREAD_GRAYSCALE)
        assert found is not None
        assert set(np.unique(found)) <= {0, 255}
        return found == 255

    # Of a left view only what it shows beyond the axis is left, of a right one nothing but that is lost.
    assert 0 < white("upper_left/C_0_00.png").mean() < 0.35 < 0.6 < white("upper_right/C_0_00.png").mean()
    whole = white("upper_left/C_0_01.png")
    assert 0.6 < whole.mean() < 1
    view = cv2.imread(str(workspace.image_path("upper_left/C_0_01.png")))
    assert view is not None
    assert not view[~whole].any()


def test_16_bits_stay(project: Path) -> None:
    for path in (project / "images").iterdir():
        picture = cv2.imread(str(path))
        assert picture is not None
        cv2.imwrite(str(path), picture.astype(np.uint16) * 257)
    workspace = prepare(model_in(project), project / "dense")
    view = cv2.imread(str(workspace.image_path("upper_left/C_0_01.png")), cv2.IMREAD_UNCHANGED)
    assert view is not None
    assert view.dtype == np.uint16
    assert view.max() > 30000


# ---- what is there already -----------------------------------------------------------------------------------


def stamps(workspace: Workspace) -> dict[str, int]:
    return {
        path.relative_to(workspace.root).as_posix(): path.stat().st_mtime_ns
        for folder in (workspace.images_dir, workspace.sparse_dir)
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_only_views_of_a_changed_image_are_cut_again(project: Path) -> None:
    workspace = prepare(model_in(project), project / "dense")
    before = stamps(workspace)
    assert stamps(prepare(model_in(project), project / "dense")) == before
    path = project / "images" / "C_1_01.png"
    picture = cv2.imread(str(path))
    assert picture is not None
    cv2.imwrite(str(path), 255 - picture)
    prepare(model_in(project), project / "dense")
    changed = {name for name, stamp in stamps(workspace).items() if stamp != before[name]}
    assert changed == {f"images/{face}/C_1_01.png" for face in FACES["fisheye"]}


def test_another_scale_is_another_workspace(project: Path) -> None:
    workspace = prepare(model_in(project), project / "dense")
    with pytest.raises(InputError, match=r"made with --undistortion.wide-scale 0.7, not 1.0"):
        prepare(model_in(project), project / "dense", UndistortionOptions(wide_scale=1.0))
    small = max(view.width for view in read_scene(workspace.sparse_dir).views)
    prepare(model_in(project), project / "dense", UndistortionOptions(wide_scale=1.0), overwrite=True)
    large = max(view.width for view in read_scene(workspace.sparse_dir).views)
    assert large == pytest.approx(small / 0.7, abs=2)


def test_views_that_another_version_cut_give_way(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    layout.faces_of.cache_clear()
    monkeypatch.setattr(layout, "_MOST_PIXELS", 0.0)  # to the left, right, up and down
    workspace = Workspace(project / "dense")
    arguments = ["run", "--model", str(model_in(project)), "--threads", "1", "--rectification.sampling", "0.5"]
    assert cli.main(arguments) == 0
    of_the_user = project / "dense" / "images" / "up" / "C_0_00.png"
    cv2.imwrite(str(of_the_user), np.zeros((50, 60, 3), np.uint8))
    former = [path for path in workspace.root.rglob("*.*") if path.parent.name in {"left", "right", "up", "down"}]
    assert len(former) > 16 * 4
    monkeypatch.undo()
    layout.faces_of.cache_clear()
    assert cli.main(arguments) == 0
    assert {Path(view.name).parent.name for view in read_scene(workspace.sparse_dir).views} == FACES["fisheye"]
    assert {path.name for path in former if path.exists()} == {"C_0_00.png", "C_0_00.png.undistorted.json"}
    assert of_the_user.exists()


def test_views_of_another_size_get_a_model_of_their_own(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their names are the same; another version of the program let them reach farther."""
    layout.faces_of.cache_clear()
    monkeypatch.setattr(layout, "_OVERLAP", 14.0)
    before = read_scene(prepare(model_in(project), project / "dense").sparse_dir)
    monkeypatch.undo()
    layout.faces_of.cache_clear()
    workspace = prepare(model_in(project), project / "dense")
    after = read_scene(workspace.sparse_dir)
    assert before.index_of.keys() == after.index_of.keys()
    for view in after.views:
        image = cv2.imread(str(workspace.image_path(view.name)))
        assert image is not None
        assert image.shape[:2] == (view.height, view.width)
        assert view.num_pixels < before.view(view.name).num_pixels


def test_the_scale_has_no_part_in_other_workspaces(project: Path) -> None:
    model = pycolmap.Reconstruction(model_in(project))
    model.camera(1).model = pycolmap.CameraModelId.PINHOLE
    model.camera(1).params = [60, 60, 60, 60]
    model.write_binary(model_in(project))
    workspace = prepare(model_in(project), project / "dense")
    assert json.loads(workspace.marker_path.read_text())["options"] == {"max_image_size": -1}
    before = stamps(workspace)
    assert not any(name.endswith(TABLE_NAME) for name in before)
    assert stamps(prepare(model_in(project), project / "dense", UndistortionOptions(wide_scale=1.0))) == before


# ---- what goes wrong -----------------------------------------------------------------------------------------


def test_a_damaged_image_is_left_out_by_its_own_name(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(project / "images" / "C_0_00.png"), np.zeros((50, 60, 3), np.uint8))
    workspace = prepare(model_in(project), project / "dense")
    assert len(read_scene(workspace.sparse_dir).views) == 12
    cli.main(["run", "--model", str(model_in(project)), "--threads", "1", "--rectification.sampling", "0.5"])
    report = json.loads((project / "dense" / "colmap_sph" / "report.json").read_text())
    assert "C_0_00.png" in report["skipped_images"]
    assert not any(name.endswith("/C_0_00.png") for name in report["skipped_images"])
    assert "Traceback" not in capsys.readouterr().err


def test_an_image_without_any_depth_is_told_by_its_own_name(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(project / "images" / "C_0_00.png"), np.full((120, 120, 3), 90, np.uint8))
    cli.main(["run", "--model", str(model_in(project)), "--threads", "1"])
    report = json.loads((project / "dense" / "colmap_sph" / "report.json").read_text())
    views = report["views"]["C_0_00.png"]
    assert sorted(views) == [f"{face}/C_0_00.png" for face in sorted(FACES["fisheye"])]
    assert set(views) <= set(report["skipped_images"])
    assert report["originals"]["C_0_00.png"] == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "image skipped" in line]
    assert [line.split(": ")[1] for line in told if line.split(": ")[1].endswith("C_0_00.png")] == ["C_0_00.png"]
    page = (project / "dense" / "colmap_sph" / "report.html").read_text()
    assert "<li>C_0_00.png: " in page.replace("<b>", "").replace("</b>", "")


@pytest.mark.parametrize(
    "text", ["", "{}", '{"version": 9}', '{"version":1,"lenses":[],"faces":[],"views":{"a":{}}}']
)
def test_a_damaged_table_is_named(project: Path, text: str) -> None:
    workspace = prepare(model_in(project), project / "dense")
    (workspace.sparse_dir / TABLE_NAME).write_text(text)
    with pytest.raises(InputError, match=TABLE_NAME):
        read_scene(workspace.sparse_dir)


@pytest.mark.parametrize("old", ["upper_left/C_0_00.png", '"original": "C_0_00.png"'])
def test_a_table_whose_names_lead_elsewhere_is_damaged(project: Path, old: str) -> None:
    workspace = prepare(model_in(project), project / "dense")
    table = workspace.sparse_dir / TABLE_NAME
    whole = table.read_text()
    assert old in whole
    table.write_text(whole.replace(old, old.replace("C_0", "../../../C_0")))
    with pytest.raises(InputError, match=rf"{TABLE_NAME} cannot be used .* --overwrite"):
        read_cuts(workspace.sparse_dir)


# ---- range maps ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["fisheye", "panorama"])
def test_range_of_exact_maps_is_exact(kind: str) -> None:
    """Exact depth of the views, joined → the range that was rendered of the wide image itself."""
    options = OPTIONS[kind]
    surfaces = build_courtyard(courtyard_gsd(options), options.seed)
    camera = next(iter(courtyard_cameras(options).values()))
    name, params = camera.colmap
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=name, width=camera.width, height=camera.height, params=params)
    )
    model.add_image_with_trivial_frame(pycolmap.Image("a.png", np.empty((0, 2)), 1, 1), pycolmap.Rigid3d())
    cuts = cuts_of(model, "here", scale=1.0, max_size=-1)
    maps = []
    for cut in cuts.views.values():
        face = cut.face
        K = np.array([[face.focal, 0, face.x], [0, face.focal, face.y], [0, 0, 1]])
        there = Camera(K, face.R @ camera.R, face.R @ camera.t, face.width, face.height)
        depth, normals, _ = exact_geometry(surfaces, there, origin=0.0)
        maps.append(ViewMaps(face.R, K, depth.astype(np.float32), normals.astype(np.float32)))
    lens = next(iter(cuts.views.values())).lens
    distance, joined = range_and_normals(lens, maps)
    exact, exact_normals, _ = exact_geometry(surfaces, camera)
    both = (exact > 0) & (distance > 0)
    error = np.abs(distance - exact)[both] / exact[both]
    assert both.sum() > 0.97 * ((exact > 0) & np.isfinite(exact)).sum()
    assert np.median(error) < 1e-6
    assert (error < 1e-3).mean() > 0.93  # but for the borders of things
    agree = np.einsum("ni,ni->n", joined[both], exact_normals[both])
    assert np.median(agree) > 1 - 1e-6
    assert (agree > 0.999).mean() > 0.9


def test_range_is_the_mean_of_the_views_that_agree() -> None:
    """Views that see spheres around the camera → of each pixel the mean of those like its own view's."""
    lens = Lens("EQUIRECTANGULAR", (360.0, 180.0), 360, 180)
    radii = np.array([1.0, 1.01, 1.02, 1.1, 1.12, 1.03])
    x, y = np.meshgrid(np.arange(360) + 0.5, np.arange(180) + 0.5)
    rays = camera_rays(lens, np.column_stack([x.ravel(), y.ravel()]))
    maps, cosines = [], []
    for face, radius in zip(faces_of(lens), radii, strict=True):
        K = np.array([[face.focal, 0, face.x], [0, face.focal, face.y], [0, 0, 1]])
        columns, rows = np.meshgrid(np.arange(face.width), np.arange(face.height))
        own = np.stack([columns, rows, np.ones_like(rows)], axis=2) @ np.linalg.inv(K).T
        own = own / np.linalg.norm(own, axis=2, keepdims=True)
        maps.append(ViewMaps(face.R, K, (radius * own[:, :, 2]).astype(np.float32), -own.astype(np.float32)))
        _, is_shown = face.points(rays)
        cosines.append(np.where(is_shown, rays @ face.R[2], -1.0))
    owner = np.argmax(cosines, axis=0)
    is_same = (np.array(cosines) > 0) & (np.abs(radii[:, None] - radii[owner]) < 0.05 * radii[owner])
    expected = (radii[:, None] * is_same).sum(axis=0) / is_same.sum(axis=0)
    distance, normals = range_and_normals(lens, maps)
    assert len(np.unique(expected)) > 10
    error = np.abs(distance.ravel() - expected)
    assert (error < 1e-3).mean() > 0.97  # but for the outermost half of a pixel of a view
    assert np.einsum("ni,ni->n", normals.reshape(-1, 3), rays).max() < -0.999


def test_the_same_range_map_is_the_same_file_at_any_time(tmp_path: Path) -> None:
    maps = (np.ones((4, 6), np.float32), np.ones((4, 6, 3), np.float32))
    digests = []
    for name in ("a.exr", "b.exr"):
        digests.append(range_maps.write_range_map(tmp_path / name, *maps))
        time.sleep(1.1)  # dates in OpenEXR have seconds
    assert digests[0] == digests[1]
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


@pytest.mark.parametrize("lost", [1, 300])
def test_a_range_map_whose_last_bytes_the_disk_does_not_take(tmp_path: Path, lost: int) -> None:
    """OpenImageIO does not notice: a run took a map that was cut off for whole, and kept it for good."""
    rng = np.random.default_rng(0)
    maps = rng.random((40, 60), np.float32), rng.random((40, 60, 3), np.float32)
    range_maps.write_range_map(tmp_path / "whole.exr", *maps)
    size = (tmp_path / "whole.exr").stat().st_size
    with no_room_beyond(size - lost), pytest.raises(OutputError, match=r"a\.exr cannot be written"):
        range_maps.write_range_map(tmp_path / "a.exr", *maps)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.exr"]


def test_a_kill_while_a_range_map_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next run removes what it left: such maps are large."""
    killed = tmp_path / "killed"

    def kill(path: Path, **_: object) -> None:
        shutil.copytree(path.parent, killed)
        raise KeyboardInterrupt

    monkeypatch.setattr(range_maps, "atomic_file", kill)
    maps = (np.ones((4, 6), np.float32), np.ones((4, 6, 3), np.float32))
    with pytest.raises(KeyboardInterrupt):
        range_maps.write_range_map(tmp_path / "maps" / "a.exr", *maps)
    assert [path.name for path in killed.rglob("*.exr")] == ["made.exr"]
    remove_temporary_files(killed)
    assert list(killed.iterdir()) == []


@pytest.mark.parametrize("courtyard", ["fisheye", "panorama"], indirect=True)
def test_range_maps_are_foreseen_before_there_are_views(courtyard: tuple[str, Path], tmp_path: Path) -> None:
    """By the views' pixels, which tell about how many the originals have."""
    kind, root = courtyard
    plan = make_plan(Project(model_in(root), output=tmp_path / "dense"), RunOptions())
    (stage,) = [stage for stage in plan.stages if stage.name == RangeStage.name]
    pictures = [cv2.imread(str(path)) for path in (root / "images").iterdir()]
    pixels = sum(picture.shape[0] * picture.shape[1] for picture in pictures if picture is not None)
    assert (stage.total, len(pictures)) == (4, 4)
    assert 0.7 < stage.disk / (range_maps_stage._FILE_BYTES * pixels) < 1.5
    assert 0.7 < stage.seconds / (range_maps_stage._SECONDS * pixels * len(FACES[kind])) < 1.5


def test_what_is_kept_of_wide_images_goes_with_their_stages(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The places of views' pixels and the rays of images', as large as several of them."""
    kept = {cutting._places: [0], range_maps._rays: [0]}
    for module, made in ((undistort_stage, cutting._places), (range_maps_stage, range_maps._rays)):
        (name,) = [name for name in vars(module) if name.startswith("forget_")]
        forget = getattr(module, name)

        def noted(made: Any = made, forget: Any = forget) -> None:
            kept[made].append(made.cache_info().currsize)
            forget()
            kept[made].append(made.cache_info().currsize)

        monkeypatch.setattr(module, name, noted)
    assert cli.main(["run", "--model", str(model_in(project)), "--threads", "1"]) in (0, 5)
    (_, places, no_places), (_, rays, no_rays) = kept.values()
    assert (places, no_places, rays, no_rays) == (len(FACES["fisheye"]), 0, 1, 0)


@pytest.mark.parametrize("courtyard", ["fisheye", "panorama"], indirect=True)
def test_wide_images_from_end_to_end(
    courtyard: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kind, root = courtyard
    dense = tmp_path / "dense"
    command = ["run", "--model", str(model_in(root)), "--output", str(dense), "--threads", "2", "--num-pairs", "4"]
    assert cli.main(command) in (0, 5), capsys.readouterr().err  # a view of the sky has no partner
    seen, covered, good, off = (0, 0, 0, 0)
    for path in sorted((root / "truth").iterdir()):
        exact = np.load(path)["range"]
        distance, normals = read_range_map(dense / "stereo" / "range_maps" / f"{path.stem}.exr")
        assert distance.shape == exact.shape
        np.testing.assert_allclose(np.linalg.norm(normals[distance > 0], axis=1), 1, atol=1e-3)
        seen += (exact > 0).sum()
        covered += ((exact > 0) & (distance > 0)).sum()
        good += ((exact > 0) & (np.abs(distance - exact) < 0.03 * exact)).sum()
        off += ((exact > 0) & (distance > 0) & (np.abs(distance - exact) > 0.05 * exact)).sum()
    assert covered > 0.7 * seen
    # With all rims it would be .136 and .067.
    assert off < {"fisheye": 0.128, "panorama": 0.064}[kind] * covered
    report = json.loads((dense / "colmap_sph" / "report.json").read_text())
    assert set(report["originals"]) == {path.stem for path in (root / "truth").iterdir()}
    assert 0.3 < min(report["originals"].values()) < max(report["originals"].values()) < 0.9  # there is sky
    assert good > 0.7 * covered  # with few pixels, many lie at the border of something
    assert len(CHANNELS) == 4
    # A second run, and a plan, find all there.
    before = stamps(Workspace(dense)) | {"cloud": (dense / "fused.ply").stat().st_mtime_ns}
    capsys.readouterr()
    assert cli.main([*command, "--dry-run"]) == 0
    cli.main(command)
    assert stamps(Workspace(dense)) | {"cloud": (dense / "fused.ply").stat().st_mtime_ns} == before
    # COLMAP reads what is there: its model, and its own fusion of the maps.
    fused = tmp_path / "colmap.ply"
    cloud = pycolmap.stereo_fusion(fused, dense, output_type="PLY")
    assert cloud.num_points3D() > 1000
