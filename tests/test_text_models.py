"""Text models: COLMAP's own numbers for what it reads, and everything that it would lose without a word."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from conftest import no_room_beyond
from projects import prepare
from test_undistortion import NAMES, make_project

from colmap_sph.errors import InputError, OutputError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.project import Project
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.sparse_model import load_model, write_model
from colmap_sph.project.undistortion.originals import read_originals


@pytest.fixture
def text(tmp_path: Path) -> Path:
    """Four views of a plane, as text, without the files of COLMAP 3.12."""
    sparse = make_project(tmp_path, text=True)
    (sparse / "rigs.txt").unlink()
    (sparse / "frames.txt").unlink()
    return sparse


def change(path: Path, function: Callable[[list[str]], list[str]]) -> None:
    """Change the lines of a file that are no comments."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    path.write_text("\n".join(function(lines)) + "\n")


def without_points(sparse: Path) -> None:
    """As exporters of poses write it: images without features, and no points."""
    change(sparse / "images.txt", lambda lines: [line for pair in lines[::2] for line in (pair, "")])
    (sparse / "points3D.txt").write_text("")


def poses(model: pycolmap.Reconstruction) -> dict[str, list[float]]:
    images = [model.images[number] for number in sorted(model.images)]
    return {image.name: image.cam_from_world().translation.tolist() for image in images}


def test_images_without_second_lines_are_all_read(text: Path, caplog: pytest.LogCaptureFixture) -> None:
    without_points(text)
    truth = poses(pycolmap.Reconstruction(text))
    assert list(truth) == NAMES
    change(text / "images.txt", lambda lines: [line for line in lines if line])
    assert len(pycolmap.Reconstruction(text).images) == 2  # what is guarded against
    assert poses(load_model(text)) == truth
    assert "images.txt has no second line for 4 of its 4 images" in caplog.text


@pytest.mark.parametrize("ending", ["bin", "txt"])
@pytest.mark.parametrize("stem", ["images", "points3D"])
def test_models_that_the_disk_does_not_take_whole(text: Path, tmp_path: Path, ending: str, stem: str) -> None:
    """COLMAP does not notice: clouds as models, projects for splatting, local models were cut off."""
    model = pycolmap.Reconstruction(text)
    as_text = ending == "txt"
    write_model(model, tmp_path / "whole", as_text=as_text)
    data = (tmp_path / "whole" / f"{stem}.{ending}").read_bytes()
    last_line = len(data.rstrip(b"\n").rpartition(b"\n")[0]) + 1 if as_text else len(data) - 8
    written = tmp_path / "written"
    for size in (len(data) - 1, last_line, 30):
        with no_room_beyond(size), pytest.raises(OutputError, match=f"written to {written} is not whole"):
            write_model(model, written, as_text=as_text)
    write_model(model, written, as_text=as_text)
    assert poses(load_model(written)) == poses(model)


def test_no_place_for_temporary_files(text: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What COLMAP reads wrongly is given to it as a copy; no place for that is no fault of the model."""
    without_points(text)
    change(text / "images.txt", lambda lines: [line for line in lines if line])
    monkeypatch.setattr(tempfile, "tempdir", str(text / "none"))
    with pytest.raises(OutputError, match=r"sparse/0 .* cannot be written \(No such file .*\); .* TMPDIR"):
        load_model(text)


@pytest.mark.parametrize("end", ["", "\n"])
def test_last_second_line(text: Path, end: str) -> None:
    """The file ends with the last image, with a line break or without."""
    without_points(text)
    path = text / "images.txt"
    path.write_text(path.read_text().rstrip("\n") + end)
    assert list(poses(load_model(text))) == NAMES


def test_some_second_lines_are_missing(text: Path) -> None:
    """Those that are there keep their features."""
    truth = pycolmap.Reconstruction(text)
    (text / "points3D.txt").write_text("")
    change(text / "images.txt", lambda lines: [*lines[:3], *lines[4:6], "", lines[6]])
    model = load_model(text)
    assert poses(model) == poses(truth)
    assert [model.image(number).num_points2D() for number in (1, 2, 3, 4)] == [20, 0, 20, 0]
    np.testing.assert_array_equal(model.image(3).point2D(7).xy, truth.image(3).point2D(7).xy)


def test_missing_lines_with_points_that_need_them(text: Path) -> None:
    change(text / "images.txt", lambda lines: lines[::2])
    with pytest.raises(InputError, match=r"points3D\.txt, line 4, '1 .*image 1 in images\.txt has no feature 0"):
        load_model(text)


def test_all_of_it_reaches_the_workspace(text: Path, tmp_path: Path) -> None:
    """COLMAP's undistortion reads models itself."""
    without_points(text)
    change(text / "images.txt", lambda lines: [line.replace("a.png", "a b.png") for line in lines if line])
    (tmp_path / "images" / "a.png").rename(tmp_path / "images" / "a b.png")
    scene = read_scene(prepare(text, tmp_path / "dense").sparse_dir)
    assert [view.name for view in scene.views] == ["a b.png", *NAMES[1:]]
    assert [round(view.t[0], 6) for view in scene.views] == [0.1, 0.2, 0.3, 0.4]


@pytest.mark.parametrize("mark", ["\ufeff", ""])
@pytest.mark.parametrize("end", ["\n", "\r\n", "  \n", "\n\n"])
def test_marks_ends_of_lines_and_blanks(text: Path, mark: str, end: str) -> None:
    truth = pycolmap.Reconstruction(text)
    for path in text.iterdir():
        # An empty line has a meaning in images.txt.
        ending = "\n" if path.name == "images.txt" and end == "\n\n" else end
        path.write_bytes((mark + path.read_text()).replace("\n", ending).encode())
    model = load_model(text)
    assert poses(model) == poses(truth)
    assert model.num_points3D() == 20
    np.testing.assert_array_equal(model.point3D(5).xyz, truth.point3D(5).xyz)
    assert model.image(2).num_points3D == truth.image(2).num_points3D == 20


def test_comments_between_image_and_features(text: Path) -> None:
    change(text / "images.txt", lambda lines: [part for line in lines for part in ("# comment", line)])
    assert load_model(text).image(4).num_points3D == 19


@pytest.mark.parametrize("name", ["two words.png", "my cam/ä [1] (x).png", "12", "1 2"])
def test_names_are_whole(text: Path, name: str) -> None:
    path = text / "images.txt"
    path.write_text(path.read_text().replace("cam/c.png", name))
    assert load_model(text).image(3).name == name


def word(number: int, value: str) -> Callable[[list[str]], list[str]]:
    """Put another word into the third line."""

    def changed(lines: list[str]) -> list[str]:
        words = lines[2].split(" ")
        words[number] = value
        return [*lines[:2], " ".join(words), *lines[3:]]

    return changed


@pytest.mark.parametrize(
    ("file", "function", "words"),
    [
        ("images", word(5, "0,2"), "line 3.*this is not IMAGE_ID QW"),
        ("images", word(5, "nan"), "line 3.*this is not IMAGE_ID QW"),
        ("images", word(0, "1"), "line 3.*the number 1 is that of line 1"),
        ("images", word(0, str(2**32)), "line 3.*its number is too large, as COLMAP's end at 4294967294"),
        ("points3D", word(0, str(2**64 - 1)), "line 3.*its number is too large"),
        ("cameras", lambda _: ["4294967295 PINHOLE 96 64 90 90 48 32"], "line 1.*its number is too large"),
        ("images", word(8, "7"), r"line 3.*its camera 7 is not in cameras\.txt"),
        ("images", lambda lines: [lines[0], lines[1] + " 5", *lines[2:]], "line 2.*this is not X Y POINT3D_ID"),
        ("images", lambda lines: [lines[0], "abc " + lines[1], *lines[2:]], "line 2.*this is not X Y POINT3D_ID"),
        ("images", lambda lines: lines[:-2], r"line 5.*images\.txt has no image 4, which"),
        ("points3D", word(8, "77"), r"line 3.*images\.txt has no image 77, which"),
        ("points3D", word(9, "777"), "line 3.*image 1 in images.txt has no feature 777"),
        ("points3D", word(0, "1"), "line 3.*the number 1 is that of line 1"),
        ("points3D", word(4, "7.5"), "line 3.*this is not POINT3D_ID"),
        ("points3D", word(9, ""), "line 3.*this is not POINT3D_ID"),
        ("points3D", word(1, "1,5"), "line 3.*this is not POINT3D_ID"),
        ("cameras", lambda _: ["1 PINHOLE 96.0 64.0 90 90 48 32"], "line 1.*this is not CAMERA_ID"),
        ("cameras", lambda _: ["1 PINHOLE 96 64 90 90 48"], "line 1.*a PINHOLE camera has 4 parameters, not 3"),
        ("cameras", lambda _: ["1 PINHOLE 96 64 90 90 48 32 0"], "line 1.*has 4 parameters, not 5"),
        ("cameras", lambda _: ["1 PINHOLE 96 64 90 90 48 x"], "line 1.*this is not CAMERA_ID"),
        ("cameras", lambda _: ["1 PINHOLES 96 64 90 90 48 32"], "line 1.*no camera model 'PINHOLES'"),
        ("cameras", lambda lines: lines * 2, "line 2.*the number 1 is that of line 1"),
    ],
)
def test_bad_lines_are_named(text: Path, file: str, function: Callable, words: str) -> None:
    change(text / f"{file}.txt", function)
    with pytest.raises(InputError, match=words):
        load_model(text)


def test_utf_16_is_told(text: Path) -> None:
    path = text / "images.txt"
    path.write_bytes(path.read_text().encode("utf-16"))
    with pytest.raises(InputError, match=r"UTF-16.*save it as UTF-8"):
        load_model(text)


def test_edited_poses_beside_frames_are_told(tmp_path: Path) -> None:
    """COLMAP would take the poses of frames.txt and say nothing."""
    sparse = make_project(tmp_path, text=True)
    load_model(sparse)
    change(sparse / "images.txt", word(5, "0.7"))
    with pytest.raises(InputError, match=r"two poses of 'b\.png'.*delete rigs\.txt and frames\.txt"):
        load_model(sparse)
    (sparse / "frames.txt").unlink()
    (sparse / "rigs.txt").unlink()
    assert load_model(sparse).image(2).cam_from_world().translation[0] == 0.7


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize(
    ("unit", "shift", "moved"),
    [(2.0, 0.0, "scaled"), (1e-6, 0.0, "scaled"), (1.0, 5e6, "turned")],
    ids=["twice as large", "in tiny units", "turned in map coordinates"],
)
def test_poses_of_before_in_frames_are_told(
    tmp_path: Path, text: bool, unit: float, shift: float, moved: str
) -> None:
    """A program that knows no frames has written over a model that has them."""
    sparse = make_project(tmp_path, text=text)
    model = pycolmap.Reconstruction(sparse)
    model.transform(pycolmap.Sim3d(unit, pycolmap.Rotation3d(), np.full(3, shift)))
    write = model.write_text if text else model.write_binary
    write(sparse)
    load_model(sparse)
    kept = {path: path.read_bytes() for path in sparse.iterdir() if path.stem in ("rigs", "frames")}
    turn = pycolmap.Rotation3d(np.array([0.0, 0.0, 0.001, 1.0]) if moved == "turned" else np.array([0, 0, 0, 1.0]))
    model.transform(pycolmap.Sim3d(1.001, turn, np.zeros(3)))
    write(sparse)
    changed = load_model(sparse).image(2).cam_from_world().matrix()
    for path, content in kept.items():
        path.write_bytes(content)
    ending = "txt" if text else "bin"
    with pytest.raises(InputError, match=rf"two poses of .*delete rigs\.{ending} and frames\.{ending} if images"):
        load_model(sparse)
    for path in kept:
        path.unlink()
    np.testing.assert_allclose(load_model(sparse).image(2).cam_from_world().matrix(), changed, rtol=1e-12)


@pytest.mark.parametrize("length", [1.2, -3e4, 1e-4])
@pytest.mark.parametrize("text", [True, False])
def test_quaternions_of_any_length_are_rotations(tmp_path: Path, text: bool, length: float) -> None:
    """As COLMAP read them until 3.11; now it takes them as they are, and scales what they turn."""
    sparse = make_project(tmp_path, text=text)
    model = pycolmap.Reconstruction(sparse)
    turned = pycolmap.Rotation3d(np.array([0.1, 0.7, 0.0, 0.7]) / np.sqrt(0.99))
    frame = model.image(2).frame
    assert frame is not None
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(length * turned.quat), np.array([0.1, 0.0, 0.0]))
    (model.write_text if text else model.write_binary)(sparse)
    for name in ("rigs.txt", "frames.txt"):
        (sparse / name).unlink(missing_ok=True)
    rotation = pycolmap.Reconstruction(sparse).image(2).cam_from_world().rotation
    assert np.linalg.norm(rotation.quat) == pytest.approx(abs(length))  # what is guarded against
    found = load_model(sparse).image(2).cam_from_world().matrix()
    np.testing.assert_allclose(found[:, :3], turned.matrix(), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found[:, 3], [0.1, 0.0, 0.0])


def test_observations_of_points_that_are_not_there(tmp_path: Path) -> None:
    """As of exporters that have thinned out their points: the others count."""
    sparse = make_project(tmp_path, text=True)
    change(sparse / "points3D.txt", lambda lines: lines[::2])
    workspace = prepare(sparse, tmp_path / "dense")
    assert len(read_scene(workspace.sparse_dir).points) == 10


def test_newer_text_beside_a_binary_model_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """COLMAP reads the binary one, whatever was edited in the text."""
    sparse = make_project(tmp_path)
    pycolmap.Reconstruction(sparse).write_text(sparse)
    for path in sparse.iterdir():
        os.utime(path, (1000, 2000 if path.name == "cameras.txt" else 1000))
    read_originals(Project(sparse), RunOptions().undistortion)
    (message,) = caplog.messages
    assert message.startswith(f"{sparse} has binary and text files")
    assert "though newer are cameras.txt; delete the binary ones" in message
    os.utime(sparse / "cameras.bin", (1000, 2000))
    read_originals(Project(sparse), RunOptions().undistortion)
    assert len(caplog.messages) == 1


def test_rigs_of_another_model_are_told(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    model = pycolmap.Reconstruction(sparse)
    frame_id = model.image(3).frame_id
    model.deregister_frame(frame_id)
    (tmp_path / "other").mkdir()
    model.write_binary(tmp_path / "other")
    for name in ("rigs.bin", "frames.bin"):
        (tmp_path / "other" / name).replace(sparse / name)
    with pytest.raises(InputError, match=r"or delete rigs\.bin and frames\.bin if they are of another model\."):
        load_model(sparse)


def test_a_line_of_any_length_is_looked_at_once(text: Path) -> None:
    """Digits without end, and features that go wrong at their last word."""
    first, _, *rest = (text / "images.txt").read_text().splitlines()[4:]
    for line in ("1" * 1_000_000 + "x", "1 " * 1_000_000 + "x", "1.5 2.5 -1 " * 300_000 + "nan"):
        (text / "images.txt").write_text("\n".join([first, line, *rest]))
        with pytest.raises(InputError, match="line 2"):
            load_model(text)


def test_a_rotation_of_zeros_is_told(text: Path) -> None:
    def without_rotation(lines: list[str]) -> list[str]:
        number, *_, x, y, z, camera, name = lines[2].split()
        return [*lines[:2], " ".join([number, *"0000", x, y, z, camera, name]), *lines[3:]]

    change(text / "images.txt", without_rotation)
    assert pycolmap.Reconstruction(text).num_reg_images() == 4  # what is guarded against
    with pytest.raises(InputError, match=rf"no rotation of '{NAMES[1]}'"):
        load_model(text)
