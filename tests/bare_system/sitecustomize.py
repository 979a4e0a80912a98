"""Linux made as poor as Windows: loaded by any Python that has this folder in its PYTHONPATH, before all else.

What Windows lacks is taken away, and what it refuses is refused: folders cannot be opened, files that are open or
mapped here cannot be replaced, removed or moved, names cannot hold what its names cannot, the disk cannot be
waited for through a descriptor for reading, and there are no symbolic links. There is no ``/proc`` either.
"""
# ruff: noqa: PTH112, PTH115, PTH123, PTH208

import errno
import os
import shutil
import signal
import subprocess  # noqa: F401 - it needs what is taken away
import sys
import tempfile
import threading

import psutil  # noqa: F401 - on Linux it needs modules of Unix

GONE = {
    os: (
        "O_CLOEXEC O_DIRECTORY O_DSYNC O_NOCTTY O_NOFOLLOW O_NONBLOCK O_SYNC chown copy_file_range fork forkpty "
        "fstatvfs getegid geteuid getgid getgroups getpgid getpriority getresuid getsid getuid killpg lchown "
        "mkfifo mknod nice openpty posix_fadvise posix_fallocate posix_spawn pread preadv pwrite pwritev "
        "register_at_fork sched_getaffinity sched_setaffinity sched_yield sendfile setsid setuid statvfs sync "
        "wait3 wait4"
    ),
    signal: (
        "SIGALRM SIGBUS SIGCHLD SIGCONT SIGHUP SIGKILL SIGPIPE SIGQUIT SIGSTOP SIGTSTP SIGUSR1 SIGUSR2 SIG_BLOCK "
        "SIG_SETMASK SIG_UNBLOCK alarm getitimer pause pthread_kill pthread_sigmask setitimer siginterrupt "
        "sigpending sigtimedwait sigwait sigwaitinfo"
    ),
}
NO_MODULES = ("fcntl", "grp", "pwd", "resource", "termios", "tty", "pty", "syslog")
FORBIDDEN = '<>:"|?*\\'

_looking = threading.local()
_NOT_READ = os.O_WRONLY | os.O_RDWR
_fsync = os.fsync


def _refused(number: int, path: object) -> OSError:
    return OSError(number, os.strerror(number), path)


def _in_use() -> set[str]:
    """Files that this process has open or mapped."""
    places = {f"/proc/self/fd/{name}" for name in os.listdir("/proc/self/fd")}
    found = set()
    for place in places:
        try:
            found.add(os.readlink(place))
        except OSError:
            continue
    with open("/proc/self/maps", "rb") as file:
        found |= {os.fsdecode(line.split(maxsplit=5)[5].rstrip()) for line in file if line.count(b" ") > 5}
    return {path for path in found if path.startswith("/")}


def _refuse_open(*paths: object) -> None:
    _looking.now = True
    try:
        used = _in_use()
        for path in paths:
            place = os.path.realpath(os.fsdecode(path))  # type: ignore[arg-type]
            if place in used or any(each.startswith(f"{place}/") for each in used):
                raise _refused(errno.EACCES, path)
    finally:
        _looking.now = False


def _watch(event: str, arguments: tuple[object, ...]) -> None:
    if getattr(_looking, "now", False):
        return
    if event in ("open", "os.listdir", "os.scandir"):
        path = arguments[0]
        if isinstance(path, (str, bytes, os.PathLike)):
            _refuse(event, os.fsdecode(path), arguments)
    elif event == "os.rename":
        _refuse_open(*arguments[:2])
    elif event == "os.remove":
        _refuse_open(arguments[0])


def _refuse(event: str, path: str, arguments: tuple[object, ...]) -> None:
    if path.startswith("/proc"):
        raise _refused(errno.ENOENT, path)
    if event != "open":
        return
    if arguments[1] is None and os.path.isdir(path):  # by os.open
        raise _refused(errno.EACCES, path)
    flags = arguments[2]
    if isinstance(flags, int) and flags & _NOT_READ and any(each in path for each in FORBIDDEN):
        raise _refused(errno.EINVAL, path)


def _sync(descriptor: int) -> None:
    if not _flags(descriptor) & _NOT_READ:
        raise _refused(errno.EBADF, None)
    _fsync(descriptor)


def _flags(descriptor: int) -> int:
    _looking.now = True
    try:
        with open(f"/proc/self/fdinfo/{descriptor}") as file:
            return next(int(line.split()[1], 8) for line in file if line.startswith("flags"))
    finally:
        _looking.now = False


def _no_link(source: object, place: object, *_: object, **__: object) -> None:
    raise OSError(errno.EPERM, "A required privilege is not held by the client", source, None, place)


def _make_poor() -> None:
    usage = shutil.disk_usage(".")  # asks for it by a call of Unix
    shutil.disk_usage = lambda _: usage  # type: ignore[assignment]
    shutil._use_fd_functions = False  # type: ignore[attr-defined]
    tempfile.TemporaryFile = tempfile.NamedTemporaryFile  # type: ignore[assignment]
    for module, names in GONE.items():
        for name in names.split():
            if hasattr(module, name):
                delattr(module, name)
    for name in NO_MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    os.fsync = _sync  # type: ignore[assignment]
    os.symlink = _no_link  # type: ignore[assignment]
    sys.addaudithook(_watch)


_make_poor()
