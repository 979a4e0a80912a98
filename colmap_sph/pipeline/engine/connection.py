"""From what the user typed as --scheduler to Dask's client; and what is wrong with either, in one sentence."""

import logging
import re
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path

import distributed
import msgspec

import colmap_sph
from colmap_sph.errors import InputError, OptionError, reason_of
from colmap_sph.project.files import read_small
from colmap_sph.project.state.typed import from_json

logger = logging.getLogger(__name__)

START_SECONDS = 20.0
"""That a scheduler which has just been started is waited for."""

_FILE_BYTES = 1 << 20
_ADDRESS = re.compile(r"(?:[a-z]+://)?[^/\s]+:\d{1,5}")


class _SchedulerFile(msgspec.Struct):
    """What Dask writes for those who are to find a scheduler, as far as it counts."""

    address: str


def is_address(text: str) -> bool:
    """Whether --scheduler names an address, and not a file.

    Examples
    --------
    >>> is_address("tcp://10.0.0.1:8786"), is_address("node7:8786"), is_address("scheduler.json")
    (True, True, False)
    """
    return "://" in text or (_ADDRESS.fullmatch(text) is not None and not Path(text).exists())


def address_of(text: str, seconds: float) -> str:
    """Address of the scheduler; a file that is not there yet is waited for.

    Raises
    ------
    OptionError
        The file is not there, or not one of Dask's.
    """
    if is_address(text):
        return text
    path = Path(text)
    deadline = time.monotonic() + seconds
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.2)
    try:
        return from_json(read_small(path, _FILE_BYTES), _SchedulerFile).address
    except OSError as error:
        raise OptionError(
            f"scheduler: {path} cannot be read ({reason_of(error)}); start the scheduler with dask scheduler "
            f"--scheduler-file {path}, or give its address.",
            "scheduler",
        ) from error
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise OptionError(
            f"scheduler: {path} was not written by dask scheduler --scheduler-file ({reason_of(error)}).",
            "scheduler",
        ) from error


@contextmanager
def connected(text: str) -> Iterator[distributed.Client]:
    """A client of the scheduler that --scheduler names.

    Raises
    ------
    OptionError
        It does not answer.
    InputError
        It is in an environment without this program.
    """
    address = address_of(text, START_SECONDS)
    _quieten()
    try:
        with warnings.catch_warnings(action="ignore"):  # of versions that differ: our own check tells which matter
            client = distributed.Client(address, timeout=START_SECONDS, set_as_default=False, name="colmap_sph")
    except (OSError, ValueError, TypeError) as error:
        raise OptionError(
            f"scheduler: no Dask scheduler answers at {address} ({reason_of(error)}); start it first.", "scheduler"
        ) from error
    try:
        _check_scheduler(client, address)
        yield client
    finally:
        client.close(timeout=2)


def _check_scheduler(client: distributed.Client, address: str) -> None:
    """The scheduler unpacks what it passes on, and so needs this program, too."""
    try:
        version = client.run_on_scheduler(metadata.version, "colmap_sph")
    except metadata.PackageNotFoundError:
        version = "none"
    if version != colmap_sph.__version__:
        raise InputError(
            f"The scheduler at {address} runs with colmap_sph {version}, not {colmap_sph.__version__}; "
            "start it and its workers from the same installation as this program."
        )


def _quieten() -> None:
    """Have Dask say nothing itself: what matters to the user, our own messages say."""
    for name in ("distributed", "distributed.client", "tornado", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def dashboard_of(client: distributed.Client) -> str:
    """Link to the scheduler's page, if it has one."""
    try:
        return str(client.dashboard_link or "")
    except (KeyError, ValueError, OSError):
        return ""
