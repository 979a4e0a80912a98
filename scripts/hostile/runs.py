"""The command, run under watch: in a forked child of this process, which has loaded all of it, or as it is typed.

A fork starts in a hundredth of a second, where a new process takes two to load. Only a process without threads
may be forked, so what calls OpenCV or COLMAP before a run does so in a fork of its own (`apart`).
"""

import ctypes
import os
import pickle
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pycolmap

from hostile.shim import CONTROL_VARIABLE, Control, arm

Value = TypeVar("Value")

# What lets the superuser read and write all files, whatever their rights: of linux/capability.h.
_OVER_RIGHTS = 1 << 1 | 1 << 2 | 1 << 3
_CAPABILITY_VERSION = 0x20080522
_ADDRESS_SPACE = 16 << 30
_FILE_SIZE = 4 << 30


@dataclass(frozen=True)
class Surroundings:
    """How a run is started, and what it is kept to.

    Attributes
    ----------
    folder : Path
        For what it prints, its home and its temporary files; also where it runs. Must exist.
    seconds : float
        A run that takes longer is ended.
    typed : bool
        As a process of its own, as a user starts it.
    control : Control, optional
        Of the shim, which this process must have been started with.
    as_user : bool
        Without the superuser's rights to all files; not where it is `typed`, as a new process gets them again.
    """

    folder: Path
    seconds: float = 60.0
    typed: bool = False
    control: Control | None = None
    as_user: bool = False


@dataclass(frozen=True)
class Outcome:
    """What came of a run: exit code or signal, what it printed, its peak memory in bytes, and its time."""

    code: int | None
    signal: int
    timed_out: bool
    stdout: str
    stderr: str
    memory: int
    seconds: float

    def __str__(self) -> str:
        end = "hung" if self.timed_out else f"signal {self.signal}" if self.signal else f"exit code {self.code}"
        lines = self.stderr.strip().splitlines()
        return f"{end}, {self.seconds:.1f} s, {self.memory >> 20} MiB: {lines[-1] if lines else ''}"


def command_line(arguments: list[str]) -> list[str]:
    """The command as it is typed."""
    return [sys.executable, "-P", "-m", "colmap_sph", *arguments]


def run(arguments: list[str], around: Surroundings) -> Outcome:
    """Run the command with some arguments."""
    if len(list(Path("/proc/self/task").iterdir())) > 1:
        raise RuntimeError("a process with threads cannot be forked")
    for name in ("home", "tmp", "cwd"):
        (around.folder / name).mkdir(exist_ok=True)
    sys.stdout.flush()
    start = time.monotonic()
    process = os.fork()
    if process == 0:
        try:
            _become_the_run(arguments, around)
        finally:
            os._exit(99)
    if around.control is not None:
        around.control.aim_at(process)
    timed_out, status, memory = _wait(process, start + around.seconds)
    stdout, stderr = (_text(around.folder / name) for name in ("stdout.txt", "stderr.txt"))
    code = os.waitstatus_to_exitcode(status)
    died = -code if code < 0 and not timed_out else 0
    return Outcome(code if code >= 0 else None, died, timed_out, stdout, stderr, memory, time.monotonic() - start)


def end_group(around: Surroundings) -> None:
    """End what runs in the surroundings have started and left behind."""
    path = around.folder / "process.txt"
    with suppress(OSError, ValueError):  # none is left
        os.killpg(int(path.read_text()), signal.SIGKILL)


def apart(work: Callable[[], Value]) -> Value:
    """Call in a forked process and return what it returns; its threads and its crashes stay there."""
    receiver, sender = os.pipe()
    sys.stdout.flush()
    process = os.fork()
    if process == 0:
        code = 1
        try:
            os.close(receiver)
            pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)  # the run's own words are in files
            with os.fdopen(sender, "wb") as file:
                file.write(pickle.dumps(work()))
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    os.close(sender)
    with os.fdopen(receiver, "rb") as file:
        data = file.read()
    _, status = os.waitpid(process, 0)
    if status != 0:
        raise RuntimeError(f"the harness itself failed: status {os.waitstatus_to_exitcode(status)}")
    result: Value = pickle.loads(data)
    return result


def _wait(process: int, limit: float) -> tuple[bool, int, int]:
    """Whether it had to be ended, its status, its peak memory in bytes."""
    timed_out = False
    pause = 0.005
    while True:
        found, status, usage = os.wait4(process, os.WNOHANG)
        if found:
            return timed_out, status, usage.ru_maxrss * 1024
        if time.monotonic() > limit and not timed_out:
            timed_out = True
            os.killpg(process, signal.SIGKILL)
        time.sleep(pause)
        pause = min(0.05, pause * 1.2)


def _text(path: Path) -> str:
    return path.read_bytes().decode(errors="backslashreplace")


def _become_the_run(arguments: list[str], around: Surroundings) -> None:
    os.setsid()
    (around.folder / "process.txt").write_text(str(os.getpid()))
    for number, name in ((1, "stdout.txt"), (2, "stderr.txt")):
        os.dup2(os.open(around.folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for name in ("home", "tmp"):
        os.environ[{"home": "HOME", "tmp": "TMPDIR"}[name]] = str(around.folder / name)
    os.chdir(around.folder / "cwd")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_FILE_SIZE, _FILE_SIZE))
    if around.as_user:
        _drop_rights()
    if around.control is not None:
        os.environ[CONTROL_VARIABLE] = str(around.control.path)
    if around.typed:
        os.execve(sys.executable, command_line(arguments), os.environ)
    if around.control is not None:
        arm(around.control.path)
    os._exit(_in_this_process(arguments))


def _drop_rights() -> None:
    head = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0)
    # Effective, permitted and inheritable ones, of which those of files are in the first half.
    sets = (ctypes.c_uint32 * 6)()
    library = ctypes.CDLL(None, use_errno=True)
    library.capget(head, sets)
    for place in range(3):
        sets[place] &= ~_OVER_RIGHTS
    if library.capset(head, sets):
        raise OSError(ctypes.get_errno(), "the superuser's rights cannot be dropped")


def _in_this_process(arguments: list[str]) -> int:
    """What the interpreter does with the command; returns its exit code."""
    from colmap_sph.__main__ import main

    sys.argv = ["colmap_sph", *arguments]
    try:
        code = main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        code = 1
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    return code
