"""The log file of a workspace: everything the package logs, from the moment the workspace exists."""

import errno
import io
import logging
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from colmap_sph.errors import ColmapSphError, OutputError, printable, reason_of, unwritable
from colmap_sph.platforms.files import open_descriptor
from colmap_sph.project.files import make_dir
from colmap_sph.project.workspace import Workspace

logger = logging.getLogger(__name__)


class _OneLine(logging.Formatter):
    """One line for each record, whatever names are in it; the lines of a traceback are indented."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Put a record into one line."""
        return printable(super().formatMessage(record))

    def formatException(self, info: Any) -> str:
        """Indent a traceback: no name in it may look like a record."""
        return "\n".join(f"  {printable(line)}" for line in super().formatException(info).splitlines())


class _LogFile(logging.FileHandler):
    """A file whose disk may fill up: that is said once, and the run does not end for its log."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, encoding="utf-8", errors="backslashreplace")
        self.setFormatter(_OneLine())
        self._has_failed = False

    def _open(self) -> io.TextIOWrapper:
        """Open a file, but no link, and without waiting for the reader of a pipe."""
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
        descriptor = open_descriptor(Path(self.baseFilename), flags, follow=False)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise OSError(errno.EINVAL, "it is no ordinary file")
        return open(descriptor, "a", encoding=self.encoding, errors=self.errors, newline="\n")  # noqa: PTH123

    def handleError(self, record: logging.LogRecord) -> None:
        """Instead of a traceback on the terminal."""
        if not self._has_failed:
            self._has_failed = True
            logger.warning(
                "%s cannot be written (%s); the log is incomplete", self.baseFilename, reason_of(sys.exception())
            )

    def close(self) -> None:
        """Close the file; what is buffered on a full disk is lost."""
        with suppress(OSError):
            super().close()


class _WorkspaceLog(logging.Handler):
    """Keeps records until the workspace is complete, then appends them to a log in it.

    So a run that ends before, for want of a model or a writable folder, leaves nothing behind.
    """

    def __init__(self, workspace: Workspace, header: str, path: Path) -> None:
        super().__init__(logging.INFO)
        self._workspace = workspace
        self._path = path
        self._file: logging.FileHandler | None = None
        first = {"name": __name__, "levelno": logging.INFO, "levelname": "INFO", "msg": header}
        self._early = [logging.makeLogRecord(first)]

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or keep it for later."""
        if self._file is None and self._workspace.state_dir.is_dir() and self._workspace.sparse_dir.is_dir():
            self._file = self._open()
            # Not before: where the disk is full, that is told by a record, which comes here again.
            for each in self._early:
                self._file.emit(each)
        if self._file is None:
            self._early.append(record)
        else:
            self._file.emit(record)

    def _open(self) -> logging.FileHandler:
        path = self._path
        make_dir(path.parent)
        if path.exists() and not path.is_file():
            raise OutputError(f"{path} cannot be written: it is not a regular file; remove it.")
        try:
            return _LogFile(path)
        except OSError as error:
            raise unwritable(path, error) from error

    def flush(self) -> None:
        """Write what is buffered."""
        if self._file is not None:
            self._file.flush()

    def close(self) -> None:
        """Close the file, if there is one."""
        if self._file is not None:
            self._file.close()
        super().close()


@contextmanager
def workspace_log(workspace: Workspace, header: str, part: str = "") -> Iterator[None]:
    """Append all that the package logs, and the error that ends it, to ``colmap_sph/log.txt`` in the workspace.

    Parameters
    ----------
    workspace : Workspace
        May not exist yet; what is logged until it does is written then.
    header : str
        First line.
    part : str
        Which of several jobs in the workspace it is, where it is one: its log goes to ``colmap_sph/logs``.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    package = logging.getLogger("colmap_sph")
    path = workspace.part_log_path(part) if part else workspace.log_path
    handler = _WorkspaceLog(workspace, header, path)
    package.addHandler(handler)
    try:
        yield
    except KeyboardInterrupt:
        logger.info("Interrupted")
        raise
    except (ColmapSphError, OSError, MemoryError) as error:  # told in a sentence, see `cli`
        logger.info("Stopped: %s", error)
        raise
    except BaseException:
        logger.info("Stopped", exc_info=True)
        raise
    finally:
        package.removeHandler(handler)
        handler.close()
