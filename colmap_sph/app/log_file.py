"""The log file of a workspace: everything the package logs, from the moment the workspace exists."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from colmap_sph.errors import OutputError, reason_of
from colmap_sph.project.workspace import Workspace

logger = logging.getLogger(__name__)


class _LogFile(logging.FileHandler):
    """A file whose disk may fill up: that is said once, and the run does not end for its log."""

    def __init__(self, path: Path, encoding: str) -> None:
        super().__init__(path, encoding=encoding)
        self._has_failed = False

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
    """Keeps records until the workspace is complete, then appends them to ``colmap_sph/log.txt`` in it.

    So a run that ends before, for want of a model or a writable folder, leaves nothing behind.
    """

    def __init__(self, workspace: Workspace, header: str) -> None:
        super().__init__(logging.INFO)
        self._workspace = workspace
        self._file: logging.FileHandler | None = None
        first = {"name": __name__, "levelno": logging.INFO, "levelname": "INFO", "msg": header}
        self._early = [logging.makeLogRecord(first)]

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or keep it for later."""
        if self._file is None and self._workspace.state_dir.is_dir() and self._workspace.sparse_dir.is_dir():
            self._file = self._open()
        if self._file is None:
            self._early.append(record)
        else:
            self._file.emit(record)

    def _open(self) -> logging.FileHandler:
        path = self._workspace.log_path
        if path.exists() and not path.is_file():
            raise OutputError(f"{path} cannot be written: it is not a regular file; remove it.")
        try:
            file = _LogFile(path, encoding="utf-8")
        except OSError as error:
            raise OutputError(
                f"{path} cannot be written ({reason_of(error)}); check space and permissions."
            ) from error
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        for record in self._early:
            file.emit(record)
        return file

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
def workspace_log(workspace: Workspace, header: str) -> Iterator[None]:
    """Append all that the package logs, and the error that ends it, to ``colmap_sph/log.txt`` in the workspace.

    Parameters
    ----------
    workspace : Workspace
        May not exist yet; what is logged until it does is written then.
    header : str
        First line.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    package = logging.getLogger("colmap_sph")
    handler = _WorkspaceLog(workspace, header)
    package.addHandler(handler)
    try:
        yield
    except KeyboardInterrupt:
        logger.info("Interrupted")
        raise
    except BaseException:
        logger.info("Stopped", exc_info=True)
        raise
    finally:
        package.removeHandler(handler)
        handler.close()
