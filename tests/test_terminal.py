"""What a person is told: plain lines off the terminal, names that can do no harm, streams closed or full."""

import errno
import logging
import os
import re
import resource
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from conftest import keep_images
from rich.cells import cell_len

from colmap_sph.app import cli, display, log_file
from colmap_sph.app.display import Display
from colmap_sph.app.log_file import workspace_log
from colmap_sph.app.terminal import Terminal, shortened, warnings_shown, wrapped
from colmap_sph.errors import OutputError, printable
from colmap_sph.project.workspace import Workspace

HOSTILE = [
    "\x1b]0;title\x07.jpg",
    "a\r\nb\n2026-01-01 00:00:00,000 INFO forged.jpg",
    "\x9b2Jc1.jpg",
    "\u202egpj.exe",
    "zero\u200bwidth\ufeff.jpg",
    "\\[/]x.jpg",
    "[/]",
    "[bold red]x",
    "line\u2028separator\x85\x0b\x0c",
    "\udcff.jpg",
    "\x7f\x00",
    ":smile:\\",
]
TIME = r"20\d\d-\d\d-\d\d \d\d:\d\d:\d\d"


def assert_harmless(text: str, lines: int) -> None:
    """Nothing but letters and that many lines."""
    assert text.count("\n") == lines
    assert text.replace("\n", "").isprintable()


# ---- names -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["Köln Süd.jpg", "Ko\u0308ln.jpg", "東京/写真 1.jpg", "имя-ñ_ß.png", "a\\b[0].jpg", "é😀"]
)
def test_readable_names_stay(name: str) -> None:
    assert printable(name) == name


@pytest.mark.parametrize("name", HOSTILE)
def test_nothing_steers_the_terminal(name: str) -> None:
    assert_harmless(printable(name), 0)


def test_names_that_look_alike_are_told_apart() -> None:
    names = [
        "ab",
        *(f"a{character}b" for character in "\u200b\u200d\u2060\u034f\u3164\ufe0f\u00ad\u2066\U000e0061"),
    ]
    assert len({printable(name) for name in names}) == len(names)
    assert all(printable(name).isascii() for name in names)


@pytest.mark.parametrize("name", HOSTILE)
def test_messages_with_hostile_names(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    terminal = Terminal()
    terminal.say(name, label="error:", style="bold red")
    terminal.note(name)
    terminal.facts([("images", name), (name, "x")])
    terminal.table("Depth maps", ["image", "coverage"], [(name, "1 %")])
    with warnings_shown(terminal):
        logging.getLogger("colmap_sph.test").warning("%s skipped", name)
    said = capsys.readouterr().err
    assert_harmless(said, 8)
    assert said.startswith(f"error: {printable(name)}\n")
    assert re.search(rf"^{TIME} warning: .* skipped$", said, re.MULTILINE)


@pytest.mark.parametrize("name", HOSTILE)
def test_the_log_has_a_line_for_each_record(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "colmap_sph")
    workspace = Workspace(tmp_path)
    workspace.state_dir.mkdir()
    workspace.sparse_dir.mkdir()
    with pytest.raises(ValueError), workspace_log(workspace, f"header {name}"):
        logging.getLogger("colmap_sph.test").warning("%s skipped", name)
        raise ValueError(name)
    log = workspace.log_path.read_text(encoding="utf-8")
    assert log.replace("\n", "").isprintable()
    records = [line for line in log.splitlines() if not line.startswith("  ")]
    assert len(records) == 3
    assert all(re.match(rf"{TIME},\d{{3}} (INFO|WARNING) colmap_sph\.\S+: ", line) for line in records)


# ---- the log file ------------------------------------------------------------------------------------------


def log_in(workspace: Workspace) -> None:
    with workspace_log(workspace, "header"):
        logging.getLogger("colmap_sph.test").warning("words")


def test_a_disk_that_is_full_before_the_log_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """That is told by a record, which itself is for the log; and told once."""

    def refuse(_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(log_file._LogFile, "flush", refuse, raising=False)
    workspace = Workspace(tmp_path)
    workspace.state_dir.mkdir()
    workspace.sparse_dir.mkdir()
    log_in(workspace)
    said = [record.getMessage() for record in caplog.records]
    told = f"{workspace.log_path} cannot be written (No space left on device); the log is incomplete"
    assert sorted(said) == sorted([told, "words"])


def test_a_log_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "dense")
    workspace.state_dir.mkdir(parents=True)
    workspace.sparse_dir.mkdir()
    (tmp_path / "victim").write_text("mine")
    workspace.log_path.symlink_to(tmp_path / "victim")
    with pytest.raises(OutputError, match=r"log\.txt cannot be written"):
        log_in(workspace)
    assert (tmp_path / "victim").read_text() == "mine"


@pytest.mark.parametrize("has_reader", [True, False])
def test_a_log_that_is_a_pipe_is_refused(has_reader: bool, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    workspace.state_dir.mkdir()
    workspace.sparse_dir.mkdir()
    os.mkfifo(workspace.log_path)
    reader = os.open(workspace.log_path, os.O_RDONLY | os.O_NONBLOCK) if has_reader else None
    with pytest.raises(OutputError, match=r"log\.txt cannot be written"):
        log_in(workspace)
    if reader is not None:
        os.close(reader)


# ---- progress off the terminal -----------------------------------------------------------------------------


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


def progress_lines(
    total: int, seconds: float, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> list[str]:
    clock = Clock()
    monkeypatch.setattr(display, "time", clock)
    with Display(Terminal()) as shown:
        shown.start("match pairs", total)
        for _ in range(total):
            clock.now += seconds
            shown.advance()
    lines = capsys.readouterr().err.splitlines()
    assert all(re.match(rf"{TIME} match pairs", line) for line in lines)
    return [line[20:] for line in lines]


def test_a_long_stage_says_each_tenth(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """500 pairs of 12 seconds: 100 minutes."""
    lines = progress_lines(500, 12.0, monkeypatch, capsys)
    assert lines[0] == "match pairs (500)"
    assert lines[1] == "match pairs: 50 of 500, about 90 min left"
    assert lines[-1] == "match pairs: 450 of 500, about 10 min left"
    assert len(lines) == 10


def test_a_short_stage_says_little(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert progress_lines(500, 0.01, monkeypatch, capsys) == ["match pairs (500)"]
    lines = progress_lines(70, 1.0, monkeypatch, capsys)
    assert lines == [
        "match pairs (70)",
        "match pairs: 30 of 70, about 40 s left",
        "match pairs: 60 of 70, about 10 s left",
    ]


def test_wide_letters_keep_the_columns(capsys: pytest.CaptureFixture[str]) -> None:
    Terminal().facts([("東京.jpg", "1"), ("Ko\u0308ln.jpg", "2"), ("ab", "3")])
    assert capsys.readouterr().err.splitlines() == ["東京.jpg  1", "Ko\u0308ln.jpg  2", "ab        3"]


@pytest.mark.parametrize("variable", ["FORCE_COLOR", "CLICOLOR_FORCE", "TTY_COMPATIBLE"])
def test_files_get_no_bars_boxes_or_colours(
    variable: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(variable, "1")
    terminal = Terminal()
    with Display(terminal) as shown:
        shown.start("fuse", 1)
        shown.advance()
    terminal.table(
        "Depth maps", ["image", "coverage"], [("a.jpg", "90.0 %"), ("long name.jpg", "5.0 %")], "caption"
    )
    terminal.say("words", label="error:", style="bold red")
    said = capsys.readouterr().err.splitlines()
    assert said[1:] == [
        "Depth maps",
        "image          coverage",
        "a.jpg          90.0 %",
        "long name.jpg  5.0 %",
        "caption",
        "error: words",
    ]


# ---- narrow terminals --------------------------------------------------------------------------------------


def test_lists_break_between_their_parts() -> None:
    assert wrapped("12.5 (match pairs 10.0, vote on depth 2.0, fuse 0.5)", 24) == [
        "12.5 (match pairs 10.0,",
        "vote on depth 2.0,",
        "fuse 0.5)",
    ]
    assert wrapped("one two three four", 9) == ["one two", "three", "four"]
    path = "/data/" + "long/" * 20 + "fused.ply"
    assert wrapped(f"939,782 points in {path}", 30) == ["939,782 points in", path]
    assert wrapped("", 10) == [""]


@pytest.mark.parametrize("width", range(5, 40))
@pytest.mark.parametrize("name", ["survey/2024-05-01/left/IMG_00012.jpg", "東京" * 20, "short.jpg"])
def test_names_are_shortened_in_the_middle(name: str, width: int) -> None:
    short = shortened(name, width).plain
    assert cell_len(short) <= width or (short == name and cell_len(name) <= width)
    if short != name:
        start, end = short.split("…")
        assert cell_len(name) > width
        assert name.startswith(start) and name.endswith(end) and len(end) >= len(start)


SUMMARY = """
    from colmap_sph.app.terminal import Terminal
    terminal = Terminal()
    names = [f"survey of the village/2024-05-01/camera {side}/IMG_{number:05d}.jpg"
             for side in ("left", "right") for number in range(3)]
    terminal.table("Depth maps", ["image", "coverage", "agreement"], [(n, "90.1 %", "99.5 %") for n in names])
    terminal.facts([("seconds", "48.5 (check originals 0.1, match pairs 34.8, vote on depth 4.6, fuse 2.4)"),
                    ("cloud", "939,782 points in " + "/data/some/where" * 10 + "/fused.ply")])
"""


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_summary_fits_its_terminal(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "DRAWING", SUMMARY)
    lines = COLOURS.sub("", drawn(COLUMNS=str(width))).splitlines()
    *table, path = lines
    assert all(cell_len(line) <= width for line in table)
    images = [line.split("│")[1].strip() for line in table if "IMG" in line]
    assert [re.search(r"IMG_\d{5}\.jpg$", name) is not None for name in images] == [True] * 6
    assert path.strip() == "/data/some/where" * 10 + "/fused.ply"
    for part in ("check originals 0.1", "match pairs 34.8", "vote on depth 4.6"):
        assert any(part in line for line in table)


# ---- terminals ---------------------------------------------------------------------------------------------

DRAWING = """
    import sys
    from colmap_sph.app.display import Display
    from colmap_sph.app.terminal import Terminal
    terminal = Terminal()
    try:
        with Display(terminal) as shown:
            if "bars" in sys.argv:
                shown.start("fuse", 2)
                shown.advance()
            terminal.note(r"\\[/]\x1b]0;x\x07", label="warning:", style="yellow")
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        terminal.after_interruption()
        terminal.say("words", label="interrupted;", style="bold red")
"""


def drawn(*arguments: str, **environment: str) -> str:
    """What a terminal receives, with ^C as it shows it at the end of the last line."""
    leader, follower = os.openpty()
    env = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "NO_COLOR")}
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(DRAWING), *arguments],
        stdout=follower,
        stderr=follower,
        env={**env, "TERM": "xterm", "COLUMNS": "100", **environment},
    ):
        os.close(follower)
        received = b""
        while chunk := _read(leader):
            received += chunk
    os.close(leader)
    return received.decode().replace("\r\n", "\n")


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError as error:  # the other end is closed
        assert error.errno == errno.EIO
        return b""


COLOURS = re.compile(r"\x1b\[[\d;]*m")


@pytest.mark.parametrize("arguments", [["bars"], []])
def test_an_interruption_has_a_line_of_its_own(arguments: list[str]) -> None:
    received = drawn(*arguments)
    plain = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", received)
    before, line, after = plain.rpartition("interrupted; words\n")
    assert line and not after
    assert before.endswith("\n")
    assert r"\[/]\x1b]0;x\x07" in plain
    assert "\x07" not in received
    assert ("━" in received) == bool(arguments)
    assert received.count("\x1b[?25h") >= received.count("\x1b[?25l")  # the cursor is there again


@pytest.mark.parametrize(
    "environment", [{"TERM": "dumb"}, {"COLUMNS": "0"}, {"COLUMNS": "1"}, {"COLUMNS": "12"}], ids=str
)
def test_terminals_that_cannot_draw_get_plain_lines(environment: dict[str, str]) -> None:
    received = drawn("bars", **environment)
    assert re.search(rf"^{TIME} fuse \(2\)$", received, re.MULTILINE)
    assert received.endswith("interrupted; words\n")
    assert "\x1b" not in received


def test_no_color() -> None:
    assert COLOURS.search(drawn("bars"))
    assert not re.search(r"\x1b\[(3|9)\d", drawn("bars", NO_COLOR="1"))


# ---- streams that are closed or full -----------------------------------------------------------------------

PROGRAM = [sys.executable, "-P", "-m", "colmap_sph"]
WRONG = [*PROGRAM, "run", "--model", "nowhere"]


def close_both() -> None:
    os.close(1)
    os.close(2)


def test_nobody_reads_the_messages() -> None:
    """The exit code is that of the mistake; nothing about the stream itself."""
    read, write = os.pipe()
    os.close(read)
    assert subprocess.run(WRONG, stderr=write, timeout=60).returncode == 2
    os.close(write)
    with Path("/dev/full").open("w") as full:
        assert subprocess.run(WRONG, stderr=full, timeout=60).returncode == 2
    assert subprocess.run(WRONG, preexec_fn=close_both, timeout=60).returncode == 2


def test_a_run_without_a_reader_or_streams_is_complete(project: Path) -> None:
    """Files that are opened later do not get the number of a closed stream, and with it messages of libraries."""
    keep_images(project, ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg"])
    outputs = [project / name for name in ("a", "b")]
    command = [*PROGRAM, "run", "--model", str(project / "sparse/0"), "--num-pairs", "2", "--output"]
    read, write = os.pipe()
    os.close(read)
    assert subprocess.run([*command, str(outputs[0])], stdout=write, stderr=write, timeout=120).returncode == 0
    os.close(write)
    assert subprocess.run([*command, str(outputs[1])], preexec_fn=close_both, timeout=120).returncode == 0
    first, second = ((output / "fused.ply").read_bytes() for output in outputs)
    assert first == second


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["run", "--help"]])
def test_the_standard_output_is_full(arguments: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*PROGRAM, *arguments], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 3
    assert re.fullmatch(r"error: The standard output cannot be written \(No space .*\n", done.stderr)


@pytest.mark.parametrize(
    ("kind", "amount", "words"),
    [
        (resource.RLIMIT_NOFILE, 20, r"Only 20 files .* \(ulimit -n\)"),
        (resource.RLIMIT_AS, 300 << 20, r"only 300 MiB .* \(ulimit -v\)"),
        (resource.RLIMIT_DATA, 100 << 20, r"only 100 MiB .* \(ulimit -d\)"),
    ],
)
def test_limits_that_are_too_low_to_load(kind: int, amount: int, words: str) -> None:
    done = subprocess.run(
        WRONG,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
        preexec_fn=lambda: resource.setrlimit(kind, (amount, amount)),
    )
    assert done.returncode == 6
    assert re.fullmatch(rf"error: .*{words}\.\n", done.stderr)


def test_a_library_that_cannot_be_loaded() -> None:
    code = textwrap.dedent("""
        import sys
        class Refusing:
            def find_spec(self, name, *_):
                if name == "pycolmap":
                    try:
                        raise ImportError("libx.so: failed to map segment from shared object")
                    except ImportError as error:
                        raise ImportError("Cannot import the C++ backend") from error
        sys.meta_path.insert(0, Refusing())
        from colmap_sph.__main__ import main
        sys.exit(main())
    """)
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 6
    assert re.fullmatch(r"error: .*libx\.so: failed to map segment.*ulimit -a\)\.\n", done.stderr)


def test_a_traceback_does_not_steer_the_terminal() -> None:
    code = textwrap.dedent("""
        import sys
        from colmap_sph.app import cli
        def fail():
            raise ValueError("\\x1b]0;title\\x07\\nmore \\u202e")
        cli.main = fail
        from colmap_sph.__main__ import main
        sys.exit(main())
    """)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.startswith("Traceback")
    assert done.stderr.endswith("ValueError: \\x1b]0;title\\x07\nmore \\u202e\n")


def test_the_current_folder_is_gone(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()

    def leave() -> None:
        os.chdir(gone)
        gone.rmdir()

    done = subprocess.run(WRONG, stderr=subprocess.PIPE, text=True, timeout=60, preexec_fn=leave)
    assert done.returncode == 2
    assert re.fullmatch(r"error: The current folder cannot be used .*\n", done.stderr)


@pytest.mark.parametrize("memory", ["0", "9" * 400])
def test_amounts_of_memory_that_make_no_sense(memory: str, block, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "--model", str(block.sparse_dir), "--memory", memory]) == 2
    assert re.fullmatch(r"error: --memory must .*\n", capsys.readouterr().err)
