"""COLMAP's own commands: their options, how these are spelled and read, and the commands that are handed over."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pycolmap
import pytest

from colmap_sph.app import cli
from colmap_sph.app.colmap import names
from colmap_sph.app.colmap.options import (
    COMMANDS,
    PATCH_MATCH_STEREO,
    STEREO_FUSION,
    ColmapOption,
    differing,
    is_default,
)
from colmap_sph.app.colmap.parser import Given, ParseError, parse
from colmap_sph.app.colmap.settings import run_options, target_of
from colmap_sph.app.colmap.spelling import spelling_of
from colmap_sph.app.option_list import option_groups
from colmap_sph.app.run_command import RunCommand
from colmap_sph.pipeline.options import RunOptions

CLASSES = {
    "patch_match_stereo": (pycolmap.PatchMatchOptions, PATCH_MATCH_STEREO),
    "stereo_fusion": (pycolmap.StereoFusionOptions, STEREO_FUSION),
}
needs_colmap = pytest.mark.skipif(shutil.which("colmap") is None, reason="no program colmap is installed")


def given(command: str, *arguments: str) -> Given:
    found = parse(COMMANDS[command], arguments)
    assert found is not None
    return found


# ---- the same options as COLMAP's --------------------------------------------------------------------------


@pytest.mark.parametrize("command", CLASSES)
def test_the_options_are_those_of_pycolmap_with_their_defaults(command):
    """So that a new version of COLMAP shows."""
    kind, table = CLASSES[command]
    theirs = kind().todict()
    theirs.pop("bounding_box", None)
    assert {option.name for option in table} == theirs.keys()
    for option in table:
        value = str(theirs[option.name]) if isinstance(option.default, str) else theirs[option.name]
        assert is_default(option, "" if value == "." else value), option.name
        assert isinstance(option.default, str) or type(theirs[option.name]) is type(option.default), option.name
    assert differing(kind(), table) == {}


@needs_colmap
def test_the_options_are_those_of_the_installed_program():
    text = subprocess.run(["colmap", "stereo_fusion", "--help"], capture_output=True, text=True, check=False)
    flags = {word[2:] for word in (text.stdout + text.stderr).split() if word.startswith("--")}
    assert flags - {"project_path`.", "help", "project_path"} <= COMMANDS["stereo_fusion"].flags().keys()


@needs_colmap
def test_all_commands_of_the_installed_program_are_known():
    text = subprocess.run(["colmap", "help"], capture_output=True, text=True, check=True).stdout
    found = set(text.partition("Available commands:")[2].split())
    assert len(found) > 30
    assert found <= names.OTHERS | set(names.OWN)


@pytest.mark.parametrize("command", COMMANDS)
def test_each_option_acts_or_is_named(command):
    """No silent third case: what it sets is there, or it is told to have no effect."""
    for flag, option in COMMANDS[command].flags().items():
        word = "1" if isinstance(option.default, bool) else str(option.default) or "x"
        required = [f"--{name}=x" for name in COMMANDS[command].required if name != flag]
        found = given(command, f"--{flag}", word, *required)
        assert (flag in found.idle) == (not option.acts), flag
        if option.target:
            stage, _, name = target_of(option).rpartition(".")
            assert hasattr(getattr(RunOptions(), stage) if stage else RunOptions(), name), flag


@pytest.mark.parametrize("command", COMMANDS)
def test_the_documents_say_what_each_option_does(command):
    text = (Path(__file__).parents[1] / "docs/usage.md").read_text(encoding="utf-8")
    section = text.partition("## In COLMAP's place")[2].partition("\n## ")[0]
    for option in COMMANDS[command].sectioned:
        row = f"| `--{COMMANDS[command].section}.{option.name}` | {option.text} |"
        assert (row if option.acts else f"`{option.name}`") in section


# ---- how they are read -------------------------------------------------------------------------------------


def test_both_ways_to_write_values():
    found = given(
        "patch_match_stereo",
        "--workspace_path=a=b",
        "--PatchMatchStereo.gpu_index",
        "-1",
        "--PatchMatchStereo.depth_min",
        "1e-2",
        "--PatchMatchStereo.geom_consistency=false",
        "--PatchMatchStereo.allow_missing",
        "1",
    )
    assert found.plain["workspace_path"] == "a=b" and found.plain["workspace_format"] == "COLMAP"
    assert found.sectioned == {
        "gpu_index": "-1",
        "depth_min": 0.01,
        "geom_consistency": False,
        "allow_missing_files": True,
    }
    assert found.idle == ("PatchMatchStereo.gpu_index",)


WRONG = [
    ["--bad", "1"],
    ["--StereoFusion.min_num_pixels", "abc", "--workspace_path", "q", "--output_path", "z"],
    ["--workspace_path", "a", "--workspace_path", "b"],
    ["--workspace_path"],
    ["--workspace_path", "q"],
    ["--StereoFusion.use_cache", "maybe", "--workspace_path", "q", "--output_path", "z"],
]


@needs_colmap
@pytest.mark.parametrize("arguments", WRONG, ids=lambda words: " ".join(words[:2]))
def test_wrong_options_get_colmaps_own_words_and_exit_code(arguments, capsys):
    truth = subprocess.run(["colmap", "stereo_fusion", *arguments], capture_output=True, text=True, check=False)
    assert cli.main(["stereo_fusion", *arguments]) == truth.returncode == 1
    ours = capsys.readouterr().err.strip().partition("error: ")[2]
    if "use_cache" in str(arguments):  # whose words for booleans are others in each version of its parser
        assert ours.startswith("Failed to parse options - the argument ('maybe')")
    else:
        assert ours == truth.stderr.strip().partition("ERROR: ")[2]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--StereoFusion.min_num_pixels", "0"], "--StereoFusion.min_num_pixels must be at least 1, not 0."),
        (["--StereoFusion.max_image_size", "3"], "--StereoFusion.max_image_size must be -1"),
        (["--StereoFusion.mask_path", "/no"], "--StereoFusion.mask_path: the folder /no does not exist."),
        (["--output_type", "OBJ"], "--output_type must be PLY, BIN or TXT, not 'OBJ'."),
        (["--input_type", "both"], "--input_type must be photometric or geometric, not 'both'."),
        (["--workspace_format", "PMVS"], "--workspace_format PMVS is not supported"),
    ],
)
def test_values_out_of_bounds_are_called_as_colmap_calls_them(arguments, words, capsys, tmp_path):
    arguments = ["stereo_fusion", "--workspace_path", str(tmp_path), "--output_path", "x.ply", *arguments]
    assert cli.main(arguments) == 1
    message = capsys.readouterr().err
    assert words in message and message.count("\n") == 1


def test_a_project_file_is_read_and_the_command_line_goes_first(tmp_path, caplog):
    """Its values at COLMAP's defaults were not chosen: COLMAP writes all of them."""
    path = tmp_path / "project.ini"
    path.write_text(
        "workspace_path=from_file # here\noutput_path = a b.ply\n[SiftExtraction]\nuse_gpu=true\n"
        "[StereoFusion]\nmin_num_pixels=5\nmax_normal_error=20\ncheck_num_images=30\nodd=1\n"
    )
    found = given("stereo_fusion", "--project_path", str(path), "--StereoFusion.max_normal_error", "10")
    assert (found.plain["workspace_path"], found.plain["output_path"]) == ("from_file", "a b.ply")
    assert found.sectioned == {"max_normal_error": 10.0, "check_num_images": 30}
    assert [record.getMessage().partition(": ")[2] for record in caplog.records] == [
        "COLMAP's stereo_fusion has no option StereoFusion.odd; ignored"
    ]


def test_a_project_file_that_is_none(tmp_path, capsys):
    assert cli.main(["stereo_fusion", "--project_path", str(tmp_path / "no.ini")]) == 2
    (tmp_path / "bad.ini").write_text("[StereoFusion]\nmin_num_pixels 5\n")
    assert cli.main(["stereo_fusion", "--project_path", str(tmp_path / "bad.ini")]) == 2
    first, second = capsys.readouterr().err.strip().split("\n")
    assert "no.ini cannot be read" in first and "bad.ini, line 2" in second


def test_what_is_chosen_reaches_our_options():
    """And what is not stays at our own defaults, not at COLMAP's."""
    chosen = given(
        "patch_match_stereo",
        "--workspace_path=x",
        *(f"--PatchMatchStereo.{word}" for word in ("max_image_size=900", "num_threads=-1", "depth_min=2")),
        *(f"--PatchMatchStereo.{word}" for word in ("depth_max=9", "filter_min_num_consistent=3")),
    ).sectioned
    options = run_options(chosen, PATCH_MATCH_STEREO, "PatchMatchStereo")
    assert options.undistortion.max_image_size == 900
    assert options.rectification.depths == (2.0, 9.0)
    assert (options.confirm.min_consistent, options.threads) == (3, 0)
    assert run_options({}, STEREO_FUSION, "StereoFusion") == RunOptions()


def test_help_names_all_options(capsys):
    assert cli.main(["patch_match_stereo", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"--{flag}" in text for flag in COMMANDS["patch_match_stereo"].flags())


# ---- handed over -------------------------------------------------------------------------------------------


def program(folder: Path, text: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "colmap").write_text(f"#!/bin/sh\n{text}\n")
    (folder / "colmap").chmod(0o755)


def hand_over(path: list[Path], *arguments: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PATH": os.pathsep.join(map(str, path))}
    command = [sys.executable, "-m", "colmap_sph", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)


def test_other_commands_are_colmaps_and_never_ours_in_a_circle(tmp_path):
    """A program `colmap` that is this one is passed by, and the next one on the path is taken."""
    program(tmp_path / "ours", f'exec {sys.executable} -m colmap_sph "$@"')
    program(tmp_path / "theirs", 'echo "$@"; exit 7')
    found = hand_over([tmp_path / "ours", tmp_path / "theirs"], "mapper", "--image_path", "a b")
    assert (found.returncode, found.stdout) == (7, "mapper --image_path a b\n")
    alone = hand_over([tmp_path / "ours"], "image_undistorter")
    assert alone.returncode == 2 and "apt install colmap" in alone.stderr and "run --model" in alone.stderr


def test_what_is_handed_over_runs_as_it_would_by_itself(tmp_path, monkeypatch):
    """On all processors: what ours is kept to for itself is not COLMAP's."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    program(tmp_path / "theirs", 'echo "${OPENBLAS_NUM_THREADS-unset}"')
    assert hand_over([tmp_path / "theirs"], "mapper").stdout == "unset\n"


def test_no_command_of_colmap_is_one_of_ours():
    assert not {"run", "demo", "evaluate", "report", "view"} & (names.OTHERS | set(names.OWN))


@pytest.mark.parametrize("word", ["", "x", "2.5"])
def test_a_word_that_is_no_number(word):
    with pytest.raises(ParseError, match="is invalid"):
        given("stereo_fusion", "--workspace_path=a", "--output_path=b", f"--StereoFusion.min_num_pixels={word}")


def test_a_default_is_a_32_bit_float():
    assert is_default(ColmapOption("x", 0.01, ""), 0.009999999776482582)
    assert not is_default(ColmapOption("x", 0.01, ""), 0.0101)


# ---- what is said of them ----------------------------------------------------------------------------------


def test_our_options_are_spelled_as_colmap_does():
    spell = spelling_of("patch_match_stereo")
    assert spell("--confirm.min-consistent is 9") == "--PatchMatchStereo.filter_min_num_consistent is 9"
    assert spell("give fewer --threads or a smaller --max-image-size,") == (
        "give fewer --PatchMatchStereo.num_threads or a smaller --PatchMatchStereo.max_image_size,"
    )
    assert spell("choose another --output.") == "choose another --workspace_path."
    # What the command does not have is another's.
    assert spell("raise --num-pairs or --memory.") == (
        "raise --num-pairs (of colmap_sph run) or --memory (of colmap_sph run)."
    )
    fusion = spelling_of("stereo_fusion")
    assert fusion("try --fusion.input photometric") == "try --input_type photometric"
    for text in (
        "--workspace_path x",
        "/a/--output/b",
        "give `run` --overwrite, which",
        "a--threads",
        "--unknown 7",
    ):
        assert spell(text) == fusion(text) == text
    assert spelling_of("mapper")("--threads") == "--threads"


@pytest.mark.parametrize("command", COMMANDS)
def test_whatever_is_said_can_be_typed(command):
    """Each option of ours is spelled as one of the command's, or said to be another command's."""
    spell = spelling_of(command)
    for group in option_groups(RunCommand):
        for option in group.options:
            said = spell(f"try {option.flag} now")
            flag = said.removeprefix("try --").removesuffix(" now")
            assert flag in COMMANDS[command].flags() or flag.endswith(" (of colmap_sph run)"), said


@pytest.mark.parametrize("command", COMMANDS)
def test_a_switch_takes_no_value(command, capsys):
    assert cli.main([command, "--help=1"]) == 1
    assert "option '--help' does not take any arguments" in capsys.readouterr().err
