"""The compiled shim and its control block: which file operation of a process fails, or ends it: ``shim.c``."""

import ctypes
import errno
import mmap
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

KINDS = ("open", "read", "write", "close", "sync", "rename", "remove", "make", "resize", "map", "list")
CONTROL_VARIABLE = "HOSTILE_CONTROL"

_ROOM = 4096
_COUNT, _FAIL, _SHORTEN, _STOP = range(4)


class _Block(ctypes.Structure):
    _fields_ = (
        ("kinds", ctypes.c_uint32),
        ("action", ctypes.c_uint32),
        ("first", ctypes.c_uint64),
        ("last", ctypes.c_uint64),
        ("value", ctypes.c_int32),
        ("process", ctypes.c_int32),
        ("counted", ctypes.c_uint64),
        ("hit", ctypes.c_uint64),
        ("prefix", ctypes.c_char * _ROOM),
        ("log", ctypes.c_char * _ROOM),
    )


@dataclass(frozen=True)
class Fault:
    """What happens to some of a process's file operations.

    Attributes
    ----------
    kinds : tuple of str
        Which operations count, see `KINDS`.
    first, last : int
        Numbers of the operations that are spoilt, from 1.
    code : int
        The error they end in; 0: reads and writes move only half of what they should.
    stop : int
        Signal that the process gets before the first of them instead; 0: none.
    """

    kinds: tuple[str, ...]
    first: int
    last: int
    code: int = 0
    stop: int = 0

    def __str__(self) -> str:
        span = f"{self.first}" if self.last == self.first else f"{self.first} and on"
        what = f"signal {self.stop}" if self.stop else errno.errorcode.get(self.code, "half of it")
        return f"{what} at {'/'.join(self.kinds) if self.kinds != KINDS else 'operation'} {span}"


@dataclass(frozen=True)
class Operation:
    """A file operation that was counted: its kind, and its path below the watched folder."""

    kind: str
    path: str


def arm(control: Path) -> None:
    """Watch the file operations of this process, into which the shim was loaded as it started."""
    ctypes.CDLL(None).hostile_arm(str(control).encode())


class Control:
    """The control block of one run.

    Parameters
    ----------
    path : Path
        File for the block; must lie outside of `watched`.
    watched : Path
        Folder below which operations count.
    fault : Fault, optional
        None: all operations are counted and noted, none is spoilt.
    only_main : bool
        A signal goes to the run's first process alone, not to those that it has started, too.
    """

    def __init__(self, path: Path, watched: Path, fault: Fault | None, *, only_main: bool = False) -> None:
        self.path = path
        self._only_main = only_main
        self._watched = str(watched)
        self._log = path.with_suffix(".log")
        self._log.unlink(missing_ok=True)
        block = _Block()
        kinds: Iterable[str] = KINDS if fault is None else fault.kinds
        block.kinds = sum(1 << KINDS.index(kind) for kind in kinds)
        block.prefix = self._watched.encode()
        block.log = str(self._log).encode()
        if fault is not None:
            block.action = _STOP if fault.stop else _FAIL if fault.code else _SHORTEN
            block.first = fault.first
            block.last = fault.last
            block.value = fault.stop or fault.code
        path.write_bytes(bytes(block))

    def aim_at(self, process: int) -> None:
        """Name the run's first process, which leads its group."""
        target = process if self._only_main else -process
        with self.path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as memory:
            memory[_Block.process.offset : _Block.process.offset + 4] = target.to_bytes(
                4, sys.byteorder, signed=True
            )

    @property
    def operations(self) -> list[Operation]:
        """What was counted; with a fault, what was spoilt."""
        if not self._log.exists():
            return []
        lines = self._log.read_text(errors="replace").splitlines()
        words = (line.removeprefix("! ").partition(" ") for line in lines)
        return [Operation(kind, path.removeprefix(self._watched)) for kind, _, path in words if kind in KINDS]


def load_shim(folder: Path) -> Path:
    """Start this process again with the shim in it, unless it is there; returns the library.

    Parameters
    ----------
    folder : Path
        Folder of this process's own for the library; one that exists must be of an earlier such process, and is
        removed.
    """
    library = folder.resolve() / "shim.so"
    if os.environ.get("LD_PRELOAD") != str(library):
        _start_again(folder, library)
    return library


def _start_again(folder: Path, library: Path) -> NoReturn:
    if folder.exists() and not library.exists() and any(folder.iterdir()):
        sys.exit(f"error: {folder} holds something else; choose another --output.")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    source = Path(__file__).with_suffix(".c")
    command = ["cc", "-shared", "-fPIC", "-O1", "-U_FORTIFY_SOURCE", "-o", str(library), str(source), "-ldl"]
    subprocess.run(command, check=True)
    # Without threads of linear algebra, as a process with threads cannot be forked.
    variables = os.environ | {"LD_PRELOAD": str(library), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    os.execve(sys.executable, [sys.executable, *sys.argv], variables)
