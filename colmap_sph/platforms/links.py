"""One place that shows what is at another: a link where the system allows it, else what comes next to one."""

import os
import shutil
import sys
from contextlib import suppress
from pathlib import Path


def link(place: Path, target: Path, *, seen_from: Path | None = None) -> None:
    """Let a new place show a file or a folder.

    By a relative symbolic link, so that both can be moved together. Windows allows them to administrators and in
    its developer mode only: there a folder is a junction, which does not survive a move, and a file has a second
    name, or is copied to another disk. Where a system has no junctions either, the files of a folder are so.

    Parameters
    ----------
    place : Path
        Where nothing is.
    target : Path
        Exists.
    seen_from : Path, optional
        Folder in which `place` will be later, from which the link is to lead to its target.

    Raises
    ------
    OSError
        Something is at `place`, or nothing can be written there.
    """
    if symbolic_link(place, target, seen_from=seen_from):
        return
    source = Path(os.path.realpath(target))
    if source.is_dir():
        _link_folder(place, source)
    else:
        _second_name(source, place)


def symbolic_link(place: Path, target: Path, *, seen_from: Path | None = None) -> bool:
    """The first of the ways of `link`, also to what is not there yet; False where the system refuses it."""
    source = Path(os.path.realpath(target))
    folder = place.parent if seen_from is None else seen_from
    try:
        place.symlink_to(_relative(source, folder), target_is_directory=source.is_dir())
    except (FileExistsError, FileNotFoundError):
        raise
    except (OSError, NotImplementedError):
        return False
    return True


def _relative(target: Path, folder: Path) -> str:
    try:
        return os.path.relpath(target, os.path.realpath(folder))
    except ValueError:  # on another drive of Windows
        return str(target)


def _link_folder(place: Path, target: Path) -> None:
    if sys.platform == "win32":
        import _winapi

        with suppress(OSError):  # the file system has none; then an empty folder is left there
            _winapi.CreateJunction(str(target), str(place))
            return
    shutil.copytree(target, place, copy_function=_second_name, dirs_exist_ok=True)


def _second_name(source: str | Path, place: str | Path) -> None:
    try:
        os.link(source, place)
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):  # another disk, or one that knows one name only
        with Path(source).open("rb") as content, Path(place).open("xb") as copy:
            shutil.copyfileobj(content, copy)
