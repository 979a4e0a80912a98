"""Pipes in place of files: nobody writes into them, and no run waits for that."""

import os
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from corruption import make_cases
from test_undistortion import NAMES, make_project

from colmap_sph.app import cli
from colmap_sph.project.files import open_regular

SECONDS = 30


@contextmanager
def no_waiting() -> Iterator[None]:
    """End what takes too long."""

    def end(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def run(*arguments: object) -> int:
    with no_waiting():
        return cli.main(["run", *map(str, arguments), "--threads", "1", "--min-shared-points", "2"])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with images, masks, a model, and a workspace with a finished run in it, `finished`."""
    root = tmp_path_factory.mktemp("project")
    make_project(root)
    make_cases(root)
    return root


def test_a_regular_file_is_read_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"content")
    (tmp_path / "link").symlink_to("file")
    for name in ("file", "link"):
        with open_regular(tmp_path / name) as file:
            assert file.read() == b"content"
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero"), Path("/dev/null")):
        with no_waiting(), pytest.raises(OSError, match="it is not a regular file"):
            open_regular(path)
    with pytest.raises(FileNotFoundError):
        open_regular(tmp_path / "absent")


@pytest.mark.parametrize(
    ("place", "code", "words"),
    [
        ("sparse/images.bin", 2, "images.bin cannot be read (it is not a regular file)"),
        ("stereo/patch-match.cfg", 2, "patch-match.cfg cannot be read (it is not a regular file)"),
        (f"images/{NAMES[0]}", 5, "a.png is "),
        (f"masks/{NAMES[0]}.png", 2, "a.png.png is not a regular file"),
        ("colmap_sph/log.txt", 3, "log.txt cannot be written: it is not a regular file"),
        # What this program made is made again.
        ("stereo/fusion.cfg", 0, ""),
        (f"stereo/depth_maps/{NAMES[0]}.geometric.bin", 0, ""),
        (f"colmap_sph/photometric/{NAMES[0]}.sph", 0, ""),
        ("colmap_sph/cloud.json", 0, ""),
        (f"colmap_sph/state/{NAMES[0]}.geometric.json", 0, ""),
        ("colmap_sph/report.json", 0, ""),
        ("fused.ply", 0, ""),
        ("fused.ply.vis", 0, ""),
    ],
)
def test_pipes_in_a_workspace(
    finished: Path, capsys: pytest.CaptureFixture[str], place: str, code: int, words: str
) -> None:
    path = finished / "finished" / place
    path.parent.mkdir(parents=True, exist_ok=True)
    there = path.exists()
    kept = path.with_name("kept")
    if there:
        path.rename(kept)
    os.mkfifo(path)
    try:
        assert run("--workspace", finished / "finished") == code
        assert "".join(words.split()) in "".join(capsys.readouterr().err.split())
        if not code:
            assert path.is_file() or not there
    finally:
        if there:
            kept.replace(path)
        elif path.exists():
            path.unlink()
            path.parent.rmdir()


@pytest.mark.parametrize(
    "place",
    [
        "fused.ply",
        "fused.ply.vis",
        "stereo/fusion.cfg",
        f"stereo/depth_maps/{NAMES[0]}.geometric.bin",
        f"stereo/normal_maps/{NAMES[2]}.geometric.bin",
        f"colmap_sph/photometric/{NAMES[2]}.sph",
        "colmap_sph/pairs/000/000001-000002.sph",
        f"colmap_sph/state/{NAMES[2]}.geometric.json",
        "colmap_sph/cloud.json",
        "colmap_sph/images.json",
        "colmap_sph/report.json",
        *(f"colmap_sph/known/{name}.json" for name in ("selection", "pairs", "photometric", "geometric", "page")),
    ],
)
@pytest.mark.parametrize("start", ["dense", "finished"])
def test_folders_in_the_places_of_files_are_told_before_anything_is_made(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], start: str, place: str
) -> None:
    """Some were noticed after hours: where the file was written, and others were set aside for it before."""
    workspace = shutil.copytree(finished / start, tmp_path / "dense", ignore=shutil.ignore_patterns("*.backup*"))
    path = workspace / place
    assert (finished / "finished" / place).is_file()  # where a run does write a file
    path.unlink(missing_ok=True)
    path.mkdir(parents=True)
    (path / "mine.txt").write_text("mine")
    before = {each: each.read_bytes() for each in workspace.rglob("*") if each.is_file()}
    assert run("--workspace", workspace, "--sampling", 0.9) == 3
    told = "".join(capsys.readouterr().err.split())
    assert "".join(f"error: {path} is a folder, and a file goes there; remove it".split()) in told
    log = workspace / "colmap_sph/log.txt"
    after = {each: each.read_bytes() for each in workspace.rglob("*") if each.is_file()}
    assert {each: content for each, content in after.items() if each != log} == {
        each: content for each, content in before.items() if each != log
    }


def test_folders_of_images_may_be_called_like_files(finished: Path, tmp_path: Path) -> None:
    """Such as an image `cloud.json/c.png`, whose maps and records lie in folders of that name."""
    workspace = shutil.copytree(finished / "dense", tmp_path / "dense")
    model = pycolmap.Reconstruction(workspace / "sparse")
    for number, name in enumerate(("cloud.json/c.png", "a.geometric.bin/d.png"), start=3):
        image = model.image(number)
        target = workspace / "images" / name
        target.parent.mkdir()
        (workspace / "images" / image.name).rename(target)
        image.name = name
    model.write(workspace / "sparse")
    shutil.rmtree(workspace / "stereo")
    shutil.copytree(finished / "dense/stereo/consistency_graphs", workspace / "stereo/consistency_graphs")
    assert run("--workspace", workspace) == 0
    assert run("--workspace", workspace, "--sampling", 0.9) == 0  # where the folders are by now
    assert (workspace / "stereo/depth_maps/cloud.json/c.png.geometric.bin").is_file()


@pytest.mark.parametrize(
    ("place", "code", "words"),
    [
        (f"images/{NAMES[0]}", 0, "a.png is "),
        (f"masks/{NAMES[0]}.png", 2, "a.png.png is not a regular file"),
        ("database.db", 0, ""),
        ("dense/colmap_sph/undistortion.json", 0, ""),
    ],
)
def test_pipes_in_a_project(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], place: str, code: int, words: str
) -> None:
    sparse = make_project(tmp_path)
    for name in NAMES:
        mask = tmp_path / "masks" / f"{name}.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(mask), np.full((64, 96), 255, np.uint8))
    path = tmp_path / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    assert run("--model", sparse, "--masks", tmp_path / "masks", "--dry-run") == code
    assert "".join(words.split()) in "".join(capsys.readouterr().err.split())
