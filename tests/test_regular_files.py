"""Pipes in place of files: nobody writes into them, and no run waits for that."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
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
