"""What programs that call `run` rely on: events, configurations, the command in the log, completion."""

import json
import os
import random
import subprocess
import sys
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

import pytest
import tyro
from conftest import IMAGES

from colmap_sph.app import cli, run_command
from colmap_sph.app.config_file import arguments_of_file
from colmap_sph.app.events import SCHEMA
from colmap_sph.app.given_options import all_arguments, known_options
from colmap_sph.app.interruption import Interrupted
from colmap_sph.app.run_command import RunCommand
from colmap_sph.app.shell_words import as_typed
from colmap_sph.errors import InputError

RUN = ["run", "--model", "sparse/0", "--threads", "2", "--num-pairs", "2"]


def events(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, list[dict[str, Any]], str]:
    """Exit code, the events, and what people are told."""
    code = cli.main([*arguments, "--progress", "json"])
    said = capsys.readouterr()
    return code, [json.loads(line) for line in said.out.splitlines()], said.err


# ---- events ------------------------------------------------------------------------------------------------


def test_events_of_a_run(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told, said = events(capsys, *RUN)
    report = json.loads((small / "dense/colmap_sph/report.json").read_text())
    first, *_, last = told
    assert (first["event"], first["schema"], first["workspace"]) == ("begin", SCHEMA, str(small / "dense"))
    assert first["arguments"] == [*RUN, "--progress", "json"]
    assert (code, last["event"], last["exit_code"], last["error"]) == (0, "end", 0, "")
    assert (last["points"], last["images"], last["pairs"]) == (report["points"], 3, 3)
    assert last["coverage"] == pytest.approx(sum(report["coverage"].values()) / 3, abs=1e-4)
    assert [each["seconds"] for each in told] == sorted(each["seconds"] for each in told)
    # Every stage begins, goes on to its last step, and ends.
    stages = [each["stage"] for each in told if each["event"] == "stage"]
    assert stages == [*report["seconds"], "report"]
    assert stages == [each["stage"] for each in told if each["event"] == "stage_end"]
    for stage in stages:
        steps = [each for each in told if each["event"] == "progress" and each["stage"] == stage]
        assert steps[-1]["done"] == steps[-1]["total"]
        (end,) = (each for each in told if each["event"] == "stage_end" and each["stage"] == stage)
        if stage in report["seconds"]:
            assert end["seconds_taken"] >= report["seconds"][stage] - 0.002
    # The time left is unknown until the pairs are known, and has run out at the end. (How much it is: see
    # test_time_left. Here it may be less than the tenth of a second to which it is told.)
    begun = {each["stage"]: each["seconds_left"] for each in told if each["event"] == "stage"}
    assert [stage for stage, left in begun.items() if left is None] == stages[: stages.index("match pairs")]
    assert [each for each in told if each["event"] == "progress"][-1]["seconds_left"] == 0
    # People get the summary, and no bars or stages.
    assert "cloud" in said and "match pairs (" not in said


def test_events_of_what_is_left_out(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (small / "images" / IMAGES[0]).unlink()
    code, told, _ = events(capsys, *RUN)
    (left_out,) = (each for each in told if each["event"] == "left_out")
    assert (code, told[-1]["exit_code"]) == (5, 5)
    assert (left_out["what"], left_out["name"]) == ("image", IMAGES[0])
    assert "is missing" in left_out["reason"]


@pytest.mark.parametrize(
    ("arguments", "expected", "words"),
    [
        ([*RUN, "--num-pairs", "0"], 2, "--num-pairs must be at least 1"),
        (["run"], 2, "There is nothing to work on"),
        ([*RUN, "--min-shared-points", "100000"], 4, "No pair of images overlaps"),
        ([*RUN, "--output", "/proc/dense"], 3, "/proc/dense"),
    ],
)
def test_events_of_a_mistake(
    arguments: list[str], expected: int, words: str, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told, said = events(capsys, *arguments)
    assert (told[0]["event"], told[-1]["event"]) == ("begin", "end")
    assert code == told[-1]["exit_code"] == expected
    assert words in told[-1]["error"]
    assert f"error: {told[-1]['error']}\n" in said


@pytest.mark.parametrize(("error", "code"), [(ValueError("a bug"), 1), (Interrupted(15), 143), (MemoryError(), 6)])
def test_events_end_whatever_happens(
    error: BaseException,
    code: int,
    small: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def failing(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(run_command, "run_project", failing)
    with suppress(ValueError):
        assert cli.main([*RUN, "--progress", "json"]) == code
    end = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (end["event"], end["exit_code"]) == ("end", code)


def test_events_of_a_dry_run(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told, _ = events(capsys, *RUN, "--dry-run")
    assert (code, [each["event"] for each in told]) == (0, ["begin", "plan", "end"])
    plan = told[1]
    assert (plan["undistort"], plan["pairs"], plan["pairs_done"], plan["images"]) == (True, 3, 0, 3)
    assert plan["seconds_left"] > 0 and plan["memory"] > 0 and plan["disk"] > 0


def test_a_run_goes_on_where_nobody_listens(small: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "colmap_sph", *RUN, "--progress", "json"],
        stdout=write,
        stderr=subprocess.PIPE,
        text=True,
        timeout=120,
    )
    os.close(write)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("no more events") == 1
    assert (small / "dense/fused.ply").exists()


def test_progress_none_says_only_the_summary(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*RUN, "--progress", "none"]) == 0
    said = capsys.readouterr()
    assert said.out == "" and "match pairs (" not in said.err and "peak memory" in said.err


# ---- configurations ----------------------------------------------------------------------------------------


def parsed(*typed: str) -> RunCommand:
    return tyro.cli(RunCommand, args=all_arguments(typed, RunCommand), config=(tyro.conf.AvoidSubcommands,))


def test_a_configuration_of_every_kind(tmp_path: Path) -> None:
    """Short names, those of the help, tables, underscores; what is typed wins."""
    file = tmp_path / "run.toml"
    file.write_text("""
        model = "my project/sparse/0"
        max-image-size = 2000
        num_pairs = 7
        memory = "6GiB"
        overwrite = true
        verify = false
        polish-poses = "always"
        fusion.mask-path = "masks"
        [matching]
        p1 = 20
        [rectification]
        surface = "frame"
        sampling = 1
        [vote]
        min_support = 3
    """)
    command = parsed("--config", str(file), "--matching.p1=25", "--num-pairs", "4")
    options = command.options
    assert command.project.model == Path("my project/sparse/0")
    assert (command.overwrite, command.verify) == (True, False)
    assert (options.undistortion.max_image_size, options.pairs.num_pairs, options.memory) == (2000, 4, "6GiB")
    assert (options.polish.poses, options.fusion.mask_path) == ("always", Path("masks"))
    assert (options.matching.p1, options.rectification.surface, options.rectification.sampling) == (
        25,
        "frame",
        1.0,
    )
    assert options.vote.min_support == 3


def some_value(kind: Any, rng: random.Random) -> Any:
    if NoneType in get_args(kind):
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        return rng.choice(get_args(kind))
    values = {
        bool: rng.random() < 0.5,
        int: rng.randint(-5, 5),
        float: rng.uniform(-2, 2),
        str: 'a "b" #=é',
        Path: "-a b",
    }
    return values[kind]


@pytest.mark.parametrize("seed", range(3))
def test_every_option_can_be_in_a_configuration(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    chosen = {
        option.place: some_value(option.kind, rng)
        for option in known_options(RunCommand).values()
        if option.place not in ("config", "within")  # a time does not go with a quality
    }
    file = tmp_path / "run.toml"
    lines = (f"{place} = {json.dumps(value, ensure_ascii=False)}" for place, value in chosen.items())
    file.write_text("\n".join(lines), encoding="utf-8")
    command = parsed("--config", str(file))
    found: dict[str, Any] = {}
    records: list[Any] = [command, command.project, command.options]
    for record in records:
        for field in fields(record):
            value = getattr(record, field.name)
            if is_dataclass(value) and not isinstance(value, type) and field.name not in ("project", "options"):
                found |= {f"{field.name}.{name}": each for name, each in asdict(value).items()}
            else:
                found[field.name] = value
    assert {place: str(found[place]) for place in chosen} == {place: str(value) for place, value in chosen.items()}


def test_a_run_as_an_earlier_one(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*RUN, "--fusion.min-num-pixels", "3", "--max-image-size", "200"]) == 0
    first = json.loads(Path("dense/colmap_sph/report.json").read_text())
    again = ["run", "--model", "sparse/0", "--config", "dense/colmap_sph/report.json", "--output", "again"]
    assert cli.main(again) == 0
    second = json.loads(Path("again/colmap_sph/report.json").read_text())
    assert first["options"] == second["options"]
    assert Path("dense/fused.ply").read_bytes() == Path("again/fused.ply").read_bytes()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("run.toml", "num_pears = 3", r"run\.toml: there is no option num_pears \(did you mean num_pairs\?\)"),
        ("run.toml", "[matching]\nq1 = 3", r"run\.toml: there is no option matching\.q1 .*matching\.p1"),
        ("run.toml", "[matching.p1]\nx = 3", r"run\.toml: matching\.p1 must be a whole number, not"),
        ("run.toml", "[a.b.c.d]\nx = 3", r"run\.toml: there is no option a\.b"),
        ("run.toml", "threads = 'two'", r'run\.toml: threads must be a whole number, not "two"'),
        ("run.toml", "threads = 2.0", r"run\.toml: threads must be a whole number, not 2\.0"),
        ("run.toml", "threads = true", r"run\.toml: threads must be a whole number, not true"),
        ("run.toml", "overwrite = 1", r"run\.toml: overwrite must be true or false, not 1"),
        (
            "run.toml",
            "rectification.sampling = 1979-05-27",
            r"run\.toml: rectification\.sampling must be a number",
        ),
        ("run.toml", "rectification.surface = 'cube'", r"must be one of spherical, frame, not \"cube\""),
        ("run.toml", "model = 3", r"run\.toml: model must be a path in quotes, not 3"),
        ("run.toml", "config = 'run.toml'", r"run\.toml: there is no option config; see"),
        ("run.toml", "num-pairs = 3\nnum_pairs = 4", r"run\.toml: num-pairs and num_pairs are the same option"),
        (
            "run.toml",
            "num_pairs = 3\n[pairs]\nnum_pairs = 4",
            r"num_pairs and pairs\.num_pairs are the same",
        ),
        ("run.toml", "threads == 3", r"run\.toml is not valid TOML \(.*line 1"),
        ("run.toml", "a" * 10 + " = " + "[" * 100_000, r"run\.toml is not valid TOML"),
        ("run.toml", b"\xff\xfe", r"run\.toml is no text in UTF-8"),
        ("report.json", "{", r"report\.json is not valid JSON"),
        ("report.json", "[" * 100_000, r"report\.json is not valid JSON"),
        ("report.json", "{}", r"report\.json is no report of a run"),
        ("report.json", '{"options": {"matching": {"p9": 1}}}', r"report\.json: there is no option matching\.p9"),
        ("missing.toml", None, r"missing\.toml cannot be read \(No such file or directory\); check --config"),
        ("folder", "", r"folder cannot be read \(.*\); check --config"),
    ],
)
def test_configurations_that_make_no_sense(
    name: str, text: str | bytes | None, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    elif text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=words):
        arguments_of_file(path, known_options(RunCommand))
    assert cli.main(["run", "--model", "nowhere", "--config", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "text"), [("run.toml", "threads = 3"), ("run.json", '{"options": {"threads": 3}}')]
)
def test_a_configuration_may_begin_with_a_byte_order_mark(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8-sig")
    assert parsed("--config", str(tmp_path / name)).options.threads == 3


def test_a_configuration_that_is_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "run.toml")
    with pytest.raises(InputError, match="not a regular file"):
        arguments_of_file(tmp_path / "run.toml", known_options(RunCommand))


# ---- the command in the log --------------------------------------------------------------------------------

NAMES = [
    "plain",
    "with space",
    "it's",
    'a "b" $HOME `c` \\ * ? [x] ; & | < > ! # ~',
    "tab\tnew\nline",
    "\x1b]0;x\x07'\\7f",
    "東京\u202egpj",
    "\udcff1.jpg",
    "",
    "-x",
]


@pytest.mark.parametrize("name", NAMES)
def test_a_shell_reads_the_command_as_it_was(name: str, tmp_path: Path) -> None:
    line = as_typed(["run", "--model", name, f"--images={name}"])
    assert line.isprintable()
    probe = tmp_path / "colmap_sph"
    probe.write_text('#!/bin/sh\nfor each in "$@"; do printf "%s\\0" "$each"; done\n')
    probe.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", line], capture_output=True, env=environment, timeout=20, check=True)
    read = [os.fsdecode(each) for each in done.stdout.split(b"\0")[:-1]]
    assert read == ["run", "--model", name, f"--images={name}"]


def test_the_log_repeats_the_run(small: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main([*RUN, "--output", "its own"]) == 0
    first = Path("its own/colmap_sph/log.txt").read_text().splitlines()[0]
    line = first.partition(": colmap_sph ")[2].partition(": ")[2]
    program = f'colmap_sph() {{ "{sys.executable}" -P -m colmap_sph "$@"; }}; {line} --dry-run'
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, timeout=60, cwd="/")
    assert done.returncode == 0, done.stderr
    assert "3 to do" not in done.stderr and "0 to do, 3 done" in done.stderr


# ---- completion --------------------------------------------------------------------------------------------


def completed(script: Path, *words: str) -> list[str]:
    """What bash offers for the last of the words."""
    program = """
        source "$0"
        COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMP_LINE="$*"; COMP_POINT=${#COMP_LINE}
        _tyro_colmap_sph
        printf '%s\\n' "${COMPREPLY[@]}"
    """
    done = subprocess.run(["bash", "-c", program, str(script), *words], capture_output=True, text=True, timeout=20)
    return done.stdout.split()


def test_completion(tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-m", "colmap_sph", "--tyro-print-completion", "bash"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    script = tmp_path / "completion"
    script.write_text(done.stdout)
    assert {"run", "demo", "evaluate"} <= set(completed(script, "colmap_sph", ""))
    assert "--max-image-size" in completed(script, "colmap_sph", "run", "--max")
    assert "--num-pairs" in completed(script, "colmap_sph", "run", "--num")
    assert "--vote.min-support" in completed(script, "colmap_sph", "run", "--vote.m")
    assert set(completed(script, "colmap_sph", "run", "--rectification.surface", "")) == {"spherical", "frame"}
