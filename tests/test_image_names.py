"""Names and places of images: what cannot work is told with the name, what is only spelled otherwise with both."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import pycolmap
import pytest
from projects import make_context, prepare, read_picture
from test_undistortion import HEIGHT, NAMES, WIDTH, make_project

from colmap_sph.app import cli
from colmap_sph.errors import InputError
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.input.good_images import with_good_images
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.preparation import Preparation
from colmap_sph.project.given import image_places
from colmap_sph.project.given.image_places import find_images, tell_problems
from colmap_sph.project.images.reading import Damaged, Missing, Problem, Unreadable, Unsupported, WrongSize
from colmap_sph.project.pair_lists import read_lines, read_patch_match_cfg, write_fusion_cfg, write_patch_match_cfg
from colmap_sph.project.project import Project, open_workspace
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.sparse_model import load_model


def rename(sparse: Path, names: dict[str, str]) -> None:
    """Change names of images in a model."""
    model = pycolmap.Reconstruction(sparse)
    for image in model.images.values():
        image.name = names.get(image.name, image.name)
    model.write(sparse)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("x\ny.png", r"'x\\ny\.png', which has a line break"),
        ("x.png\r", r"'x\.png\\r', which has a line break"),
        (" x.png", "' x.png', which begins or ends with a space"),
        ("x.png\t", r"'x\.png\\t', which begins or ends with a space"),
        ("#x.png", "'#x.png', which begins with #"),
        ("__all__", "'__all__', which is a word with another meaning"),
        ("__auto__", "'__auto__', which is a word with another meaning"),
        ("cam//x.png", "'cam//x.png', which is a roundabout way to write 'cam/x.png'"),
        ("./x.png", "'./x.png', which is a roundabout way to write 'x.png'"),
        ("cam/./x.png", "roundabout way to write 'cam/x.png'"),
        ("cam/", "'cam/', which is a roundabout way to write 'cam'"),
        ("cam/../x.png", "'cam/../x.png' leads out of the workspace"),
        ("../x.png", "'../x.png' leads out of the workspace"),
        ("/x.png", "'/x.png' leads out of the workspace"),
        ("d/" * 1500 + "x.png", "has more than 200 folders"),
        ("", "'', which is no name"),
        ("x" * 250, "is longer than"),
    ],
)
def test_names_that_cannot_work(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, words: str) -> None:
    sparse = make_project(tmp_path)
    rename(sparse, {"b.png": name})
    with pytest.raises(InputError, match=words):
        load_model(sparse)
    # Before anything is written, in one sentence without the signs themselves.
    assert cli.main(["run", "--model", str(sparse)]) == 2
    error = capsys.readouterr().err
    assert error.count("error: ") == 1 and "\r" not in error.split("error: ")[1]
    assert not (tmp_path / "dense").exists()


@pytest.mark.parametrize(
    "name", ["__x.png", "__x__", "x#.png", "a, b.png", "ä\u2028b.png", "\u3000x.png", "[1] (x).png"]
)
def test_names_that_work_stay_what_they_are(tmp_path: Path, name: str) -> None:
    """In COLMAP's lists, too."""
    sparse = make_project(tmp_path)
    rename(sparse, {"b.png": name})
    (tmp_path / "images" / "b.png").rename(tmp_path / "images" / name)
    workspace = prepare(sparse, tmp_path / "dense")
    assert {view.name for view in read_scene(workspace.sparse_dir).views} == {name, "a.png", *NAMES[2:]}
    assert read_patch_match_cfg(workspace.patch_match_cfg_path) == dict.fromkeys(
        sorted({*NAMES, name} - {"b.png"}), 20
    )
    write_fusion_cfg(tmp_path / "fusion.cfg", [name])
    assert read_lines(tmp_path / "fusion.cfg", "")[0] == name
    if "," not in name and name != "__x__":
        write_patch_match_cfg(tmp_path / "pairs.cfg", {"a.png": [name, "cam/c.png"], name: "__all__"})
        assert read_patch_match_cfg(tmp_path / "pairs.cfg") == {"a.png": [name, "cam/c.png"], name: "__all__"}


# ---- another spelling --------------------------------------------------------------------------------------


def test_backslashes(tmp_path: Path) -> None:
    r"""A model made on Windows; the remedy in the message is one."""
    sparse = make_project(tmp_path)
    rename(
        sparse, {"cam/c.png": r"cam\c.png", "cam/d.png": r"cam\d.png", "a.png": r"e\a.png", "b.png": r"e\b.png"}
    )
    shutil.move(tmp_path / "images", tmp_path / "moved")
    (tmp_path / "images").mkdir()
    shutil.move(tmp_path / "moved" / "cam", tmp_path / "images" / "cam")
    with pytest.raises(InputError) as error:
        find_images(sparse, [r"cam\c.png", r"cam\d.png"])
    message = str(error.value)
    assert r"calls an image 'cam\c.png', and" in message and "has 'cam/c.png' (so for 2 of 2 images)" in message
    command = message[message.index("python -c") + len("python -c ") : -1].strip('"')
    subprocess.run([sys.executable, "-c", command], check=True)
    names = {image.name for image in pycolmap.Reconstruction(sparse).images.values()}
    assert names == {"cam/c.png", "cam/d.png", "e/a.png", "e/b.png"}


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("cam/c.png", "cam/C.PNG"),
        ("cam/c.png", "Cam/c.png"),
        ("cam/é.png", "cam/e\u0301.png"),
        (r"cam\c.png", "CAM/c.png"),
    ],
)
def test_other_spellings(tmp_path: Path, name: str, there: str) -> None:
    sparse = make_project(tmp_path)
    (tmp_path / "images" / there).parent.mkdir(parents=True, exist_ok=True)
    for path in (tmp_path / "images").rglob("*.png"):
        path.unlink()
    (tmp_path / "images" / there).touch()
    with pytest.raises(InputError) as error:
        find_images(sparse, [name, "b.png"])
    # Accents that are written in two ways look alike: their code points tell them apart.
    called, found = (ascii(name), ascii(there)) if "é" in name else (f"'{name}'", repr(there))
    assert f"calls an image {called}, and" in str(error.value) and f"has {found} " in str(error.value)
    assert "rename the files as the model has them" in str(error.value)


@pytest.mark.parametrize("called", ["{}", "{}.jpg", r"C:\data\photos\{}.png", "/data/photos/{}.JPG", "x.y/{}.tif"])
def test_other_endings_and_folders(tmp_path: Path, called: str) -> None:
    """As other programs write names of images into models."""
    sparse = make_project(tmp_path)
    (tmp_path / "images/v.1.png").touch()
    names = [called.format(name) for name in ("a", "b", "v.1")]
    with pytest.raises(InputError) as error:
        find_images(sparse, names)
    assert f"calls an image '{names[0]}', and {tmp_path / 'images'} has 'a.png' (so for 3 of 3" in str(error.value)
    assert "rename the images in the model as their files, or give the folder" in str(error.value)
    # Not where the file of an image cannot be told, or most have none.
    for others in (["p/a.jpg", "q/a.jpg"], ["a.jpg", "n.jpg", "m.jpg"]):
        with pytest.raises(InputError, match="were not found in"):
            find_images(sparse, others)


def test_two_files_that_could_be_meant(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    shutil.rmtree(tmp_path / "images")
    (tmp_path / "images").mkdir()
    for name in ("X.png", "x.PNG"):
        (tmp_path / "images" / name).touch()
    with pytest.raises(InputError, match="were not found in"):
        find_images(sparse, ["x.png"])


@pytest.mark.parametrize(
    ("name", "there", "told"), [("b.png", "B.png", "'B.png'"), ("é.png", "e\u0301.png", r"'e\u0301.png'")]
)
def test_some_are_spelled_differently(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, there: str, told: str
) -> None:
    """The others go on; the one is named with what is there."""
    sparse = make_project(tmp_path)
    rename(sparse, {"b.png": name})
    (tmp_path / "images" / "b.png").rename(tmp_path / "images" / there)
    workspace = prepare(sparse, tmp_path / "dense")
    assert [view.name for view in read_scene(workspace.sparse_dir).views] == ["a.png", *NAMES[2:]]
    assert f"{name} is missing, but there is {told}; left out" in caplog.text


@pytest.mark.parametrize("target", ["nowhere.png", "b.png"])
def test_links_that_lead_nowhere_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture, target: str) -> None:
    """Also one to itself; there is no other spelling of it."""
    sparse = make_project(tmp_path)
    (tmp_path / "images" / "b.png").unlink()
    (tmp_path / "images" / "b.png").symlink_to(target)
    prepare(sparse, tmp_path / "dense")
    assert "b.png is a link to a file that is missing; left out" in caplog.text


def test_a_folder_too_deep_or_too_high(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    rename(sparse, {name: f"all/{name}" for name in NAMES})
    (tmp_path / "images").rename(tmp_path / "all")
    with pytest.raises(InputError, match=rf"has 'a\.png'; give --images {tmp_path}\."):
        prepare_with(sparse, tmp_path / "all")
    (tmp_path / "deep").mkdir()
    (tmp_path / "all").rename(tmp_path / "deep" / "all")
    (tmp_path / "deep").rename(tmp_path / "images")
    prepare(sparse, tmp_path / "dense")
    rename(sparse, {f"all/{name}": name for name in NAMES})
    with pytest.raises(InputError, match=r"but in .*/images/all; give that as --images"):
        prepare_with(sparse, tmp_path / "images")


def test_a_folder_of_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is looked through once, and not to its end."""
    sparse = make_project(tmp_path)
    for number in range(60):
        (tmp_path / "all" / f"{number}" / "below").mkdir(parents=True)
    walks: list[str] = []
    monkeypatch.setattr(os, "walk", counted(os.walk, walks))
    with pytest.raises(InputError, match=r"None of the model's 4 images in .* is usable"):
        prepare_with(sparse, tmp_path / "all")
    assert len(walks) == 121
    monkeypatch.setattr(image_places, "_MAX_ENTRIES", 50)
    monkeypatch.setattr(image_places, "_MAX_ENTRIES_PER_IMAGE", 1)
    with pytest.raises(InputError, match=r"None of the 4 images of .*0 is in .*all, which has many .* --images\."):
        prepare_with(sparse, tmp_path / "all")
    assert len(walks) == 121 + 51


def counted(walk: Callable[[Path], Iterable[tuple[str, list[str], list[str]]]], places: list[str]) -> Any:
    def counting(top: Path) -> Iterator[tuple[str, list[str], list[str]]]:
        for place in walk(top):
            places.append(place[0])
            yield place

    return counting


def prepare_with(sparse: Path, images: Path) -> None:
    project = Project(sparse, images=images, output=sparse.parents[1] / "other")
    Preparation(project, RunOptions()).run(execute)


# ---- another size ------------------------------------------------------------------------------------------


def resized(tmp_path: Path, width: int, height: int, *, turn: bool = False) -> Path:
    """The project's images in another size or turned, in a folder of their own."""
    for name in NAMES:
        path = tmp_path / "images_2" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = cv2.resize(read_picture(tmp_path / "images" / name), (width, height))
        assert cv2.imwrite(str(path), cv2.rotate(picture, cv2.ROTATE_90_CLOCKWISE) if turn else picture)
    return tmp_path / "images_2"


@pytest.mark.parametrize(
    ("width", "height", "words"),
    [
        (WIDTH // 2, HEIGHT // 2, "have exactly half the size of their cameras.*--max-image-size 48 if"),
        (WIDTH // 4, HEIGHT // 4, "have exactly a quarter of the size of"),
        (WIDTH // 7, HEIGHT // 7 + 1, "have exactly 1/7 of the size of"),
        (WIDTH * 2, HEIGHT * 2, "have exactly 2 times the size of.*the reduced images"),
    ],
)
def test_all_images_are_of_another_size(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, width: int, height: int, words: str
) -> None:
    sparse = make_project(tmp_path)
    folder = resized(tmp_path, width, height)
    with pytest.raises(InputError, match=f"^All 4 images in {folder} {words}") as error:
        prepare_with(sparse, folder)
    assert f"'a.png', which has {width} x {height} pixels, but its camera 96 x 64" in str(error.value)
    assert caplog.text == ""


def test_all_images_are_turned(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    with pytest.raises(InputError, match="are turned by 90 degrees against their cameras"):
        prepare_with(sparse, resized(tmp_path, WIDTH, HEIGHT, turn=True))


def test_sizes_without_a_rule_are_told_one_by_one(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sparse = make_project(tmp_path)
    folder = resized(tmp_path, WIDTH // 2, HEIGHT // 2 + 9)
    with pytest.raises(InputError, match=r"None of the model's 4 images in .* is usable; give the images that"):
        prepare_with(sparse, folder)
    assert caplog.text.count("but its camera 96 x 64; left out") == 4


@pytest.mark.parametrize(
    ("problems", "remedy"),
    [
        ([WrongSize((96, 55), (96, 64))] * 3, "give the images that the model was made from as --images"),
        ([Damaged("is cut off"), Damaged("is no image"), Missing("is missing")], "copy them again from where"),
        (
            [Unsupported("cannot be used: webp files are not read")] * 3,
            "convert them to PNG, under the same names",
        ),
        ([Unreadable("cannot be read (Permission denied)")] * 3, "check their permissions"),
        ([Missing("is missing")] * 3, "check --images"),
        ([Problem("needs 2 GiB")] * 3, "check --images"),
    ],
)
def test_what_to_do_when_no_image_is_usable(tmp_path: Path, problems: list[Problem], remedy: str) -> None:
    named = {f"{number}.png": problem for number, problem in enumerate(problems)}
    with pytest.raises(InputError, match=rf"None of the model's 3 images in .* is usable; {remedy}"):
        tell_problems(tmp_path / "sparse", tmp_path, named, 3, undistorted=False)


@pytest.mark.parametrize("num_whole", [0, 1])
def test_many_of_one_wrong_size_are_told_together(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, num_whole: int
) -> None:
    """And those that have another problem by name."""
    sparse = make_project(tmp_path)
    names = [f"{number:02d}.png" for number in range(9)]
    problems = dict.fromkeys(names[num_whole:], WrongSize((96, 55), (96, 64))) | {names[8]: Damaged("is damaged")}
    if num_whole:
        tell_problems(sparse, tmp_path, problems, len(names), undistorted=False)
    else:
        with pytest.raises(
            InputError, match=r"None of the model's 9 images in .* is usable; give the images that"
        ):
            tell_problems(sparse, tmp_path, problems, len(names), undistorted=False)
    first = ", ".join(names[num_whole : num_whole + 4])
    assert caplog.messages == [
        f"{8 - num_whole} images in {tmp_path}, each of which has 96 x 55 pixels, but its camera 96 x 64; "
        f"left out: {first}, …",
        f"{tmp_path / names[8]} is damaged; left out",
    ]


@pytest.mark.parametrize(
    ("width", "height", "words", "remedy"),
    [
        (WIDTH // 2, HEIGHT // 2, "have exactly half the size of", "--model and --max-image-size 48"),
        # So COLMAP 3.8 leaves the images of pinhole cameras with --max_image_size 60, and 70: rounded.
        (60, 40, "are smaller than", "--model and --max-image-size 60"),
        (70, 47, "are smaller than", "--model and --max-image-size 70"),
        (WIDTH * 2, HEIGHT * 2, "have exactly 2 times the size of", "--model to have"),
    ],
)
def test_size_of_undistorted_images(tmp_path: Path, width: int, height: int, words: str, remedy: str) -> None:
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    shutil.rmtree(workspace.images_dir)
    resized(tmp_path, width, height).rename(workspace.images_dir)
    workspace = open_workspace(Project(workspace=workspace.root))
    with pytest.raises(InputError, match=rf"{words} their cameras.*give the sparse model with {remedy}"):
        with_good_images(make_context(workspace), execute)


@pytest.mark.parametrize(("width", "height"), [(60, 42), (WIDTH - 1, HEIGHT - 9)])
def test_undistorted_images_that_were_cropped_are_not_told_as_reduced(
    tmp_path: Path, width: int, height: int
) -> None:
    sparse = make_project(tmp_path)
    workspace = prepare(sparse, tmp_path / "dense")
    shutil.rmtree(workspace.images_dir)
    resized(tmp_path, width, height).rename(workspace.images_dir)
    with pytest.raises(InputError, match=r"None of the model's 4 images in .* is usable; give the sparse model"):
        with_good_images(make_context(workspace), execute)


# ---- what is no file ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_models_are_of_regular_files(tmp_path: Path, name: str, kind: str) -> None:
    """Nobody writes into the pipe, and the device has no end."""
    sparse = make_project(tmp_path)
    (sparse / name).unlink()
    make_special(sparse / name, kind)
    with pytest.raises(InputError, match=rf"{name} cannot be read \(it is not a regular file\)"):
        load_model(sparse)


def make_special(path: Path, kind: str) -> None:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
