"""The harness of hostile inputs: the command holds, and what must not be is found where it is."""

import errno
import importlib
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import SCRIPTS

pytestmark = pytest.mark.usefixtures("scripts_on_path")


@pytest.fixture
def hostile() -> SimpleNamespace:
    """The harness's modules by their names."""
    names = ("shim", "runs", "grounds", "watch", "cases", "verdicts", "damage", "campaign", "kinds")
    return SimpleNamespace(**{name: importlib.import_module(f"hostile.{name}") for name in names})


def test_the_command_holds(tmp_path: Path) -> None:
    """A case of each kind; the script itself takes thousands."""
    done = subprocess.run(
        [sys.executable, SCRIPTS / "try_hostile_inputs.py", "--output", tmp_path / "out", "--cases", "12"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert "12 cases, 0 failed" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0


# ---- file operations ----------------------------------------------------------------------------------------

WORK = """
    import os, sys
    from pathlib import Path
    folder = Path(sys.argv[1])
    for number in range(3):
        with (folder / f"{number}.tmp").open("wb", buffering=0) as file:
            print("wrote", file.write(b"12345678"))
            os.fsync(file.fileno())
        (folder / f"{number}.tmp").rename(folder / str(number))
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled shim."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler (cc)")
    path = tmp_path_factory.mktemp("shim") / "shim.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", path, SCRIPTS / "hostile" / "shim.c", "-ldl"], check=True)
    return path


def work(hostile: SimpleNamespace, library: Path, tmp_path: Path, fault: object):
    """A process that writes three files; the control block that watches it."""
    folder = tmp_path / "watched"
    folder.mkdir()
    control = hostile.shim.Control(tmp_path / "control", folder, fault)
    code = "\n".join(line[4:] for line in WORK.splitlines())
    command = [sys.executable, "-c", f"import os\nos.setsid()\n{code}", str(folder)]
    variables = os.environ | {"LD_PRELOAD": str(library), hostile.shim.CONTROL_VARIABLE: str(control.path)}
    done = subprocess.run(command, env=variables, capture_output=True, text=True)
    return done, control.operations, sorted(path.name for path in folder.iterdir())


def test_operations_are_counted(hostile: SimpleNamespace, library: Path, tmp_path: Path) -> None:
    done, operations, files = work(hostile, library, tmp_path, None)
    assert done.returncode == 0, done.stderr
    assert files == ["0", "1", "2"]
    kinds = [operation.kind for operation in operations]
    assert [kinds.count(kind) for kind in ("open", "write", "sync", "close", "rename")] == [3] * 5
    assert [operation.path for operation in operations if operation.kind == "rename"] == ["/0", "/1", "/2"]


@pytest.mark.parametrize(
    ("kind", "first", "last", "files"),
    [
        ("open", 2, 2, ["0"]),
        ("write", 3, 9, ["0", "1", "2.tmp"]),
        ("sync", 1, 1, ["0.tmp"]),
        ("close", 2, 2, ["0", "1.tmp"]),
        ("rename", 1, 1, ["0.tmp"]),
    ],
)
def test_operations_fail(
    kind: str, first: int, last: int, files: list[str], hostile: SimpleNamespace, library: Path, tmp_path: Path
) -> None:
    fault = hostile.shim.Fault((kind,), first, last, errno.EDQUOT)
    done, operations, left = work(hostile, library, tmp_path, fault)
    assert os.strerror(errno.EDQUOT) in done.stderr
    assert left == files
    assert [operation.kind for operation in operations] == [kind]


def test_writes_are_short(hostile: SimpleNamespace, library: Path, tmp_path: Path) -> None:
    done, _, files = work(hostile, library, tmp_path, hostile.shim.Fault(("write",), 2, 2))
    assert done.stdout.split() == ["wrote", "8", "wrote", "4", "wrote", "8"]
    assert files == ["0", "1", "2"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_signal_comes_before_the_operation(
    number: signal.Signals, hostile: SimpleNamespace, library: Path, tmp_path: Path
) -> None:
    fault = hostile.shim.Fault(("rename",), 2, 2, stop=number)
    done, _, files = work(hostile, library, tmp_path, fault)
    assert done.returncode == -number
    assert files == ["0", "1.tmp"]


# ---- verdicts -----------------------------------------------------------------------------------------------


def outcome(hostile: SimpleNamespace, code: int | None = 0, *, stderr: str = "", **facts: object):
    rest = {"signal": 0, "timed_out": False, "stdout": "", "memory": 0, "seconds": 1.0}
    return hostile.runs.Outcome(code=code, stderr=stderr, **(rest | facts))


@pytest.mark.parametrize(
    ("facts", "verdict"),
    [
        ({"code": None, "signal": 6}, "crash"),
        ({"code": None, "timed_out": True}, "hang"),
        ({"code": 1, "stderr": "error: x"}, "exit code"),
        ({"code": 2}, "no word"),
        ({"stderr": "Traceback (most recent call last):\nValueError"}, "traceback"),
        ({"stderr": "x.py:1: RuntimeWarning: invalid value"}, "warning of a library"),
        ({"stdout": "a\x1b[31mb"}, "control characters"),
        ({"stderr": "a\x9bb"}, "control characters"),
        ({"memory": 2 << 30}, "memory"),
        ({"code": 5, "stderr": "image skipped: a"}, None),
        ({}, None),
    ],
)
def test_verdicts_on_a_run(facts: dict, verdict: str | None, hostile: SimpleNamespace, tmp_path: Path) -> None:
    case = hostile.cases.Case("", ())
    grounds = hostile.grounds.Grounds(tmp_path, {}, {})
    found = hostile.verdicts.judge(case, outcome(hostile, **facts), grounds, {}, {})
    assert [finding.verdict for finding in found] == ([] if verdict is None else [verdict])


def test_verdicts_on_files(hostile: SimpleNamespace, tmp_path: Path) -> None:
    """What is beside the workspace, and of the user's in it, stays; a copy beside will do."""
    dense = tmp_path / "dense"
    dense.mkdir()
    for name in ("beside.txt", "dense/mine.txt", "dense/moved.txt", "dense/ours.bin"):
        (tmp_path / name).write_text(name)
    (tmp_path / "link").symlink_to("beside.txt")
    before = hostile.watch.snapshot(tmp_path)
    for path in (tmp_path / "beside.txt", dense / "mine.txt", dense / "ours.bin"):
        path.write_text("other")
    (dense / "moved.txt").rename(dense / "moved.txt.old")
    (dense / "new.txt").touch()
    (tmp_path / "new.txt").touch()
    (tmp_path / "link").unlink()
    case = hostile.cases.Case("", (), dense, (dense / "mine.txt", dense / "moved.txt"))
    grounds = hostile.grounds.Grounds(tmp_path, {}, {})
    found = hostile.verdicts.judge(
        case, outcome(hostile, 3, stderr="x"), grounds, before, hostile.watch.snapshot(tmp_path)
    )
    assert [(finding.verdict, finding.facts.removeprefix(f"{tmp_path}/")) for finding in found] == [
        ("written outside", "beside.txt was changed"),
        ("user's file lost", "dense/mine.txt was changed"),
        ("written outside", "link was removed"),
        ("written outside", "new.txt was made"),
    ]


@pytest.mark.parametrize(
    ("factor", "share", "whole", "said", "verdict"),
    [
        (1.0, 1.0, True, "", None),
        (1.05, 0.3, True, "", "quietly wrong"),
        (1.05, 0.3, False, "", None),
        (np.nan, 0.6, False, "", "quietly wrong"),
        (1.05, 0.6, False, "warning: it does not fit", None),
        (1.05, 0.6, True, "warning: it does not fit", "quietly wrong"),
        (0.0, 0.7, True, "", "quietly wrong"),
    ],
)
def test_verdicts_on_depth(
    factor: float,
    share: float,
    whole: bool,
    said: str,
    verdict: str | None,
    hostile: SimpleNamespace,
    tmp_path: Path,
) -> None:
    """A share of an image's depths is multiplied by a factor."""
    truth = np.full((10, 20), 5, np.float32)
    depth = truth.copy()
    depth[:, : round(20 * share)] *= factor
    path = hostile.grounds.depth_path(tmp_path, "a.png")
    path.parent.mkdir(parents=True)
    path.write_bytes(b"20&10&1&" + depth.tobytes())
    clean = hostile.grounds.Score(coverage=1.0, bad=0.0)
    grounds = hostile.grounds.Grounds(tmp_path, {("plain", "b"): truth}, {}, {("plain", "b"): clean})
    case = hostile.cases.Case("", (), tmp_path, names={"a.png": "b"}, whole=whole, in_place=False)
    found = hostile.verdicts.judge(case, outcome(hostile, stderr=said), grounds, {}, {})
    assert [finding.verdict for finding in found] == ([] if verdict is None else [verdict])


def test_verdicts_on_reruns(hostile: SimpleNamespace, tmp_path: Path) -> None:
    for name in ("found", "right"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "fused.ply").write_bytes(b"1")
    case = hostile.cases.Case("", (), tmp_path / "found", same_as=tmp_path / "right")
    assert hostile.verdicts.judge_rerun(case, outcome(hostile)) == []
    assert hostile.verdicts.judge_rerun(case, outcome(hostile, 5))[0].verdict == "not mended by a rerun"
    (tmp_path / "found" / "fused.ply").write_bytes(b"2")
    assert "fused.ply" in hostile.verdicts.judge_rerun(case, outcome(hostile))[0].facts


def test_every_kind_is_drawn_and_repeated(hostile: SimpleNamespace) -> None:
    assert {hostile.kinds.kind_of(number) for number in range(20)} == set(hostile.kinds.KINDS)
    damaged = [hostile.damage.damage_bytes(bytes(range(200)), np.random.default_rng(5)) for _ in range(2)]
    assert damaged[0] == damaged[1]
