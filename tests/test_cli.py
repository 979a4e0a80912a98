"""The command: help, exit codes, summary, log and report; and every bad input, said in one sentence."""

import errno
import itertools
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from clouds import read_visibility
from conftest import IMAGES

import colmap_sph
from colmap_sph.app import cli, run_command, spelling
from colmap_sph.app.cli import _parsed
from colmap_sph.app.option_list import option_groups
from colmap_sph.app.products.surface_command import SurfaceCommand
from colmap_sph.app.run_command import RunCommand
from colmap_sph.app.spelling import in_full, with_dashed_values
from colmap_sph.pipeline.options import RunOptions

FAST = ["--threads", "2", "--num-pairs", "2"]


def tree(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def command(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit code, and what the command wrote to the terminal."""
    try:
        code = cli.main(list(arguments))
    except SystemExit as stop:
        assert isinstance(stop.code, int)
        code = stop.code
    captured = capsys.readouterr()
    return code, captured.out + captured.err


def error_sentence(code: int, output: str) -> str:
    """The one line of an error, which comes last."""
    assert code not in (0, 5)
    assert "Traceback" not in output
    lines = [line for line in output.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, output
    assert output.splitlines()[-1] == lines[0]
    return lines[0].removeprefix("error: ")


# ---- help --------------------------------------------------------------------------------------------------


def test_help_of_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    code, output = command(capsys, "--help")
    assert code == 0
    for subcommand in ("run", "demo", "evaluate"):
        assert re.search(rf"• {subcommand} +\w", output), output


EVERYDAY = [
    "model",
    "images",
    "masks",
    "output",
    "workspace",
    "quality",
    "within",
    "max-image-size",
    "num-pairs",
    "threads",
    "memory",
    "dry-run",
    "overwrite",
]


@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_help_of_run_is_one_screen_of_everyday_options(flag: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, output = command(capsys, "run", flag)
    assert code == 0
    assert re.findall(r"^  (--[a-z-]+)", output, re.MULTILINE) == [f"--{name}" for name in EVERYDAY]
    assert len(output.splitlines()) <= 40
    assert max(map(len, output.splitlines())) <= 80
    assert "colmap_sph run --help-all" in output


def test_help_of_run_explains_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    """With what it takes, some words about it, and its default."""
    code, output = command(capsys, "run", "--help-all")
    assert code == 0
    words = " ".join(output.split())
    places = [f"{stage.name}.{field.name}" for stage in fields(RunOptions) for field in STAGES.get(stage.name, ())]
    assert len(places) > 50
    for place in places:
        short = {"pairs.num_pairs": "num-pairs", "undistortion.max_image_size": "max-image-size"}
        short |= {"polish.poses": "polish-poses", "polish.cameras": "polish-cameras"}
        name = f"--{short.get(place, place.replace('_', '-'))}"
        words_of_option = r"(\S+ ){3,}?"
        default = "" if place == "fusion.mask_path" else "Default: "
        assert re.search(rf" {re.escape(name)} \S+ {words_of_option}{default}", words), name


STAGES = {
    field.name: fields(getattr(RunOptions(), field.name))
    for field in fields(RunOptions)
    if is_dataclass(getattr(RunOptions(), field.name))
}


def test_a_run_loads_no_other_commands() -> None:
    """Nor what only a page needs, nor the parser what it does without."""
    program = (
        "import sys; from colmap_sph.app import cli; cli.main(['run', '--model', 'nowhere']); print(*sys.modules)"
    )
    ended = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=True)
    assert "the model folder nowhere does" in ended.stderr.lower()
    loaded = {".".join(name.split(".")[:2]) for name in ended.stdout.split()}
    assert "colmap_sph.pipeline" in loaded
    assert not {"colmap_sph.evaluation", "colmap_sph.products", "colmap_sph.pages", "jinja2", "typeguard"} & loaded


@pytest.mark.parametrize("name", cli.commands())
def test_every_text_of_the_help_is_a_sentence(name: str) -> None:
    """In which options are called as they are typed, and not as in Python."""
    for group in option_groups(cli.commands()[name]):
        in_python = {option.field.name for option in group.options}
        for text in (group.text, *(option.text for option in group.options)):
            assert text[0].isupper() and text[-1] in ".)", text
            assert not in_python & set(re.findall(r"`(\w+)`", text)), text


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize("line", ["run --help", "run --help-all", "evaluate --help", "patch_match_stereo --help"])
def test_help_has_whole_words_at_any_width(
    line: str, width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = {}
    for columns in (400, width):
        monkeypatch.setenv("COLUMNS", str(columns))
        code, output = command(capsys, *line.split())
        assert code == 0
        words[columns] = Counter(output.split())
    assert words[width] == words[400]


@pytest.mark.parametrize(
    ("typed", "parsed"),
    [
        (["--num-pairs", "3"], ["--pairs.num-pairs", "3"]),
        (["--num_pairs=3"], ["--pairs.num-pairs=3"]),
        (["--max-image-size", "-1"], ["--undistortion.max-image-size", "-1"]),
        (["--polish-poses"], ["--polish.poses", "on"]),
        (["--polish-poses", "always"], ["--polish.poses", "always"]),
        (["--polish-poses=off", "--polish-cameras", "True"], ["--polish.poses=off", "--polish.cameras", "True"]),
        (
            ["--polish_poses", "--polish-cameras", "--threads", "2"],
            ["--polish.poses", "on", "--polish.cameras", "True", "--threads", "2"],
        ),
        (
            ["--sampling", "1.2", "--rectification=frame"],
            ["--rectification.sampling", "1.2", "--rectification.surface=frame"],
        ),
        (["--depth.vote-tolerance", "2"], ["--vote.tolerance", "2"]),
        (["--depth.consistency_tolerance", "2"], ["--confirm.tolerance", "2"]),
        (["--fusion-input", "photometric"], ["--fusion.input", "photometric"]),
        (["sparse/0", "--masks", "m"], ["--model", "sparse/0", "--masks", "m"]),
        (["sparse/0", "--model=x"], ["sparse/0", "--model=x"]),  # which of the two is for the parser to refuse
        (["--vote.min-support", "2", "--dry-run"], ["--vote.min-support", "2", "--dry-run"]),
    ],
)
def test_short_and_earlier_spellings(typed: list[str], parsed: list[str]) -> None:
    assert in_full(typed) == parsed


@pytest.mark.parametrize(
    ("typed", "parsed"),
    [
        (["surface", "dense", "--up", "-z"], ["surface", "dense", "--up=-z"]),
        (["run", "--masks", "-m", "--dry-run"], ["run", "--masks=-m", "--dry-run"]),
        (["run", "--masks=m", "-x"], ["run", "--masks=m", "-x"]),
        (["run", "--dry-run", "-h"], ["run", "--dry-run", "-h"]),
        (["--reference-shift", "-1", "-.5", "0"], ["--reference-shift", "-1", "-.5", "0"]),
    ],
)
def test_values_may_begin_with_a_dash(typed: list[str], parsed: list[str]) -> None:
    assert with_dashed_values(typed) == parsed


@pytest.mark.parametrize(
    ("typed", "what"),
    [
        (["run", ""], "--model"),
        (["run", "--model", "sparse/0", "--output", ""], "--output"),
        (["run", "sparse/0", "--images=", "--dry-run"], "--images"),
        (["run", "--workspace", "", "--fusion.mask-path", "m"], "--workspace"),
        (["run", "--workspace", "dense", "--fusion.mask-path="], "--fusion.mask-path"),
        (["demo", "--output", ""], "--output"),
        (["export", ""], "A path"),
        (["evaluate", "--reference", "a.ply", ""], "A path"),
        (["evaluate", "b.ply", "--reference", ""], "--reference"),
    ],
)
def test_empty_paths_are_not_the_current_folder(
    typed: list[str], what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """As from ``--output "$OUT"`` in a script that sets no OUT."""
    assert error_sentence(*command(capsys, *typed)).startswith(f"{what} is empty; give a path, ")


def test_other_values_may_be_empty() -> None:
    """They are as if they were not given."""
    assert _parsed(["run", "--workspace", "dense", "--memory", "", "--region="]) == _parsed(
        ["run", "--workspace", "dense"]
    )


def test_up_is_along_a_negative_axis() -> None:
    command = _parsed(["surface", "dense", "--up", "-z"])
    assert isinstance(command, SurfaceCommand) and command.options.up == "-z"


def test_every_earlier_spelling_leads_to_an_option() -> None:
    flags = {option.flag for group in option_groups(RunCommand) for option in group.options}
    assert set(spelling._RENAMED.values()) <= flags
    assert set(spelling.EVERYDAY) <= flags
    assert not spelling._RENAMED.keys() & flags


@pytest.mark.parametrize(
    ("name", "usage", "options"),
    [
        ("demo", "demo [OPTIONS]", ["--output PATH", "--threads N"]),
        ("evaluate", "evaluate --reference PATH [OPTIONS] [CLOUDS ...]", ["--register {True,False}", "--gsd X"]),
        ("export", "export [OPTIONS] WORKSPACE", ["--overwrite", "--crs TEXT"]),
        ("surface", "surface [OPTIONS] WORKSPACE", ["--[no-]orthophoto", "--plane TEXT TEXT TEXT"]),
        ("mesh", "mesh [OPTIONS] WORKSPACE", ["--texture", "--formats {ply,glb,obj} ..."]),
        ("view", "view [OPTIONS] WORKSPACE", ["--full", "--port N"]),
        ("report", "report [OPTIONS] WORKSPACE", []),
    ],
)
def test_help_of_other_commands(
    name: str, usage: str, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """In words: an option that is not given has what its text says, and not a value of the program's language."""
    code, output = command(capsys, name, "--nonsense", "--help")
    assert code == 0
    assert output.startswith(f"usage: colmap_sph {usage}\n")
    for option in options:
        assert re.search(rf"^  {re.escape(option)}  +[A-Z0-9]", output, re.MULTILINE), option
    told = [option.flag for group in option_groups(cli.commands()[name]) for option in group.options]
    assert all(flag.replace("--", "", 1) in output for flag in told)
    assert not re.search(r"None|MISSING|default: ", output)


@pytest.mark.parametrize("flag", ["--version", "-V"])
def test_version(flag: str) -> None:
    """Told at once: no library is loaded for it."""
    program = "import sys; from colmap_sph.__main__ import main; print(main(), *sys.modules)"
    done = subprocess.run([sys.executable, "-P", "-c", program, flag], capture_output=True, text=True, check=True)
    name, version, code, *loaded = done.stdout.split()
    assert (name, version, code) == ("colmap_sph", colmap_sph.__version__, "0")
    assert not {"numpy", "pycolmap", "cv2", "tyro"} & {*loaded}


# ---- a run -------------------------------------------------------------------------------------------------


def test_run(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, output = command(capsys, "run", "--model", "sparse/0", *FAST, "--fusion.max-reproj-error", "1")
    assert code == 0
    report = json.loads((small / "dense/colmap_sph/report.json").read_text())
    assert report["options"]["fusion"]["max_reproj_error"] == 1
    assert report["options"]["pairs"]["num_pairs"] == report["options"]["threads"] == 2
    assert list(report["coverage"]) == IMAGES
    assert report["images"] == report["pairs"] == 3
    # The closing summary.
    words = " ".join(output.split())
    for name in IMAGES:
        assert f"{name} {100 * report['coverage'][name]:.1f} %" in words
    assert "images 3 with depth maps, mean coverage" in words
    assert "pairs 3 matched (tracks)" in words
    assert f"{report['points']:,} points in" in words
    for stage in ("undistort", "select pairs", "match pairs", "vote on depth", "confirm depth", "fuse"):
        assert f"{stage} {report['seconds'][stage]:.1f}" in words
    assert re.search(r"peak memory \d+\.\d\d GiB", words)
    assert re.search(r"look at \S*dense/colmap_sph/report\.html, in a browser: colmap_sph view \S*dense", words)
    assert (small / "dense/colmap_sph/report.html").is_file()
    # The log file.
    log = (small / "dense/colmap_sph/log.txt").read_text().splitlines()
    assert all(re.match(r"20\d\d-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} INFO colmap_sph\.[\w.]+: ", line) for line in log)
    typed = f"run --model sparse/0 {' '.join(FAST)} --fusion.max-reproj-error 1"
    assert log[0].endswith(f"colmap_sph {colmap_sph.__version__}: cd {small} && colmap_sph {typed}")
    assert "RunCommand(" in log[1] and "max_reproj_error=1" in log[1]
    assert any("Undistorted 3 of 3 images" in line for line in log)
    assert any("3 pairs of 3 images" in line for line in log)
    assert "Fuse: " in log[-2]
    assert "Report: " in log[-1]
    # Nothing of ours stays behind in the logging of the process.
    assert logging.getLogger("colmap_sph").handlers == []


def test_the_log_of_a_second_run_follows_the_first(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(capsys, "run", "--model", "sparse/0", *FAST)[0] == 0
    first = (small / "dense/colmap_sph/log.txt").read_text()
    code, output = command(capsys, "run", "--workspace", "dense", "--min-shared-points", "100000")
    assert "No pair of images overlaps" in error_sentence(code, output)
    log = (small / "dense/colmap_sph/log.txt").read_text()
    assert log.startswith(first)
    added = log.removeprefix(first)
    assert added.splitlines()[0].endswith(" run --workspace dense --min-shared-points 100000")
    assert "Stopped: No pair of images overlaps" in added
    assert "Traceback" not in added


def test_as_a_program(small: Path) -> None:
    """A process of its own, without a terminal, with Python's warnings as errors."""
    done = subprocess.run(
        [sys.executable, "-P", "-W", "error", "-m", "colmap_sph", "run", "--model", "sparse/0", *FAST],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "COLUMNS": "200"},
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"cloud +[\d,]+ points in \S", done.stderr)
    assert done.stdout == ""
    done = subprocess.run(
        [sys.executable, "-P", "-m", "colmap_sph", "run", "--model", "nowhere"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "nowhere does not exist" in error_sentence(done.returncode, done.stderr)


def test_what_few_commands_need_is_not_loaded_by_all() -> None:
    program = "import sys, colmap_sph.app.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=True)
    assert not {"laspy", "pyproj", "scipy.interpolate", "scipy.optimize"} & {*loaded.stdout.split()}


def test_a_reader_that_has_seen_enough() -> None:
    """The output's reader closes it at once, as `| head` does."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-P", "-m", "colmap_sph", "run", "--help"]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


def test_interruption(small: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(run_command, "run_project", interrupted)
    code, output = command(capsys, "run", "--model", "sparse/0")
    assert code == 143
    assert output.splitlines()[-1].startswith("interrupted; ")
    assert "run the same command again" in output
    assert "Traceback" not in output
    assert signal.getsignal(signal.SIGTERM) is before


# ---- images that are left out ------------------------------------------------------------------------------


def remove(path: Path) -> None:
    path.unlink()


def shrink(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros((80, 100, 3), np.uint8))


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:4000])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (remove, "is missing"),
        (shrink, "has 100 x 80 pixels, but its camera 320 x 240"),
        (cut_off, "is damaged or no image"),
    ],
)
@pytest.mark.parametrize("one", [True, False], ids=["one", "all"])
def test_unusable_images(
    spoil: Callable[[Path], None], words: str, one: bool, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One is reported and the rest go on; without any the run ends."""
    for name in IMAGES[:1] if one else IMAGES:
        spoil(small / "images" / name)
    before = tree(small)
    code, output = command(capsys, "run", "--model", "sparse/0", "--images", "images", *FAST)
    assert re.search(rf"{IMAGES[0]} {words}( \([^)]+\))?; left out", " ".join(output.split()))
    if one:
        assert code == run_command.PARTIAL_EXIT_CODE == 5
        assert f"image skipped: {IMAGES[0]}: " in output
        report = json.loads((small / "dense/colmap_sph/report.json").read_text())
        assert list(report["skipped_images"]) == IMAGES[:1]
        assert list(report["coverage"]) == IMAGES[1:]
        assert words in (small / "dense/colmap_sph/log.txt").read_text()
    else:
        assert code == 2
        assert "None of the model's 3 images" in error_sentence(code, output)
        assert tree(small) == before


def test_names_that_look_like_markup(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = pycolmap.Reconstruction(small / "sparse/0")
    for image in model.images.values():
        if image.name in IMAGES[:2]:
            (small / "images" / image.name).rename(small / "images" / f"[red]{image.name}")
            image.name = f"[red]{image.name}"
    model.write(small / "sparse/0")
    (small / "images" / f"[red]{IMAGES[1]}").unlink()
    code, output = command(capsys, "run", "--model", "sparse/0", *FAST)
    assert code == 5
    assert f"image skipped: [red]{IMAGES[1]}: " in output
    assert f"\n[red]{IMAGES[0]} " in output


def test_names_that_would_steer_the_terminal(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One is there, one is missing; neither reaches terminal or log as it is."""
    names = ["\\[/]\x1b]0;title\x07\u202ea.jpg", "[/]\x1b[2Jb.jpg"]
    model = pycolmap.Reconstruction(small / "sparse/0")
    for image in model.images.values():
        if image.name in IMAGES[:2]:
            name = names[IMAGES.index(image.name)]
            (small / "images" / image.name).rename(small / "images" / name.replace("/", "_"))
            image.name = name.replace("/", "_") if name == names[0] else name
    model.write(small / "sparse/0")
    code, output = command(capsys, "run", "--model", "sparse/0", *FAST)
    assert code == 5
    assert "\n\\[_]\\x1b]0;title\\x07\\u202ea.jpg " in output
    assert "image skipped: [/]\\x1b[2Jb.jpg: " in output
    log = (small / "dense/colmap_sph/log.txt").read_text(encoding="utf-8")
    assert (output + log).replace("\n", "").isprintable()


# ---- bad input ---------------------------------------------------------------------------------------------

RUN = ["run", "--model", "sparse/0"]
BAD = {
    "neither": (["run"], 2, "--model"),
    "both": ([*RUN, "--workspace", "dense"], 2, "not both"),
    "workspace and images": (["run", "--workspace", "images", "--images", "images"], 2, "leave out --images"),
    "workspace and output": (["run", "--workspace", "images", "--output", "x"], 2, "leave out"),
    "workspace and size": (
        ["run", "--workspace", "images", "--max-image-size", "900"],
        2,
        "leave out --max-image-size",
    ),
    "no folder": (["run", "--model", "no/sparse/0"], 2, "no/sparse/0 does not exist"),
    "no model": (["run", "--model", "images"], 2, "No COLMAP model in images"),
    "model above": (["run", "--model", "sparse"], 2, "did you mean sparse/0"),
    "project": (["run", "--model", "."], 2, "did you mean sparse/0"),
    "file of the model": (["run", "--model", "sparse/0/images.bin"], 2, "images.bin is a file; give the folder"),
    "no images": ([*RUN, "--images", "none"], 2, "none does not exist"),
    "file as images": ([*RUN, "--images", "sparse/0/images.bin"], 2, "images.bin is a file; check --images"),
    "wrong images": ([*RUN, "--images", "sparse"], 2, "None of the model's 3 images in sparse is usable"),
    "no workspace": (["run", "--workspace", "none"], 2, "none does not exist"),
    "not a workspace": (["run", "--workspace", "images"], 2, "not a dense workspace"),
    "file in the way": ([*RUN, "--output", "sparse/0/cameras.bin"], 3, "cameras.bin"),
    "file as parent": ([*RUN, "--output", "sparse/0/cameras.bin/dense"], 3, "cameras.bin"),
    "unwritable": ([*RUN, "--output", "/proc/dense"], 3, "/proc/dense"),
    "threads": ([*RUN, "--threads", "-1"], 2, "--threads must lie in 0..1024, not -1"),
    "pairs": ([*RUN, "--num-pairs", "0"], 2, "--num-pairs must be at least 1, not 0"),
    "p1": ([*RUN, "--matching.p1", "500"], 2, "--matching.p1"),
    "sampling": ([*RUN, "--sampling", "nan"], 2, "--rectification.sampling must"),
    "vote": ([*RUN, "--vote.tolerance", "0"], 2, "--vote.tolerance must be positive"),
    "normals": ([*RUN, "--normals.radius", "0"], 2, "--normals.radius must"),
    "fusion": ([*RUN, "--fusion.min-num-pixels", "0"], 2, "--fusion.min-num-pixels must"),
    "masks": ([*RUN, "--fusion.mask-path", "none"], 2, "none does not exist"),
    "size": ([*RUN, "--max-image-size", "3"], 2, "--max-image-size must"),
    "demo threads": (["demo", "--threads", "-1"], 2, "--threads must lie"),
    "demo in a project": (["demo", "--output", "."], 3, "already holds other files"),
    "demo in a file": (["demo", "--output", "sparse/0/cameras.bin"], 3, "cameras.bin"),
    "demo unwritable": (["demo", "--output", "/proc/demo"], 3, "/proc/demo"),
}


def test_the_model_that_is_meant_is_not_the_workspaces_own(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(small / "sparse" / "0", small / "dense" / "sparse")
    code, output = command(capsys, "run", "--model", ".")
    assert code == 2 and "did you mean sparse/0" in output
    shutil.rmtree(small / "sparse")
    assert "did you mean dense/sparse" in command(capsys, "run", "--model", ".")[1]


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case: str, small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One sentence, an exit code, and not a file or folder more than before."""
    arguments, expected, words = BAD[case]
    before = tree(small)
    code, output = command(capsys, *arguments)
    assert words in error_sentence(code, output)
    assert code == expected
    assert tree(small) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "run, demo"),
        (["fly"], "fly"),
        ([*RUN, "--bogus", "3"], "--bogus"),
        ([*RUN, "--threads", "many"], "--threads"),
        ([*RUN, "--rectification", "cube"], "--rectification"),
        ([*RUN, "--model"], "--model"),
        (["demo", "--model", "sparse/0"], "--model"),
    ],
)
def test_arguments_that_make_no_sense(
    arguments: list[str], words: str, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = tree(small)
    code, output = command(capsys, *arguments)
    assert code == 2
    assert words in output
    assert "Traceback" not in output
    assert tree(small) == before


@pytest.mark.parametrize(
    ("bound", "value"), [("--pairs.min-shared-points", "100000"), ("--pairs.min-triangulation-angle", "59")]
)
def test_no_pair_with_overlap(bound: str, value: str, small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, output = command(capsys, *RUN, bound, value)
    assert code == 4
    sentence = error_sentence(code, output)
    assert "No pair of images overlaps" in sentence
    # What is to be lowered, as it is typed.
    assert bound in sentence
    # The dense workspace is whole, without maps and cloud, and serves the next run.
    assert not list((small / "dense/stereo").rglob("*.bin"))
    assert not list((small / "dense").glob("fused*"))
    assert "No pair of images overlaps" in (small / "dense/colmap_sph/log.txt").read_text()
    assert command(capsys, *RUN, *FAST)[0] == 0


def test_damaged_model(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = small / "sparse/0/points3D.bin"
    path.write_bytes(path.read_bytes()[:-5])
    before = tree(small)
    code, output = command(capsys, *RUN)
    assert code == 2
    assert "points3D.bin is truncated or damaged" in error_sentence(code, output)
    assert tree(small) == before


def test_output_that_is_not_ours(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (small / "dense/images").mkdir(parents=True)
    (small / "dense/images/mine.txt").write_text("keep me")
    before = tree(small)
    code, output = command(capsys, *RUN)
    assert code == 2
    assert "which this program did not make" in error_sentence(code, output)
    assert tree(small) == before


@pytest.mark.parametrize("blocked", ["fused.ply", "colmap_sph/report.json", "colmap_sph/log.txt"])
def test_output_files_that_cannot_be_written(
    blocked: str, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(capsys, *RUN, "--min-shared-points", "100000")[0] == 4
    path = small / "dense" / blocked
    path.unlink(missing_ok=True)
    path.mkdir()
    code, output = command(capsys, *RUN, *FAST)
    assert code == 3
    assert Path(blocked).name in error_sentence(code, output)
    assert not list((small / "dense").rglob("*.tmp"))


def test_wrong_kernels(small: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLMAP_SPH_KERNELS", "sse9")
    before = tree(small)
    code, output = command(capsys, *RUN, *FAST)
    assert code == 2
    assert "COLMAP_SPH_KERNELS=sse9" in error_sentence(code, output)
    assert tree(small) == before


# ---- what is done already ----------------------------------------------------------------------------------


def test_dry_run_writes_nothing(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = tree(small)
    code, output = command(capsys, *RUN, *FAST, "--dry-run")
    assert code == 0
    assert tree(small) == before
    words = " ".join(output.split())
    for line in ("undistort to do", "pairs 3 to do, 0 done", "images 3 to do, 0 done", "cloud 1 to do, 0 done"):
        assert line in words
    assert re.search(
        r"time about \d+ s memory about \d+\.\d MB disk about \d+\.\d MB more, of [\d.]+ \wB free", words
    )
    assert "estimates" in words
    assert command(capsys, *RUN, *FAST)[0] == 0
    stamps = {path: path.stat().st_mtime_ns for path in small.rglob("*")}
    code, output = command(capsys, *RUN, *FAST, "--dry-run", "--fusion.min-num-pixels", "3")
    assert code == 0
    words = " ".join(output.split())
    for line in ("undistort done", "pairs 0 to do, 3 done", "images 0 to do, 3 done", "cloud 1 to do, 0 done"):
        assert line in words
    assert {path: path.stat().st_mtime_ns for path in small.rglob("*")} == stamps


def test_an_image_that_cannot_be_fused_is_left_out(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its mask does not fit: the cloud is made without it, and made again once the mask is mended."""
    assert command(capsys, *RUN, *FAST)[0] == 0
    (small / "masks").mkdir()
    mask = small / "masks" / f"{IMAGES[1]}.png"
    wanted = ["--fusion.mask-path", "masks"]
    cv2.imwrite(str(mask), np.full((24, 32), 255, np.uint8))
    for _ in range(2):
        code, output = command(capsys, *RUN, *FAST, *wanted)
        assert code == run_command.PARTIAL_EXIT_CODE
        assert "Traceback" not in output
        words = " ".join(output.split())
        assert f"image skipped: {IMAGES[1]}: The mask masks/{IMAGES[1]}.png has 32 x 24 pixels" in words
        assert set(itertools.chain(*read_visibility(small / "dense/fused.ply.vis"))) == {0, 2}
    cv2.imwrite(str(mask), np.full((240, 320), 255, np.uint8))
    assert command(capsys, *RUN, *FAST, *wanted)[0] == 0
    assert set(itertools.chain(*read_visibility(small / "dense/fused.ply.vis"))) == {0, 1, 2}


@pytest.mark.parametrize("how", [[], ["--dry-run"]])
def test_a_folder_without_masks_for_fusion(
    how: list[str], small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Refused before anything is matched: the cloud would be made as without masks."""
    code, output = command(capsys, *RUN, "--fusion.mask-path", "sparse", *how)
    assert code == 2
    wanted = f"sparse holds no mask for any image; that of {IMAGES[0]} must be sparse/{IMAGES[0]}.png."
    assert wanted in error_sentence(code, output)
    assert not (small / "dense/colmap_sph/pairs").exists()


@pytest.mark.parametrize("case", ["neither", "no model", "wrong images", "not a workspace", "pairs", "threads"])
def test_dry_run_finds_the_same_mistakes(case: str, small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments, expected, words = BAD[case]
    before = tree(small)
    code, output = command(capsys, *arguments, "--dry-run")
    assert words in error_sentence(code, output)
    assert code == expected
    assert tree(small) == before


@pytest.mark.parametrize("memory", ["1", "1MiB"])
def test_a_dry_run_refuses_too_little_memory_as_the_run_does(
    memory: str, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the same words, but for the image that comes first."""
    said = []
    for more in (["--dry-run"], []):
        code, output = command(capsys, *RUN, *FAST, "--memory", memory, *more)
        assert code == 2
        said.append(" ".join(error_sentence(code, output).split()))
    pattern = re.compile(
        r"of memory \(--memory, or a share of what is free\) is too little for (\S+); \w+ would do"
    )
    assert all(pattern.search(words) for words in said)
    assert command(capsys, *RUN, *FAST, "--memory", "1GiB", "--dry-run")[0] == 0


def test_a_second_run_says_what_was_up_to_date(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = command(capsys, *RUN, *FAST)[1]
    assert "up to date" not in first
    code, output = command(capsys, *RUN, *FAST)
    assert code == 0
    words = " ".join(output.split())
    assert "up to date undistort 3, match pairs 3, vote on depth 3, confirm depth 3, fuse 1" in words
    code, output = command(capsys, *RUN, *FAST, "--overwrite")
    assert code == 0
    assert "up to date" not in output


@pytest.mark.parametrize(
    ("error", "expected", "words"),
    [
        (MemoryError(), 6, "not enough memory"),
        (
            OSError(28, "No space left on device", "some/file"),
            3,
            "some/file cannot be used (No space left on device)",
        ),
        (OSError(28, "No space left on device"), 3, "No space left on device"),
        (RuntimeError("can't start new thread"), 6, "refuses another thread"),
        (OSError(errno.EDQUOT, os.strerror(errno.EDQUOT), "some/file"), 3, "some/file cannot be used (Disk quota"),
        (
            OSError(errno.EFBIG, os.strerror(errno.EFBIG), "some/file"),
            3,
            "some/file cannot be used (File too large)",
        ),
    ],
)
def test_what_the_system_refuses(
    error: Exception,
    expected: int,
    words: str,
    small: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(run_command, "run_project", refused)
    code, output = command(capsys, *RUN)
    assert words in error_sentence(code, output)
    assert code == expected
