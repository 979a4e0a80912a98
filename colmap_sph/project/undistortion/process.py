"""A child process in which COLMAP undistorts: what ends it there is one image that failed.

COLMAP's library ends the process where it finds a disk full while it writes a JPEG, and at other input that its
authors thought impossible.
"""

import os
import pickle
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import IO, Any

from colmap_sph.errors import ColmapSphError, InputError, OutputError, reason_of
from colmap_sph.platforms.processes import apart

# What libjpeg says when it ends a process.
_DISK_FULL = "Output file write error"
# How COLMAP's library begins a message that ends a process.
_FATAL = re.compile(r"^F\d{8} [^\]]*\] (.*)$", re.MULTILINE)
_MAX_WORDS = 200
# What tells programs of all systems where temporary files go.
_TEMPORARY = ("TMPDIR", "TEMP", "TMP")


class ChildProcess:
    """Calls functions in a process of its own, one after the other.

    It is started with the first call, or before, and again after it was lost.

    Parameters
    ----------
    folder : Path
        Exists at the first call, and is thrown away later: there the process leaves what it has to say, and its
        library what else.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self._words: IO[bytes] | None = None

    def start_for(self, function: Callable[[Any], None]) -> None:
        """Start the process now that a function will be called later: meanwhile it loads what that needs."""
        if self._process is None:
            with suppress(OutputError, OSError):  # the call will say it
                self._start(function.__module__)

    def call(self, function: Callable[[Any], None], argument: object, what: str) -> None:
        """Call a function of a module with one argument that can be pickled.

        Parameters
        ----------
        function : callable
        argument : object
        what : str
            What is done, for the message if it ends the process.

        Raises
        ------
        ColmapSphError
            What the function raises; `InputError` where it ended the process, `OutputError` where it said that it
            cannot write.
        """
        process = self._process or self._start(function.__module__)
        try:
            assert process.stdin is not None and process.stdout is not None
            pickle.dump((function, argument), process.stdin)
            process.stdin.flush()
            error = pickle.load(process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):  # Windows calls a broken pipe an invalid argument
            raise self._epitaph(process, what) from None
        if error is not None:
            raise error

    def close(self) -> None:
        """End the process: without more to do it goes by itself."""
        if self._process is not None:
            for stream in (self._process.stdin, self._process.stdout):
                assert stream is not None
                with suppress(OSError):
                    stream.close()
            self._process.wait()
            self._process = None
        if self._words is not None:
            self._words.close()
            self._words = None

    def _start(self, module: str) -> subprocess.Popen[bytes]:
        # By name, not by a module of the folder that the user happens to be in.
        program = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; serve({module!r})"
        folder = self.folder if self.folder.is_dir() else None
        self._words = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (closed with the process)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", program],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._words,
                env=os.environ | dict.fromkeys(_TEMPORARY, str(self.folder)),
                **apart(),  # Ctrl-C is for this process, which then ends the other
            )
        except OSError as error:
            raise OutputError(f"A process for COLMAP cannot be started ({reason_of(error)}).") from error
        return self._process

    def _epitaph(self, process: subprocess.Popen[bytes], what: str) -> ColmapSphError:
        assert self._words is not None
        code = process.wait()
        self._words.seek(0)
        words = self._words.read().decode(errors="replace")
        self.close()
        if _DISK_FULL in words:
            return OutputError(f"{what} cannot be written (the disk is full, or a limit is reached).")
        ended = f"by signal {-code}" if code < 0 else f"with exit code {code}"
        last = _last_words(words)
        return InputError(f"COLMAP ended {ended} at {what}{f' ({last})' if last else ''}.")


def _last_words(text: str) -> str:
    """Why a process ended: what COLMAP's library says before its stack trace, or else the last line."""
    fatal = _FATAL.search(text)
    lines = [line.strip() for line in text.split("\n") if line.strip()]
    return (fatal.group(1) if fatal else lines[-1] if lines else "")[:_MAX_WORDS]


def serve(module: str) -> None:
    """Load a module, and do what the other process asks for, until it asks no more."""
    # What libraries print must not come between the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    requests = sys.stdin.buffer
    import_module(module)
    while True:
        try:
            function, argument = pickle.load(requests)
        except EOFError:
            sys.stderr.flush()
            os._exit(0)  # the other process waits: Python would take a while to unload COLMAP's library
        error: Exception | None = None
        try:
            function(argument)
        except (ColmapSphError, OSError, MemoryError) as raised:
            error = raised
        pickle.dump(error, answers)
        answers.flush()
