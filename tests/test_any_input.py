"""Any image, any camera, any model that COLMAP takes: through the command, against exact rendered depth."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import keep_images
from PIL import Image
from projects import block_camera, make_block_project, truth_of, write_picture

from colmap_sph.app import cli
from colmap_sph.app.run_command import PARTIAL_EXIT_CODE
from colmap_sph.evaluation import compare_depth_map
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.workspace import Workspace
from colmap_sph.synthetic import DemoBlock

NADIR = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_1.jpg"]
WIDTH, HEIGHT = 320, 240


@dataclass(frozen=True)
class Outcome:
    """What the command said, its exit code, and its report, if it wrote one."""

    code: int
    output: str
    report: dict
    dense: Path


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]):
    """Run the command on a model, with its images in ``images`` beside ``sparse``."""

    def run(model: Path, *arguments: str) -> Outcome:
        dense = model.parents[1] / "dense"
        code = cli.main(["run", "--model", str(model), "--threads", "1", "--num-pairs", "3", *arguments])
        output = capsys.readouterr().err
        assert "Traceback" not in output
        path = dense / "colmap_sph" / "report.json"
        return Outcome(code, output, json.loads(path.read_text()) if path.exists() else {}, dense)

    return run


def assert_true_depths(block: DemoBlock, dense: Path, names: dict[str, str], coverage: float = 0.45) -> None:
    """Maps of images, given by the block's name and theirs, are as good as those of the block itself."""
    model = pycolmap.Reconstruction(dense / "sparse")
    cameras = {image.name: model.camera(image.camera_id) for image in model.images.values()}
    for name, called in names.items():
        depth = read_depth_map(Workspace(dense).depth_map_path(called, "geometric"))
        truth = truth_of(block, name, cameras[called])
        scores = compare_depth_map(depth, truth, gsd=truth / cameras[called].mean_focal_length())
        assert scores.coverage > coverage, called
        assert scores.within[0] > 0.8, called


# ---- images ------------------------------------------------------------------------------------------------


def as_rgb(picture: np.ndarray) -> Image.Image:
    return Image.fromarray(picture[..., ::-1])


def write_grey(path: Path, picture: np.ndarray) -> None:
    as_rgb(picture).convert("L").save(path)


def write_alpha(path: Path, picture: np.ndarray) -> None:
    image = as_rgb(picture).convert("RGBA")
    image.putalpha(100)
    image.save(path)


def write_16_bits(path: Path, picture: np.ndarray) -> None:
    assert cv2.imwrite(str(path), picture.astype(np.uint16) * 257)


def write_palette(path: Path, picture: np.ndarray) -> None:
    as_rgb(picture).quantize(256).save(path)


def write_cmyk(path: Path, picture: np.ndarray) -> None:
    as_rgb(picture).convert("CMYK").save(path, quality=95)


def write_progressive(path: Path, picture: np.ndarray) -> None:
    as_rgb(picture).save(path, quality=95, progressive=True)


def write_turned(path: Path, picture: np.ndarray) -> None:
    """With an EXIF tag by which viewers turn it, and COLMAP does not."""
    exif = Image.Exif()
    exif[0x0112] = 6
    as_rgb(picture).save(path, quality=95, exif=exif)


FORMATS = {
    "grey": ("png", write_grey),
    "alpha": ("png", write_alpha),
    "16 bits": ("png", write_16_bits),
    "palette": ("png", write_palette),
    "CMYK": ("jpg", write_cmyk),
    "progressive": ("JPG", write_progressive),
    "EXIF": ("jpeg", write_turned),
    "tiff": ("tif", write_picture),
}


@pytest.mark.parametrize("distorted", [False, True])
@pytest.mark.parametrize("kinds", [list(FORMATS)[:4], list(FORMATS)[4:]], ids=", ".join)
def test_image_formats(kinds: list[str], distorted: bool, block: DemoBlock, tmp_path: Path, command) -> None:
    """Undistorted ones are copied by COLMAP as they are and read by us; the others are COLMAP's work."""
    camera = block_camera(block, NADIR[0])
    if distorted:
        focal = camera.mean_focal_length()
        params = [1.1 * focal, WIDTH / 2, HEIGHT / 2, 0.02]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params)
    formats = dict(zip(NADIR, (FORMATS[kind] for kind in kinds), strict=True))
    names = {name: f"{name[:-4]}.{ending}" for name, (ending, _) in formats.items()}
    writers = {name: write for name, (_, write) in formats.items()}
    model = make_block_project(tmp_path, block, dict.fromkeys(NADIR, camera), names=names, writers=writers)
    done = command(model)
    assert done.code == 0, done.output
    assert_true_depths(block, done.dense, names)


@pytest.mark.parametrize(
    "odd",
    [
        ["with space.png", "deep/er/folder/x.png", "quo'te\"d.png", "写真/Ümläut é.png"],
        ["a,b, c.png", "[red]$(x) & ;.png", "-dash.png", "dots..in.na.me.png"],
    ],
    ids=["spaces and letters", "signs"],
)
def test_image_names(odd: list[str], block: DemoBlock, tmp_path: Path, command) -> None:
    names = dict(zip(NADIR, odd, strict=True))
    cameras = {name: block_camera(block, name) for name in NADIR}
    done = command(make_block_project(tmp_path, block, cameras, names=names))
    assert done.code == 0, done.output
    assert_true_depths(block, done.dense, names)
    assert sorted(done.report["coverage"]) == sorted(odd)


# ---- cameras -----------------------------------------------------------------------------------------------

# Distortion of the order of a wide lens, by camera model, behind focal lengths and principal point.
DISTORTION = {
    "SIMPLE_PINHOLE": [],
    "PINHOLE": [],
    "SIMPLE_RADIAL": [-0.03],
    "SIMPLE_RADIAL_FISHEYE": [0.02],
    "RADIAL": [-0.03, 0.01],
    "RADIAL_FISHEYE": [0.02, -0.01],
    "OPENCV": [-0.03, 0.01, 1e-3, -1e-3],
    "OPENCV_FISHEYE": [0.02, -0.01, 0.002, -0.001],
    "FULL_OPENCV": [-0.03, 0.01, 1e-3, -1e-3, 0.001, 0.002, -0.001, 0.001],
    "FOV": [0.4],
    "THIN_PRISM_FISHEYE": [0.02, -0.01, 1e-3, -1e-3, 0.002, -0.001, 1e-3, 1e-3],
    "RAD_TAN_THIN_PRISM_FISHEYE": [0.02, -0.01, 0.002, 0.001, 0, 0, 1e-3, -1e-3, 1e-3, 1e-3, 0, 0],
    "SIMPLE_DIVISION": [-0.02],
    "DIVISION": [-0.02],
    "SIMPLE_FISHEYE": [],
    "FISHEYE": [],
    "EUCM": [0.4, 1.1],
}
MODELS = list(DISTORTION)


def camera_of_model(model: str, focal: float, width: int = WIDTH, height: int = HEIGHT) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_name(1, model, focal, width, height)
    distortion = DISTORTION[model]
    camera.params = [*camera.params[: len(camera.params) - len(distortion)], *distortion]
    return camera


def test_every_model_of_colmap_is_among_these() -> None:
    assert set(pycolmap.CameraModelId.__members__) == {*MODELS, "EQUIRECTANGULAR", "INVALID"}


@pytest.mark.parametrize("models", [MODELS[k : k + 4] for k in (0, 4, 8, 12, 13)], ids=", ".join)
def test_camera_models(models: list[str], block: DemoBlock, tmp_path: Path, command) -> None:
    focal = 1.15 * block_camera(block, NADIR[0]).mean_focal_length()
    cameras = {name: camera_of_model(model, focal) for name, model in zip(NADIR, models, strict=True)}
    done = command(make_block_project(tmp_path, block, cameras))
    assert done.code == 0, done.output
    assert_true_depths(block, done.dense, {name: name for name in NADIR}, coverage=0.35)


def test_cameras_of_different_size_and_focal_length(block: DemoBlock, tmp_path: Path, command) -> None:
    focal = block_camera(block, NADIR[0]).mean_focal_length()
    shapes = [(320, 240, 1.1), (400, 240, 1.4), (260, 300, 1.0), (241, 161, 0.8)]
    cameras = {
        name: pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", factor * focal, width, height)
        for name, (width, height, factor) in zip(NADIR, shapes, strict=True)
    }
    done = command(make_block_project(tmp_path, block, cameras))
    assert done.code == 0, done.output
    assert_true_depths(block, done.dense, {name: name for name in NADIR}, coverage=0.3)


def test_fisheye_whose_polynomial_turns_back(block: DemoBlock, tmp_path: Path, command) -> None:
    model = make_block_project(tmp_path, block, {name: block_camera(block, name) for name in NADIR})
    reconstruction = pycolmap.Reconstruction(model)
    camera = reconstruction.camera(1)
    camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL_FISHEYE
    camera.params = [60.0, WIDTH / 2, HEIGHT / 2, -0.3]
    reconstruction.write_binary(model)
    done = command(model)
    assert done.code == 2
    assert "calibrate it again" in done.output
    assert not done.dense.exists()


# ---- models ------------------------------------------------------------------------------------------------


@pytest.fixture
def nadir(project: Path) -> Path:
    """The block's model of four vertical images."""
    keep_images(project, NADIR)
    return project / "sparse" / "0"


def image_of(model: pycolmap.Reconstruction, name: str) -> pycolmap.Image:
    (image,) = (image for image in model.images.values() if image.name == name)
    return image


def set_pose(model: pycolmap.Reconstruction, name: str, pose: pycolmap.Rigid3d) -> None:
    model.frame(image_of(model, name).frame_id).rig_from_world = pose


def test_rig(block: DemoBlock, nadir: Path, command) -> None:
    """Two frames of a rig with two sensors: poses of images are composed."""
    source, model = pycolmap.Reconstruction(nadir), pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for number in (1, 2):
        camera = source.camera(image_of(source, NADIR[0]).camera_id)
        model.add_camera(pycolmap.Camera(camera.todict() | {"camera_id": number}))
    first, second = (image_of(source, name).cam_from_world() for name in NADIR[:2])
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), second * first.inverse())
    model.add_rig(rig)
    tracks: dict[int, pycolmap.Track] = {}
    for frame_id, names in ((1, NADIR[:2]), (2, NADIR[2:])):
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1)
        images = []
        for number, name in enumerate(names, start=1):
            theirs = image_of(source, name)
            image_id = 2 * frame_id + number
            points = [p for p in theirs.points2D if p.has_point3D()]
            for place, point in enumerate(points):
                tracks.setdefault(point.point3D_id, pycolmap.Track()).add_element(image_id, place)
            image = pycolmap.Image(name, np.array([p.xy for p in points]), number, image_id)
            image.frame_id = frame_id
            frame.add_data_id(image.data_id)
            images.append(image)
        frame.rig_from_world = image_of(source, names[0]).cam_from_world()
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
    for point_id, track in tracks.items():
        if track.length() >= 2:
            model.add_point3D(source.point3D(point_id).xyz, track, np.zeros(3, np.uint8))
    for frame_id in (1, 2):
        model.register_frame(frame_id)
    shutil.rmtree(nadir)
    nadir.mkdir()
    model.write_binary(nadir)
    # The second frame's second image has the pose that the rig gives it, which is not where it was taken.
    (nadir.parents[1] / "images" / NADIR[3]).unlink()
    done = command(nadir)
    assert done.code == PARTIAL_EXIT_CODE, done.output
    assert list(done.report["skipped_images"]) == [NADIR[3]]
    assert_true_depths(block, done.dense, {name: name for name in NADIR[:3]})


def test_images_that_the_model_does_not_have(block: DemoBlock, nadir: Path, command) -> None:
    """The folder holds the whole block: what is not in the model is left alone."""
    done = command(nadir)
    assert done.code == 0
    assert sorted(path.name for path in (done.dense / "images").iterdir()) == NADIR
    assert_true_depths(block, done.dense, {name: name for name in NADIR})


@pytest.mark.parametrize("odd", ["nan", "same", "behind", "upside down"])
def test_odd_poses(odd: str, block: DemoBlock, nadir: Path, command) -> None:
    """One image with an impossible or a wrong pose; the others go on without it."""
    model = pycolmap.Reconstruction(nadir)
    pose = image_of(model, NADIR[3]).cam_from_world()
    if odd == "nan":
        pose = pycolmap.Rigid3d(pose.rotation, np.array([np.nan, 0, 0]))
    elif odd == "same":
        pose = image_of(model, NADIR[1]).cam_from_world()
    elif odd == "behind":  # the points it observes are behind it
        turn = pycolmap.Rotation3d(np.diag([-1.0, 1.0, -1.0]))
        pose = pycolmap.Rigid3d(turn, np.zeros(3)) * pose
    else:
        turn = pycolmap.Rotation3d(np.diag([-1.0, -1.0, 1.0]))
        pose = pycolmap.Rigid3d(turn, np.zeros(3)) * pose
    set_pose(model, NADIR[3], pose)
    model.write_binary(nadir)
    done = command(nadir)
    assert done.code in (0, PARTIAL_EXIT_CODE), done.output
    if odd in ("nan", "behind"):
        assert list(done.report["skipped_images"]) == [NADIR[3]]
    assert_true_depths(block, done.dense, {name: name for name in NADIR[:3]})


def test_points_behind_cameras(block: DemoBlock, nadir: Path, command) -> None:
    """A tenth of the points mirrored to behind the cameras that observe them."""
    model = pycolmap.Reconstruction(nadir)
    height = image_of(model, NADIR[0]).projection_center()[2]
    for number, point in enumerate(model.points3D.values()):
        if number % 10 == 0:
            x, y, z = point.xyz
            point.xyz = np.array([x, y, 2 * height - z])
    model.write_binary(nadir)
    done = command(nadir)
    assert done.code == 0, done.output
    assert_true_depths(block, done.dense, {name: name for name in NADIR})


def test_two_images(block: DemoBlock, nadir: Path, command) -> None:
    keep_images(nadir.parents[1], NADIR[:2])
    done = command(nadir)
    assert done.code == 0, done.output
    assert_true_depths(block, done.dense, {name: name for name in NADIR[:2]}, coverage=0.3)


@pytest.mark.parametrize("case", ["one image", "identical poses"])
def test_nothing_to_reconstruct(case: str, nadir: Path, command) -> None:
    if case == "one image":
        keep_images(nadir.parents[1], NADIR[:1])
    else:
        model = pycolmap.Reconstruction(nadir)
        pose = image_of(model, NADIR[0]).cam_from_world()
        for name in NADIR:
            set_pose(model, name, pose)
        model.write_binary(nadir)
    done = command(nadir)
    assert done.code == 4
    assert done.output.count("error: ") == 1
    assert "No pair of images overlaps" in done.output
    assert not (done.dense / "fused.ply").exists()
