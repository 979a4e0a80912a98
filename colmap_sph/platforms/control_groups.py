"""What the control groups of this process leave it, under Docker, Kubernetes, Slurm, systemd: memory, processors.

A process is in one group of each hierarchy, and every ancestor of that group limits it, too: Slurm sets its limits
two or three levels above, Kubernetes at the pod. ``/proc/self/cgroup`` names the groups, ``/proc/self/mountinfo``
the folders in which the system shows them. A container may see its own group as the top of what is mounted, and be
told a path that does not exist inside; then the top is all there is to see. Version 1 has a hierarchy for each
controller, version 2 one for all, and machines that have both ("hybrid") keep a controller in either.
"""

import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

# Version 1 writes "no limit" as the largest number of whole pages, a little below 2^63.
_NO_LIMIT = 1 << 60


def free_memory(root: Path = Path("/")) -> int | None:
    """Bytes that the process's control groups have left: the least of limit - usage, over all ancestors.

    Page cache that the system gives back by itself does not count as used, swap not as memory.

    Parameters
    ----------
    root : Path
        Of the file system that has ``/proc`` and the mounted hierarchies.

    Returns
    -------
    int or None
        Not below 0; None where nothing limits it.
    """
    unified = (_free_in_unified(folder) for folder in _folders("", root))
    separate = (_free_in_separate(folder) for folder in _folders("memory", root))
    left = [amount for amount in (*unified, *separate) if amount is not None]
    return max(min(left), 0) if left else None


def processors(root: Path = Path("/")) -> int | None:
    """Processors whose time the process's control groups grant, rounded up; None where nothing limits it.

    Parameters
    ----------
    root : Path
        See `free_memory`.
    """
    unified = (_words(folder / "cpu.max") for folder in _folders("", root))
    separate = (
        _words(folder / "cpu.cfs_quota_us") + _words(folder / "cpu.cfs_period_us")
        for folder in _folders("cpu", root)
    )
    shares = [_share(words) for words in (*unified, *separate)]
    limits = [max(math.ceil(share), 1) for share in shares if share is not None]
    return min(limits, default=None)


# ---- limits of one group -----------------------------------------------------------------------------------


def _free_in_unified(folder: Path) -> int | None:
    limits = [_number(folder / name) for name in ("memory.max", "memory.high")]
    used = _number(folder / "memory.current") or 0
    return _left(limits, used, _facts(folder / "memory.stat").get("inactive_file", 0))


def _free_in_separate(folder: Path) -> int | None:
    facts = _facts(folder / "memory.stat")
    # The second knows of ancestors, too, that a container does not see.
    limits = [_number(folder / "memory.limit_in_bytes"), facts.get("hierarchical_memory_limit")]
    used = _number(folder / "memory.usage_in_bytes") or 0
    return _left(limits, used, facts.get("total_inactive_file", facts.get("inactive_file", 0)))


def _left(limits: list[int | None], used: int, reclaimable: int) -> int | None:
    known = [limit for limit in limits if limit is not None and limit < _NO_LIMIT]
    return min(known) - max(used - reclaimable, 0) if known else None


def _share(words: list[str]) -> float | None:
    """Of "QUOTA PERIOD", in microseconds; a quota of "max" or -1 is none."""
    match words:
        case [quota, period] if _is_number(quota) and _is_number(period) and int(period) > 0:
            return int(quota) / int(period)
    return None


def _number(path: Path) -> int | None:
    """The number in a file; None for "max", and where there is no such file."""
    words = _words(path)
    return int(words[0]) if words and _is_number(words[0]) else None


def _facts(path: Path) -> dict[str, int]:
    """Numbers by name, one a line."""
    words = _words(path)
    pairs = zip(words[::2], words[1::2], strict=False)
    return {name: int(value) for name, value in pairs if _is_number(value)}


def _is_number(word: str) -> bool:
    return re.fullmatch("[0-9]{1,20}", word) is not None


def _words(path: Path) -> list[str]:
    with suppress(OSError):
        return path.read_bytes().decode(errors="replace").split()
    return []


# ---- where the groups are ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Mount:
    """A hierarchy where the system shows it.

    Attributes
    ----------
    top : PurePosixPath
        Group that the mount point shows.
    point : Path
        Folder of that group.
    controllers : frozenset of str
        Of a hierarchy of version 1; {""} is that of version 2.
    """

    top: PurePosixPath
    point: Path
    controllers: frozenset[str]


def _folders(controller: str, root: Path) -> list[Path]:
    """Folders of the process's group and of its ancestors, as far as they are mounted; "" stands for version 2."""
    group = _group(controller, root)
    mounts = [mount for mount in _mounts(root) if controller in mount.controllers]
    if group is None or not mounts:
        return []
    holding = [mount for mount in mounts if group.is_relative_to(mount.top) and ".." not in group.parts]
    folders = []
    for mount in holding:
        inside = group.relative_to(mount.top)
        folders += [mount.point / each for each in (inside, *inside.parents)]
    return folders or [mounts[0].point]


def _group(controller: str, root: Path) -> PurePosixPath | None:
    """The process's group in the hierarchy of a controller."""
    for line in _lines(root / "proc/self/cgroup"):
        # Numbers, and controllers in version 1; a path may have colons.
        match line.split(":", 2):
            case [_, controllers, path] if controller in controllers.split(",") and path.startswith("/"):
                return PurePosixPath(path)
    return None


def _mounts(root: Path) -> Iterator[_Mount]:
    for line in _lines(root / "proc/self/mountinfo"):
        place, _, source = line.partition(" - ")
        match place.split(" "), source.split(" "):
            case [_, _, _, top, point, *_], ["cgroup2", *_]:
                controllers = frozenset([""])
            case [_, _, _, top, point, *_], ["cgroup", _, options, *_]:
                controllers = frozenset(options.split(",")) - {""}
            case _:
                continue
        yield _Mount(PurePosixPath(_plain(top)), root / _plain(point).lstrip("/"), controllers)


def _plain(path: str) -> str:
    r"""A path of mountinfo, in which blanks and the like are written as \040."""
    return re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), path)


def _lines(path: Path) -> list[str]:
    with suppress(OSError):
        return path.read_bytes().decode(errors="surrogateescape").split("\n")
    return []
