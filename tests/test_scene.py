"""The scene is what COLMAP's own objects say, and damage is told in one sentence."""

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_sph.errors import InputError
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.sparse_model import load_model
from colmap_sph.scene import View
from colmap_sph.stereo.partners.frusta import sees


def make_model(camera_model: str = "PINHOLE", num_images: int = 4) -> pycolmap.Reconstruction:
    """Cameras on a circle about a cloud of random points, tracks in every image."""
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, camera_model, 500.0, 640, 480)
    model.add_camera_with_trivial_rig(camera)
    points = rng.uniform(-1, 1, (30, 3))
    for image_id in range(1, num_images + 1):
        angle = 0.2 * image_id
        rotation = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0.1, -0.2, 5.0]))
        # Names in the reverse order of the ids.
        image = pycolmap.Image(
            name=f"sub/{num_images - image_id}.png",
            keypoints=np.zeros((40, 2)),
            camera_id=1,
            image_id=image_id,
        )
        model.add_image_with_trivial_frame(image, pose)
    for index, xyz in enumerate(points):
        track = pycolmap.Track()
        for image_id in range(1, num_images + 1):
            if (index + image_id) % 3:
                track.add_element(image_id, index + 5)
        model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    return model


def write(model: pycolmap.Reconstruction, folder: Path, text: bool) -> Path:
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(folder)
    return folder


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("camera_model", ["PINHOLE", "SIMPLE_PINHOLE", "OPENCV"])
def test_scene_agrees_with_colmap(tmp_path: Path, text: bool, camera_model: str) -> None:
    model = make_model(camera_model)
    scene = read_scene(write(model, tmp_path / "sparse", text))
    assert [view.name for view in scene.views] == [f"sub/{i}.png" for i in range(4)]
    for view in scene.views:
        image = model.image(view.image_id)
        assert (view.name, view.width, view.height) == (image.name, 640, 480)
        seen = [i for i in range(30) if (i + view.image_id) % 3]
        expected = np.array([model.point3D(i + 1).xyz for i in seen])
        np.testing.assert_allclose(scene.points[view.point_indices], expected, atol=1e-12)
        for point, pixel, depth in zip(expected, *view.project(expected), strict=True):
            projected = image.project_point(point)
            assert projected is not None
            np.testing.assert_allclose(pixel, projected, atol=1e-9)
            np.testing.assert_allclose(depth, (image.cam_from_world() * point)[2], atol=1e-12)
        np.testing.assert_allclose(view.center, image.projection_center(), atol=1e-12)
        np.testing.assert_allclose(view.viewing_direction, image.viewing_direction(), atol=1e-12)
        np.testing.assert_allclose(view.cam_from_world, image.cam_from_world().matrix(), atol=1e-12)


def test_points_that_have_no_pixel_are_told_by_their_depth() -> None:
    K = np.array([[100.0, 0, 50], [0, 200, 40], [0, 0, 1]])
    view = View(1, "a", 100, 80, K, np.eye(3), np.array([0, 0, -1.0]), np.empty(0, np.int64))
    pixels, depth = view.project(np.array([[0.1, 0.2, 2], [0.1, 0.2, 0], [0.1, 0.2, 1], [0, 0, 1]]))
    assert depth.tolist() == [1, -1, 0, 0]
    np.testing.assert_allclose(pixels[:2], [[60, 80], [40, 0]], atol=1e-12)
    assert not np.isfinite(pixels[2:]).any()


def test_an_image_ends_at_the_outer_edges_of_its_pixels() -> None:
    view = View(1, "a", 100, 80, np.diag([1.0, 1, 1]), np.eye(3), np.zeros(3), np.empty(0, np.int64))
    inside = [[0.01, 0.01], [99.99, 79.99], [50, 0.01], [0.01, 40]]
    outside = [[-0.01, 40], [100.01, 40], [50, -0.01], [50, 80.01]]
    for depth, seen in ((1, [True] * 4 + [False] * 4), (-1, [False] * 8)):
        points = np.column_stack([inside + outside, np.ones(8)]) * depth
        assert sees(view, points).tolist() == seen


def test_view_by_name(tmp_path: Path) -> None:
    scene = read_scene(write(make_model(), tmp_path / "sparse", text=False))
    assert scene.view("sub/2.png") is scene.views[2]
    with pytest.raises(InputError, match="nothing"):
        scene.view("nothing.png")


def test_model_without_points(tmp_path: Path) -> None:
    model = make_model()
    model.delete_all_points2D_and_points3D()
    scene = read_scene(write(model, tmp_path / "sparse", text=False))
    assert scene.points.shape == (0, 3)
    assert all(view.point_indices.shape == (0,) for view in scene.views)


def test_pose_that_is_not_finite_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = make_model()
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, np.nan, 0.0]))
    frame = model.image(2).frame
    assert frame is not None
    frame.rig_from_world = pose
    model.points3D[3].xyz = np.array([np.inf, 0.0, 0.0])
    scene = read_scene(write(model, tmp_path / "sparse", text=False))
    assert [view.image_id for view in scene.views] == [4, 3, 1]
    assert scene.points.shape == (29, 3) and np.isfinite(scene.points).all()
    assert "sub/2.png" in caplog.text and "1 sparse point without possible coordinates" in caplog.text


@pytest.mark.parametrize("num_turned", [3, 4])
def test_points_behind_all_images_are_refused(tmp_path: Path, num_turned: int) -> None:
    """As in a model whose z axes point backwards; one image whose points are in front goes on."""
    model = make_model()
    half_turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.diag([-1.0, 1.0, -1.0])), np.zeros(3))
    for image_id in range(1, num_turned + 1):
        image = model.image(image_id)
        assert image.frame is not None
        image.frame.rig_from_world = half_turn * image.cam_from_world()
    sparse = write(model, tmp_path / "sparse", text=False)
    if num_turned < 4:
        assert len(read_scene(sparse).views) == 4
    else:
        with pytest.raises(InputError, match=r"sparse lie behind the images .*; export the model again\."):
            read_scene(sparse)


def test_distorted_camera_is_refused(tmp_path: Path) -> None:
    model = make_model("OPENCV")
    model.camera(1).params = [500.0, 500.0, 320.0, 240.0, 0.1, 0.0, 0.0, 0.0]
    sparse = write(model, tmp_path / "sparse", text=False)
    assert load_model(sparse).num_reg_images() == 4
    with pytest.raises(InputError, match="OPENCV"):
        read_scene(sparse)


def test_missing_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_scene(tmp_path / "nowhere")
    write(make_model(), tmp_path / "sparse" / "0", text=False)
    with pytest.raises(InputError, match=r"did you mean .*sparse/0\?"):
        read_scene(tmp_path / "sparse")
    # Which of several is for the user to say; a workspace's own is no other one.
    write(make_model(), tmp_path / "sparse" / "1", text=True)
    write(make_model(), tmp_path / "dense" / "sparse", text=False)
    with pytest.raises(InputError, match=r"did you mean [^ ]*sparse/0 or [^ ]*sparse/1\?"):
        read_scene(tmp_path / "sparse")
    with pytest.raises(InputError, match=r"did you mean [^ ]*sparse/0 or [^ ]*sparse/1\?"):
        read_scene(tmp_path)


@pytest.mark.parametrize("is_text", [False, True])
@pytest.mark.parametrize("name", ["cameras", "points3D"])
def test_a_file_that_a_model_lacks_is_named(tmp_path: Path, name: str, is_text: bool) -> None:
    sparse = write(make_model(), tmp_path / "sparse", text=is_text)
    (lacking,) = sparse.glob(f"{name}.*")
    lacking.unlink()
    with pytest.raises(InputError, match=rf"but no {name}\.(bin|txt); copy it") as error:
        read_scene(sparse)
    assert ("(an empty one where" in str(error.value)) == (lacking.name == "points3D.txt")


def test_model_without_registered_image(tmp_path: Path) -> None:
    sparse = write(pycolmap.Reconstruction(), tmp_path / "sparse", text=False)
    with pytest.raises(InputError, match="no registered image"):
        read_scene(sparse)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("damage", ["empty", "truncated", "garbage"])
def test_damaged_binary_model(tmp_path: Path, name: str, damage: str) -> None:
    sparse = write(make_model(), tmp_path / "sparse", text=False)
    path = sparse / f"{name}.bin"
    data = path.read_bytes()
    path.write_bytes({"empty": b"", "truncated": data[: len(data) * 2 // 3], "garbage": b"\xff" * 300}[damage])
    with pytest.raises(InputError, match=r"sparse.*(damaged|truncated|unknown camera)"):
        read_scene(sparse)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(("there", "missing"), [("rigs", "frames"), ("frames", "rigs")])
def test_model_with_rigs_or_frames_alone(tmp_path: Path, there: str, missing: str, text: bool) -> None:
    sparse = write(make_model(), tmp_path / "sparse", text=text)
    ending = "txt" if text else "bin"
    (sparse / f"{missing}.{ending}").unlink()
    with pytest.raises(InputError, match=rf"has {there}\.{ending} and no {missing}\.{ending}; copy both"):
        read_scene(sparse)
    (sparse / f"{there}.{ending}").unlink()
    assert len(read_scene(sparse).views) == make_model().num_reg_images()


def test_real_model(data_dir: Path, tmp_path: Path) -> None:
    source = data_dir / "fountain" / "sparse" / "0"
    scene = read_scene(source)
    assert len(scene.views) == 11
    # Every observation projects to where its feature was found (undistorted image, 0.5 px mean error).
    model = pycolmap.Reconstruction(source)
    for view in scene.views:
        camera_points = scene.points[view.point_indices] @ view.R.T + view.t
        pixels = (camera_points @ view.K.T)[:, :2] / camera_points[:, 2:]
        observed = np.array([p.xy for p in model.image(view.image_id).points2D if p.has_point3D()])
        ids = [p.point3D_id for p in model.image(view.image_id).points2D if p.has_point3D()]
        order = np.argsort(ids, kind="stable")
        if len(set(ids)) == len(ids):
            assert np.median(np.linalg.norm(pixels - observed[order], axis=1)) < 1.0
    # A text export without the rig files of COLMAP 3.12 is what older versions write.
    old = write(model, tmp_path / "text", text=True)
    for name in ("rigs.txt", "frames.txt"):
        (old / name).unlink()
    again = read_scene(old)
    for view, same in zip(scene.views, again.views, strict=True):
        np.testing.assert_allclose(view.cam_from_world, same.cam_from_world, atol=1e-9)
        np.testing.assert_array_equal(view.point_indices, same.point_indices)
    shutil.rmtree(old)


def test_image_name_that_is_not_utf8(tmp_path: Path) -> None:
    make_model().write_binary(tmp_path)
    path = tmp_path / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"sub/1.png", b"sub/\xe9.png"))
    with pytest.raises(InputError, match=r"image name b'sub/\\xe9\.png', which is not UTF-8"):
        read_scene(tmp_path)


@pytest.mark.parametrize("coordinate", [1e300, -1e200, np.inf, np.nan])
def test_impossible_points_are_left_out(tmp_path: Path, coordinate: float) -> None:
    """Also those whose squares are beyond floats; no warning of NumPy's comes up."""
    model = make_model()
    expected = len(model.points3D)
    model.point3D(min(model.points3D)).xyz = [0.0, coordinate, 0.0]
    model.write_binary(tmp_path)
    scene = read_scene(tmp_path)
    assert len(scene.points) == expected - 1
    assert np.abs(scene.points).max() < 10


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ([1e300, 320, 240], "the focal length of its camera is 1e[+]300"),
        ([500, 1e300, 240], "the principal point of its camera is 1e[+]300 and 240 pixels"),
        ([1e-30, 320, 240], "the focal length of its camera is 1e-30"),
        ([-500, 320, 240], "the focal length of its camera is -500"),
        ([np.inf, 320, 240], "the focal length of its camera is inf"),
    ],
)
def test_impossible_calibrations_are_told(tmp_path: Path, params: list[float], words: str) -> None:
    model = make_model("SIMPLE_PINHOLE")
    model.camera(1).params = params
    model.write_binary(tmp_path)
    with pytest.raises(InputError, match=f"No image of the model .* {words}"):
        read_scene(tmp_path)


@pytest.mark.parametrize(
    ("scale", "words"), [(1e15, "some .e[+]15 units from"), (1e-30, "only .e-30 units apart")]
)
def test_a_model_in_an_impossible_unit_is_told_as_one(tmp_path: Path, scale: float, words: str) -> None:
    """Every pose and every point was called impossible, or no depth was found; now what is wrong is said."""
    model = make_model()
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.array([0.0, 0.0, 3 * scale])))
    model.write_binary(tmp_path)
    with pytest.raises(InputError, match=f"lie {words}.*; bring it to metres"):
        read_scene(tmp_path)


def test_images_in_one_place_are_no_impossible_unit(tmp_path: Path) -> None:
    """Rounding sets them apart by next to nothing; how large the model is, its points say."""
    model = make_model()
    for frame in model.frames.values():
        frame.rig_from_world = pycolmap.Rigid3d(
            pycolmap.Rotation3d(), np.array([1e-17 * frame.frame_id, 0.0, 0.0])
        )
    model.write_binary(tmp_path)
    assert len(read_scene(tmp_path).views) == len(model.frames)


def test_a_tripod_without_points_is_no_impossible_unit(tmp_path: Path) -> None:
    model = make_model()
    for point in list(model.points3D):
        model.delete_point3D(point)
    for frame in model.frames.values():
        turn = pycolmap.Rotation3d(np.array([0.0, 0.1 * frame.frame_id, 0.0]))
        frame.rig_from_world = pycolmap.Rigid3d(turn, -(turn.matrix() @ np.array([0.1, 0.2, 0.3])))
    model.write_binary(tmp_path)
    assert len(read_scene(tmp_path).views) == len(model.frames)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("sub/2.png", r"two images named 'sub/2\.png'; rename"),
        ("sub/2.png/x.png", r"images 'sub/2\.png' and 'sub/2\.png/x\.png', and a file cannot be a folder"),
        ("sub/2.png/a/b.png", "a file cannot be a folder"),
    ],
)
def test_images_in_one_place_are_told(tmp_path: Path, name: str, words: str) -> None:
    model = make_model()
    model.image(1).name = name
    model.write_binary(tmp_path)
    with pytest.raises(InputError, match=words):
        read_scene(tmp_path)
