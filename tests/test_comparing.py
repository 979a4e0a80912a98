"""The comparison of workspaces and of revisions: what differs is found and named, what does not is not."""

import argparse
import importlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import SCRIPTS, FinishedRun

from colmap_sph.project.map_files import read_depth_map, write_depth_map

pytestmark = pytest.mark.usefixtures("scripts_on_path")


@pytest.fixture
def workspaces():
    return importlib.import_module("compare_workspaces")


@pytest.fixture
def revisions():
    return importlib.import_module("compare_revisions")


@pytest.fixture
def copy(finished: FinishedRun, tmp_path: Path) -> Path:
    """The finished workspace once more, to be changed."""
    shutil.copytree(finished.dense, tmp_path / "copy")
    return tmp_path / "copy"


def compare_workspaces(*arguments: Path | str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPTS / "compare_workspaces.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def change_byte(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


def test_a_copy_is_identical(finished, copy):
    done = compare_workspaces(finished.dense, copy)
    assert done.returncode == 0, done.stderr
    # Depth and normal maps of each image, the cloud and its visibility.
    assert done.stdout.strip() == f"0 of {2 * finished.report.images + 2} files differ"


@pytest.mark.parametrize(
    ("pattern", "told"),
    [
        ("stereo/depth_maps/*.geometric.bin", "1 bytes differ, in 1 pixels"),
        ("stereo/normal_maps/*.geometric.bin", "1 bytes differ, in 1 pixels"),
        ("fused.ply", "1 bytes differ"),
        ("fused.ply.vis", "1 bytes differ"),
    ],
)
@pytest.mark.parametrize("place", ["middle", "end"])
def test_a_changed_byte_is_found_and_named(finished, copy, pattern, told, place):
    path = next(iter(sorted(copy.glob(pattern))))
    size = path.stat().st_size
    change_byte(path, size - 1 if place == "end" else size // 2)
    done = compare_workspaces(finished.dense, copy)
    first, last = done.stdout.splitlines()
    assert done.returncode == 1
    assert first.startswith(f"{path.relative_to(copy)}: {told}")
    assert last.startswith("1 of ")


def test_what_differs_is_measured(workspaces, finished, copy):
    name = min(finished.report.coverage)
    path = Path("stereo/depth_maps") / f"{name}.geometric.bin"
    depth = read_depth_map(finished.dense / path)
    rows, columns = np.nonzero(depth)
    changed = depth.copy()
    changed[rows[0], columns[0]] += 0.25
    changed[rows[1], columns[1]] -= 0.125
    changed[rows[2], columns[2]] = 0  # a pixel that lost its depth has no difference of depths
    write_depth_map(copy / path, changed)
    (only,) = workspaces.compare(finished.dense, copy).differences
    assert (only.name, only.only, only.pixels) == (str(path), "", 3)
    assert only.depth == pytest.approx(0.25, rel=1e-4)
    assert only.bytes == np.count_nonzero(depth.view(np.uint8) != changed.view(np.uint8))


def test_signs_of_zero_and_nan_are_bytes_like_others(workspaces, tmp_path):
    files = [tmp_path / "one.bin", tmp_path / "other.bin"]
    for file, value in zip(files, (0.0, -0.0), strict=True):
        file.write_bytes(b"2&1&1&" + np.array([value, np.nan], "<f4").tobytes())
    assert workspaces.differing_bytes(*files) == 1
    assert workspaces.map_difference(*files) == (1, None)


def test_files_that_one_lacks_or_that_end_early_are_named(workspaces, finished, copy):
    names = [Path(f"stereo/depth_maps/{name}.geometric.bin") for name in sorted(finished.report.coverage)]
    (copy / names[0]).unlink()
    (copy / names[1]).write_bytes((copy / names[1]).read_bytes()[:-5])
    (copy / "stereo" / "more.bin").write_bytes(b"")
    found = {d.name: (d.only, d.bytes, d.pixels) for d in workspaces.compare(finished.dense, copy).differences}
    assert found == {
        str(names[0]): ("before", 0, None),
        str(names[1]): ("", 5, None),
        "stereo/more.bin": ("after", 0, None),
    }


def test_files_longer_than_a_block(workspaces, tmp_path, monkeypatch):
    monkeypatch.setattr(workspaces, "_BLOCK", 8)
    for name, content in (("one", b"x" * 20), ("other", b"x" * 7 + b"y" + b"x" * 15)):
        (tmp_path / name).write_bytes(content)
    assert workspaces.differing_bytes(tmp_path / "one", tmp_path / "other") == 1 + 3


def test_nothing_to_compare_is_no_identity(tmp_path):
    done = compare_workspaces(tmp_path, tmp_path / "none")
    assert done.returncode == 2 and "no maps and no cloud" in done.stderr


# ---- revisions ---------------------------------------------------------------------------------------------


def test_scenes_as_they_are_written(revisions, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert revisions.parse_scene("a=m/0") == revisions.Scene("a", tmp_path / "m" / "0")
    full = revisions.Scene("a-1", tmp_path / "m", tmp_path / "i", 800)
    assert revisions.parse_scene("a-1=m:i@800") == full
    assert revisions.parse_scene("a=me@home/0").model == tmp_path / "me@home" / "0"
    for wrong in ("m/0", "=m", "a=", "a=m:", "a=m:i:j", "demo=m", "a/b=m"):
        with pytest.raises(argparse.ArgumentTypeError, match="NAME=MODEL"):
            revisions.parse_scene(wrong)
    options = ["--images", str(tmp_path / "i"), "--max-image-size", "800", "--threads", "2"]
    made = ["run", "--model", str(tmp_path / "m"), "--output", "f/dense", *options]
    assert full.arguments(Path("f"), 2) == made
    assert revisions.Scene("demo", None).arguments(Path("f"), 0) == ["demo", "--output", "f", "--threads", "0"]


def test_identity_of_workspaces_in_a_table(revisions, finished, copy):
    same = revisions.compare(finished.dense, copy, Path(sys.executable))
    path = next(iter(sorted(copy.glob("stereo/depth_maps/*.geometric.bin"))))
    change_byte(path, path.stat().st_size // 2)
    different = revisions.compare(finished.dense, copy, Path(sys.executable))
    compared = {"same": [same, same], "other": [same, different, same]}
    header, _, *rows = [line.strip("| ").split(" | ") for line in revisions.identity_table(compared).splitlines()]
    files = 2 * finished.report.images + 2
    for row, differ in zip(rows, (0, 1), strict=True):
        found = dict(zip(header, row, strict=True))
        assert [int(found[k]) for k in ("files", "identical", "differ", "bytes", "pixels")] == [
            files,
            files - differ,
            differ,
            differ,
            differ,
        ]
    (line,) = revisions.difference_lines(compared)
    assert line.startswith(f"- other: {path.relative_to(copy)}: 1 bytes differ")


def test_not_all_of_many_differences_are_named(revisions):
    one = {"text": "x", "depth": None, "pixels": None, "bytes": 1}
    lines = revisions.difference_lines({"a": [{"files": 99, "bytes": 0, "differences": [one] * 23}]})
    assert len(lines) == 21 and lines[-1] == "- a: 3 more"


def test_ratios_are_of_pairs(revisions):
    """A machine that becomes slower from round to round does not change the ratio."""
    rounds = [(revisions.Cost(w, 2 * w, 1 << 30), revisions.Cost(w / 2, 3 * w, 1 << 29)) for w in (1, 10, 4)]
    _, _, row = revisions.cost_table({"a": rounds}).splitlines()
    cells = "a | 3 | 4.00 | 2.00 | 0.500 | 8.00 | 12.00 | 1.500 | 1.00 | 0.50 | 0.500"
    assert row == f"| {cells} |"


def test_the_working_tree_is_copied_with_what_is_new_and_without_what_is_gone(revisions, tmp_path, monkeypatch):
    repository = tmp_path / "repository"
    repository.mkdir()
    git = ["git", "-C", str(repository), "-c", "user.name=a", "-c", "user.email=a@b"]
    for name, content in ((".gitignore", "*.o\n"), ("kept", "1"), ("gone", "1"), ("made.o", "1")):
        (repository / name).write_text(content)
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "First"]):
        subprocess.run([*git, *command], check=True)
    (repository / "kept").write_text("2")
    (repository / "gone").unlink()
    (repository / "new").write_text("1")
    monkeypatch.setattr(revisions, "_REPOSITORY", repository)
    for revision, files in ((".", {".gitignore": "*.o\n", "kept": "2", "new": "1"}), ("HEAD", None)):
        files = files or {".gitignore": "*.o\n", "kept": "1", "gone": "1"}
        folder = tmp_path / f"checkout{revision}"
        assert revisions.check_out(revision, folder).endswith(" First")
        assert {path.name: path.read_text() for path in folder.iterdir()} == files
    with pytest.raises(SystemExit):
        revisions.check_out("no-such-revision", tmp_path / "none")


def test_a_run_that_fails_ends_the_comparison(revisions, tmp_path, capsys):
    program = tmp_path / "bin" / "colmap_sph"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\necho no luck\nexit 4\n")
    program.chmod(0o755)
    with pytest.raises(SystemExit) as end:
        revisions.run_scene(revisions.Scene("demo", None), tmp_path, tmp_path / "run", 1)
    assert end.value.code == 2
    assert capsys.readouterr().err.endswith("ended with exit code 4: no luck\n")


def test_json_has_the_sentences(finished, copy):
    change_byte(copy / "fused.ply", 900)
    found = json.loads(compare_workspaces(finished.dense, copy, "--json").stdout)
    assert [one["text"] for one in found["differences"]] == ["fused.ply: 1 bytes differ"]
