"""The program's entry: the command line, once it is loaded, which takes a second or so."""

import gc
import os
import signal
import sys
from contextlib import suppress
from types import FrameType, TracebackType

import colmap_sph
from colmap_sph.app.colmap.names import hand_over, is_handed_over
from colmap_sph.app.standard_streams import prepare_process, silence, standard_output
from colmap_sph.errors import InputError, OutOfMemoryError, OutputError, printable, reason_of
from colmap_sph.platforms.processes import held_back

# What loaders and libraries say where the system refuses memory, threads or open files.
_REFUSALS = (
    "allocate memory",
    "out of memory",
    "map segment",
    "start new thread",
    "too many open files",
    "temporarily unavailable",
)


def main() -> int:
    """Run the command line; an interruption while it loads ends without a traceback, too."""
    problem = prepare_process()
    if problem is not None:
        print(f"error: {problem}", file=sys.stderr)
        return OutOfMemoryError.exit_code
    sys.excepthook = _print_traceback
    try:
        return _command()
    except BrokenPipeError:  # whoever reads the output has closed it, as `| head` does
        silence(1)
        return 141
    except KeyboardInterrupt:
        if sys.stderr.isatty():  # which shows ^C
            print(file=sys.stderr)
        print("interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        reason = _refusal(error)
        if reason is None:
            raise
        print(
            f"error: The system refuses what the program needs to load ({reason}); end other programs, or allow "
            "more (ulimit -a).",
            file=sys.stderr,
        )
        return OutOfMemoryError.exit_code


def _command() -> int:
    if is_handed_over(sys.argv[1:]):
        with suppress(InputError):  # said below
            hand_over(sys.argv[1:])
    is_version = sys.argv[1:2] in (["--version"], ["-V"])  # for which nothing is loaded
    code = 0 if is_version else _answer()
    try:
        with standard_output():
            if is_version:
                print(f"colmap_sph {colmap_sph.__version__}")
            sys.stdout.flush()
    except OutputError as error:
        silence(1)
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return code


def _answer() -> int:
    """Load the command line, and have it do what is asked for."""
    # NumPy's linear algebra, loaded below, would spin on all cores for products of a few columns.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.disable()  # what is loaded stays: nothing to be found
    _load_colmap()
    from colmap_sph.app import cli

    gc.freeze()  # nor while the command runs
    gc.enable()
    try:
        return cli.main()
    except SystemExit as stop:  # the parser, after help or a mistake
        return 0 if stop.code is None else stop.code if isinstance(stop.code, int) else 2
    finally:
        gc.unfreeze()  # or libraries would say on leaving that objects of theirs are left


def _load_colmap() -> None:
    """Load COLMAP's library, and let SIGTERM end the program quietly: the library would print its stack."""
    is_ignored = signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    end = signal.SIG_IGN if is_ignored else _end_quietly
    signal.signal(signal.SIGTERM, end)
    with held_back(signal.SIGTERM):
        try:
            import colmap_sph.project.colmap_library  # noqa: F401
        finally:
            signal.signal(signal.SIGTERM, end)  # in the place of the library's


def _end_quietly(number: int, _: FrameType | None) -> None:
    os._exit(128 + number)


def _refusal(error: BaseException) -> str | None:
    """Say how the system has refused memory, threads or open files while libraries were loaded, if it has."""
    cause = error.__cause__ or error.__context__
    deeper = None if cause is None else _refusal(cause)
    reason = printable(reason_of(error))
    is_one = isinstance(error, (ImportError, OSError, RuntimeError)) and any(
        each in reason.lower() for each in _REFUSALS
    )
    return deeper or (reason if is_one or isinstance(error, MemoryError) else None)


def _print_traceback(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    import traceback

    for line in "".join(traceback.format_exception(kind, error, trace)).splitlines():
        print(printable(line), file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
