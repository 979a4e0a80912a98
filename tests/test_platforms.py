"""What systems do in their own ways: each way is taken here, where the one that this system goes is barred."""

import errno
import os
import resource
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from colmap_sph.errors import InputError, OutputError
from colmap_sph.platforms import files, limits, links, locks, memory, names, processes, processors, surroundings
from colmap_sph.project import workspace as workspaces
from colmap_sph.project.claim import check_ways_out
from colmap_sph.project.given import image_names
from colmap_sph.project.workspace import Workspace, checked_name

# ---- locks -------------------------------------------------------------------------------------------------


@pytest.fixture(params=["folder", "file"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Of Unix, and of Windows."""
    if request.param == "file":
        monkeypatch.setattr(locks, "fcntl", None)
    return str(request.param)


@pytest.mark.parametrize(("first", "second"), [(False, False), (False, True), (True, False)])
def test_who_holds_a_folder_alone_keeps_all_out(first: bool, second: bool, way: str, tmp_path: Path) -> None:
    with locks.holding(tmp_path, shared=first):
        with pytest.raises(BlockingIOError), locks.holding(tmp_path, shared=second):
            pass
        with pytest.raises(BlockingIOError), locks.holding(tmp_path, shared=second):
            pass
    with locks.holding(tmp_path, shared=second):
        pass
    locks.remove_lock(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_several_hold_a_folder_together(way: str, tmp_path: Path) -> None:
    with ExitStack() as held:
        for _ in range(3):
            held.enter_context(locks.holding(tmp_path, shared=True))
        with pytest.raises(BlockingIOError), locks.holding(tmp_path):
            pass
        held.enter_context(locks.holding(tmp_path, shared=True))
    with locks.holding(tmp_path):
        pass


def test_waiting_for_others_to_let_go(way: str, tmp_path: Path) -> None:
    order: list[str] = []
    with locks.holding(tmp_path):
        waiting = threading.Thread(target=lambda: _append_when_held(tmp_path, order))
        waiting.start()
        waiting.join(0.3)
        assert waiting.is_alive()
        order.append("first")
    waiting.join(20)
    assert order == ["first", "second"]


def _append_when_held(folder: Path, order: list[str]) -> None:
    with locks.holding(folder, wait=True):
        order.append("second")


@pytest.mark.parametrize("shared", [False, True])
def test_a_killed_process_holds_nothing(shared: bool, way: str, tmp_path: Path) -> None:
    code = textwrap.dedent(
        f"""
        import sys, time
        from pathlib import Path
        from colmap_sph.platforms import locks
        if {way == "file"}:
            locks.fcntl = None
        with locks.holding(Path(sys.argv[1]), shared={shared}):
            print("held", flush=True)
            time.sleep(60)
        """
    )
    process = subprocess.Popen([sys.executable, "-P", "-c", code, tmp_path], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        with pytest.raises(BlockingIOError), locks.holding(tmp_path):
            pass
    finally:
        process.kill()
        process.communicate()
    with locks.holding(tmp_path):
        pass
    locks.remove_lock(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there(way: str, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), locks.holding(tmp_path / "none"):
        pass


def test_a_disk_without_locks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(locks.fcntl, "flock", none)
    with locks.holding(tmp_path), locks.holding(tmp_path):
        pass


@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_strangers_file_in_place_of_the_lock(kind: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(locks, "fcntl", None)
    if kind == "file":
        (tmp_path / ".lock").write_text("mine")
    else:
        (tmp_path / ".lock").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match=r"\.lock in it is not this program's; remove it"), locks.holding(tmp_path):
        pass
    assert not (tmp_path / "elsewhere").exists()


# ---- files -------------------------------------------------------------------------------------------------


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """No folders that can be opened, and no replacing of what is open."""
    monkeypatch.setattr(files, "_IS_UNIX", False)
    monkeypatch.setattr(files, "_NO_LINK", 0)
    monkeypatch.setattr(files, "_FOLDER", 0)


@pytest.fixture
def refusals(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """How often renaming is still refused, as where a virus scanner looks at the file."""
    left = [0]
    rename = Path.replace

    def replace(source: Path, target: Path) -> Path:
        if left[0] > 0:
            left[0] -= 1
            raise PermissionError(errno.EACCES, "Access is denied", str(target))
        return rename(source, target)

    monkeypatch.setattr(Path, "replace", replace)
    yield left


def test_a_file_that_is_open_for_a_moment_is_replaced(windows: None, refusals: list[int], tmp_path: Path) -> None:
    (tmp_path / "new").write_text("new")
    (tmp_path / "old").write_text("old")
    refusals[0] = 3
    files.move_into_place(tmp_path / "new", tmp_path / "old")
    assert (tmp_path / "old").read_text() == "new"
    assert refusals == [0]


@pytest.mark.parametrize("place", ["old", "folder"])
def test_who_keeps_a_file_open_is_named(
    place: str, windows: None, refusals: list[int], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(files, "_PATIENCE", 0.05)
    (tmp_path / "folder").mkdir()
    (tmp_path / "new").write_text("new")
    path = tmp_path / ("old" if place == "old" else "folder/file")
    path.write_text("old")
    refusals[0] = 10**6
    code = "import sys, time; file = open(sys.argv[1]); print(flush=True); time.sleep(60)"
    holder = subprocess.Popen([sys.executable, "-c", code, path], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None and holder.stdout.readline()
        with pytest.raises(PermissionError) as caught:
            files.move_into_place(tmp_path / "new", tmp_path / place)
    finally:
        holder.kill()
        holder.communicate()
    assert f"(process {holder.pid}); close it there" in str(caught.value.strerror)
    assert path.read_text() == "old"


def test_unix_does_not_wait_for_a_refusal(refusals: list[int], tmp_path: Path) -> None:
    refusals[0] = 5
    with pytest.raises(PermissionError, match="denied"):
        files.move_into_place(tmp_path / "new", tmp_path / "old")
    assert refusals == [4]


def test_links_are_not_followed(windows: None, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("content")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    before = psutil.Process().num_fds()
    with pytest.raises(OSError, match="symbolic links"):
        files.open_descriptor(tmp_path / "link", os.O_RDONLY, follow=False)
    assert psutil.Process().num_fds() == before
    os.close(files.open_descriptor(tmp_path / "link", os.O_RDONLY))
    os.close(files.open_descriptor(tmp_path / "file", os.O_RDONLY, follow=False))


def test_a_junction_leads_out_like_a_link(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A link here, of which the system says that it is a folder, as Windows does of a junction."""
    (tmp_path / "dense/stereo").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    junction = tmp_path / "dense/stereo/depth_maps"
    junction.symlink_to(tmp_path / "elsewhere")
    monkeypatch.setattr(Path, "is_symlink", lambda _: False)
    monkeypatch.setattr(files, "is_junction", lambda path: path == junction)
    monkeypatch.setattr("colmap_sph.project.claim.is_junction", lambda path: path == junction)
    with pytest.raises(OutputError, match=r"depth_maps is a link to .*elsewhere"):
        check_ways_out(tmp_path / "dense", [tmp_path / "dense/stereo"])


def test_nothing_waits_for_a_folder_that_cannot_be_opened(
    windows: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    flags: list[int] = []

    def opened(path: Path, flag: int) -> int:
        flags.append(flag)
        return os.open(path, flag)

    monkeypatch.setattr(files, "open_descriptor", opened)
    files.sync_folder(tmp_path)
    files.look_again([tmp_path, tmp_path / "none"])
    assert flags == []
    (tmp_path / "file").touch()
    files.sync_file(tmp_path / "file")
    assert flags == [os.O_RDWR]  # Windows waits only for who may write


@pytest.mark.parametrize("is_known", [True, False])
def test_macos_waits_for_the_disk_itself(is_known: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls: list[str] = []

    def control(_: int, command: int) -> None:
        calls.append(f"fcntl {command}")
        if not is_known:
            raise OSError(errno.ENOTSUP, "Operation not supported")

    monkeypatch.setattr(files, "fcntl", SimpleNamespace(F_FULLFSYNC=51, fcntl=control))
    monkeypatch.setattr(os, "fsync", lambda _: calls.append("fsync"))
    (tmp_path / "file").touch()
    files.sync_file(tmp_path / "file")
    assert calls == (["fcntl 51"] if is_known else ["fcntl 51", "fsync"])


@pytest.mark.parametrize("has_call", [True, False])
def test_room_is_taken_or_refused(has_call: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    if not has_call:
        monkeypatch.delattr(os, "posix_fallocate")
    with (tmp_path / "file").open("xb") as file:
        files.take_room(file.fileno(), 3_000_001)
    assert (tmp_path / "file").stat().st_size == 3_000_001
    if not has_call:
        with Path("/dev/full").open("wb", buffering=0) as file, pytest.raises(OSError, match="No space"):
            files.take_room(file.fileno(), 10)


def test_text_is_the_same_on_all_systems(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(os, "linesep", "\r\n")
    files.write_text(tmp_path / "file", "Köln\nx\n")
    assert (tmp_path / "file").read_bytes() == "Köln\nx\n".encode()


# ---- links -------------------------------------------------------------------------------------------------


@pytest.fixture
def unprivileged(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EPERM, "A required privilege is not held by the client")

    monkeypatch.setattr(os, "symlink", refuse)


def test_a_link_can_be_moved_with_its_target(tmp_path: Path) -> None:
    (tmp_path / "a/images/cam").mkdir(parents=True)
    (tmp_path / "a/images/cam/1.jpg").write_text("1")
    (tmp_path / "a/made").mkdir()
    links.link(tmp_path / "a/made/images", tmp_path / "a/images", seen_from=tmp_path / "a/later/deeper")
    assert (tmp_path / "a/made/images").readlink() == Path("../../images")
    links.link(tmp_path / "a/made/1.jpg", tmp_path / "a/images/cam/1.jpg")
    (tmp_path / "a").rename(tmp_path / "b")
    assert (tmp_path / "b/made/1.jpg").read_text() == "1"


def test_other_drives(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def relpath(*_: object) -> str:
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", relpath)
    links.link(tmp_path / "link", tmp_path)
    assert (tmp_path / "link").readlink() == tmp_path


@pytest.mark.parametrize("is_one_disk", [True, False])
def test_without_links_a_file_has_two_names_or_is_copied(
    is_one_disk: bool, unprivileged: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    if not is_one_disk:
        monkeypatch.setattr(os, "link", refuse)
    folder = tmp_path / "images/cam"
    folder.mkdir(parents=True)
    (folder / "1.jpg").write_text("1")
    links.link(tmp_path / "one", folder / "1.jpg")
    links.link(tmp_path / "all", tmp_path / "images")
    for made in (tmp_path / "one", tmp_path / "all/cam/1.jpg"):
        assert made.read_text() == "1"
        assert made.samefile(folder / "1.jpg") == is_one_disk
    with pytest.raises(FileExistsError):
        links.link(tmp_path / "one", folder / "1.jpg")


# ---- names -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        "a.jpg",
        "cam/a.jpg",
        "Köln/東京 (1), b'c.jpg",
        ".hidden",
        "a..b/c.d.e",
        "con1.jpg",
        "console.png",
        "auxiliary/nullable.jpg",
        "com10.jpg",
        "~$%&#{}[]!^`+=;@_-.jpg",
    ],
)
def test_names_that_windows_can_have(name: str) -> None:
    assert names.name_problem(name, windows=True) is None


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("C:a.jpg", "has a ':'"),
        ("C:/a.jpg", "has a ':'"),
        ("a.jpg:stream", "has a ':'"),
        ("..\\..\\a.jpg", "has a '\\'"),
        ("cam\\a.jpg", "has a '\\'"),
        ("a*.jpg", "has a '*'"),
        ("a?.jpg", "has a '?'"),
        ("a|b.jpg", "has a '|'"),
        ("<a>.jpg", "has a '<'"),
        ('a".jpg', "has a '\"'"),
        ("a\x07.jpg", "cannot be seen"),
        ("cam./a.jpg", "ends with a dot"),
        ("cam /a.jpg", "ends with a dot or a space"),
        ("a.", "dot"),
        ("NUL", "device of Windows ('NUL')"),
        ("nul.jpg", "device"),
        ("cam/Aux.tar.gz", "device of Windows ('Aux')"),
        ("CON .jpg", "device"),
        ("com1.jpg", "device"),
        ("LPT³/a.jpg", "device"),
    ],
)
def test_names_that_windows_cannot_have(name: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert words in (names.name_problem(name, windows=True) or "").replace(
        "ends, or has a folder that ends,", "ends"
    )
    assert names.name_problem(name, windows=False) is None
    monkeypatch.setattr(workspaces, "name_problem", partial(names.name_problem, windows=True))
    for path_of in (checked_name, Workspace(Path("dense")).image_path):
        with pytest.raises(InputError, match=r"The image name .*; rename the image, its file and in the model\."):
            path_of(name)


def test_images_that_are_one_file_where_case_is_folded(monkeypatch: pytest.MonkeyPatch) -> None:
    alike = ["cam/Größe.jpg", "cam/GRÖSSE.jpg"]
    image_names.check_names(alike, Path("sparse"))
    monkeypatch.setattr(image_names, "same_file_name", partial(names.same_file_name, folds_case=True))
    image_names.check_names(["a.jpg", "b.jpg"], Path("sparse"))
    for pair in (alike, ["e\u0301.jpg", "\u00e9.jpg"]):
        with pytest.raises(InputError, match=r"has the images .* which are the same file on this system"):
            image_names.check_names(pair, Path("sparse"))


def test_paths_longer_than_windows_is_set_up_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert names.longest_path() is None
    workspace = Workspace(tmp_path / "dense")
    workspace.create_stereo_dirs(["a.jpg"])
    monkeypatch.setattr(workspaces, "longest_path", lambda: len(str(tmp_path)) + 60)
    workspace.create_stereo_dirs(["a.jpg"])
    with pytest.raises(OutputError, match=r"choose a shorter --output, or .*long paths"):
        workspace.create_stereo_dirs(["a" * 40 + ".jpg"])


# ---- processors, memory, limits ----------------------------------------------------------------------------


def test_cores_where_the_system_binds_in_another_way(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = len(os.sched_getaffinity(0))
    assert processors.usable_cores() == wanted
    monkeypatch.delattr(os, "sched_getaffinity")
    assert processors.usable_cores() == wanted
    monkeypatch.delattr(psutil.Process, "cpu_affinity")  # macOS
    assert processors.usable_cores() == os.cpu_count()
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert processors.usable_cores() == 1


def test_memory_without_limits_of_unix(monkeypatch: pytest.MonkeyPatch) -> None:
    most = memory.most_resident()
    assert most > 0.9 * memory.resident() > 10 << 20
    facts = SimpleNamespace(rss=5, vms=7, peak_wset=11)
    monkeypatch.setattr(psutil.Process, "memory_info", lambda _: facts)
    monkeypatch.setattr(memory, "resource", None)
    monkeypatch.setattr(limits, "resource", None)
    assert (memory.resident(), memory.most_resident()) == (5, 11)
    assert list(memory.free_under_limits()) == []
    assert limits.open_files_limit() is None
    limits.raise_open_files_limit(10)


def test_a_system_that_counts_no_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """MacOS has the limit, and does not say how much is used of it."""
    monkeypatch.setattr(psutil.Process, "memory_info", lambda _: SimpleNamespace(rss=5, vms=7))
    limit = {resource.RLIMIT_AS: 100, resource.RLIMIT_DATA: 50}
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (limit[kind], -1))
    assert list(memory.free_under_limits()) == [93]


def test_a_system_that_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise psutil.AccessDenied

    monkeypatch.setattr(psutil, "Process", refuse)
    monkeypatch.setattr(psutil, "virtual_memory", refuse)
    assert memory.available() is None
    assert memory.process_start_time() is None
    assert memory.resident() == 200 << 20


# ---- processes and what is around them ---------------------------------------------------------------------


def test_signals_of_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    assert processes.ENDING == (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    assert [processes.exit_code_of(number) for number in processes.ENDING] == [130, 143, 129]
    monkeypatch.setattr(processes, "_BREAK", 21)
    assert processes.exit_code_of(21) == 143
    monkeypatch.delattr(signal, "pthread_sigmask")
    with processes.held_back(signal.SIGTERM):
        pass


def test_becoming_another_program_where_exec_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []
    monkeypatch.setattr(processes, "_IS_WINDOWS", True)

    def call(command: list[str]) -> int:
        calls.append(command)
        return 3

    monkeypatch.setattr(subprocess, "call", call)
    with pytest.raises(SystemExit) as stop:
        processes.become("C:/COLMAP/colmap.bat", ["colmap", "gui", "--x", "1"])
    assert stop.value.code == 3
    assert calls == [["C:/COLMAP/colmap.bat", "gui", "--x", "1"]]


@pytest.mark.parametrize("is_console", [True, False])
def test_the_console_of_windows_keeps_its_stream(is_console: bool) -> None:
    code = textwrap.dedent(
        f"""
        import sys
        from colmap_sph.app import standard_streams
        standard_streams.is_console_of_windows = lambda stream: {is_console}
        before = sys.stderr
        assert standard_streams.prepare_process() is None
        assert (sys.stderr is before) == {is_console}
        print("Köln", file=sys.stderr)
        """
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "Köln\n".encode())


def test_a_pipe_is_no_console_and_linux_has_none() -> None:
    assert not surroundings.is_console_of_windows(sys.stderr)
    assert surroundings.REUSES_PORTS


@pytest.mark.parametrize(("variable", "shown"), [("DISPLAY", True), ("BROWSER", True), ("TERM", False)])
def test_a_screen(variable: str, shown: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(variable, "x")
    assert surroundings.has_screen() == shown
