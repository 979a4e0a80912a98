"""The whole program on a Linux as poor as Windows, see `bare_system`, with the promises that remain."""

import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from projects import copy_four_images

from colmap_sph.app import cli
from colmap_sph.project.map_coordinates import move_model
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.workspace import Workspace

BARE = os.environ | {"PYTHONPATH": str(Path(__file__).parent / "bare_system"), "COLUMNS": "120"}
MIB = 1 << 20


def started(*arguments: object) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "colmap_sph", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=BARE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def said_by(*arguments: object, code: int = 0) -> str:
    process = started(*arguments)
    said = process.communicate(timeout=600)[0]
    assert process.returncode == code, said
    assert "Traceback" not in said
    return said


def wait_until(condition: Callable[[], bool], process: "subprocess.Popen[str]") -> None:
    limit = time.monotonic() + 120
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < limit
        time.sleep(0.002)


def in_python(code: str, *arguments: object) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-P", "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=BARE, timeout=120)


def results(dense: Path) -> dict[str, bytes]:
    files = [*dense.glob("stereo/*_maps/*.bin"), *dense.glob("fused*"), *dense.glob("sparse/*.bin")]
    return {str(path.relative_to(dense)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project that was reconstructed with all that this system has; not to be changed."""
    root = tmp_path_factory.mktemp("whole")
    copy_four_images(root)
    assert cli.main(["run", "--model", str(root / "sparse/0"), "--threads", "2"]) == 0
    return root


@pytest.fixture
def project(whole: Path, tmp_path: Path) -> Path:
    """Its images and model."""
    for name in ("images", "sparse"):
        shutil.copytree(whole / name, tmp_path / name)
    return tmp_path / "sparse/0"


def test_what_is_taken_away_is_gone() -> None:
    done = in_python(
        """
        import os, signal, sys, tempfile
        for name in ("fcntl", "resource", "pwd"):
            try:
                __import__(name)
                print("there:", name)
            except ImportError:
                pass
        gone = ["fork", "O_NOFOLLOW", "O_DIRECTORY", "pread", "posix_fallocate", "sched_getaffinity", "geteuid"]
        assert not any(hasattr(os, name) for name in gone)
        assert not hasattr(signal, "SIGKILL") and not hasattr(signal, "pthread_sigmask")

        def refused(kind, call):
            try:
                call()
            except kind:
                return
            raise AssertionError(call)

        folder = tempfile.mkdtemp()
        path = folder + "/a"
        held = open(path, "wb")
        open(folder + "/b", "wb").close()
        refused(FileNotFoundError, lambda: open("/proc/self/status"))
        refused(PermissionError, lambda: os.open(folder, os.O_RDONLY))
        refused(PermissionError, lambda: os.replace(folder + "/b", path))
        refused(PermissionError, lambda: os.replace(path, folder + "/c"))
        refused(PermissionError, lambda: os.rename(folder, folder + "2"))
        refused(PermissionError, lambda: os.unlink(path))
        refused(OSError, lambda: os.symlink("a", folder + "/c"))
        refused(OSError, lambda: open(folder + "/a:b", "wb"))
        reading = os.open(folder + "/b", os.O_RDONLY)
        refused(OSError, lambda: os.fsync(reading))
        os.close(reading)
        held.close()
        os.replace(folder + "/b", path)
        os.unlink(path)
        print("all refused")
        """
    )
    assert (done.stdout, done.stderr) == ("all refused\n", "")


def test_the_whole_demo(tmp_path: Path) -> None:
    said = said_by("demo", "--output", tmp_path / "demo", "--threads", "2")
    assert "Against exact depth" in said
    dense = Workspace(tmp_path / "demo/dense")
    name = "N_0_1.jpg"
    depth = read_depth_map(dense.depth_map_path(name, "geometric"))
    exact = np.load(tmp_path / "demo/truth" / f"{name}.npz")["depth"]
    seen = (depth > 0) & (exact > 0)
    assert seen.mean() > 0.85
    assert np.median(np.abs(depth[seen] / exact[seen] - 1)) < 1e-3
    header = dense.fused_path.read_bytes()[:1000]
    assert int(re.search(rb"element vertex (\d+)", header)[1]) > 500_000  # type: ignore[index]
    assert dense.page_path.stat().st_size > 100_000
    assert not [path for path in dense.root.rglob(".*") if path.name != ".lock"]


def test_results_are_the_same_to_the_byte(whole: Path, project: Path) -> None:
    said_by("run", "--model", project, "--threads", "1")
    assert results(project.parents[1] / "dense") == results(whole / "dense")


def test_a_workspace_of_second_names_in_place_of_links(whole: Path, tmp_path: Path) -> None:
    """COLMAP's fusion of a model in map coordinates reads one; what is kept of it has no images and maps then."""
    model = pycolmap.Reconstruction(whole / "sparse/0")
    move_model(model, np.array([-4e5, -5.6e6, -300.0]))
    (tmp_path / "sparse/0").mkdir(parents=True)
    model.write_binary(tmp_path / "sparse/0")
    (tmp_path / "images").symlink_to(whole / "images")
    arguments = ["run", "--model", str(tmp_path / "sparse/0"), "--threads", "1", "--fusion.method", "colmap"]
    arguments += ["--fusion.min-num-pixels", "2", "--output"]
    assert cli.main([*arguments, str(tmp_path / "linked")]) == 0
    said_by(*arguments, tmp_path / "poor")
    linked, poor = (Workspace(tmp_path / name) for name in ("linked", "poor"))
    assert results(poor.root) == results(linked.root)
    assert poor.fused_path.stat().st_size > 10_000
    kept = {path.relative_to(linked.local_dir) for path in linked.local_dir.rglob("*")}
    links = {Path("images"), Path("stereo"), Path("fused.ply.vis")}
    assert {path.relative_to(poor.local_dir) for path in poor.local_dir.rglob("*")} == kept - links
    said_by(*arguments, tmp_path / "poor", "--overwrite")
    assert not list(poor.state_dir.glob("*.backup*"))


def test_one_run_keeps_others_out(project: Path) -> None:
    dense = project.parents[1] / "dense"
    arguments = ["run", "--model", project, "--threads", "1"]
    with started(*arguments) as first:
        wait_until(lambda: any(dense.glob("colmap_sph/pairs/*/*")), first)
        first.send_signal(signal.SIGSTOP)
        try:
            assert "Another run is at work in" in said_by(*arguments, code=3)
            assert "Another run is at work in" in said_by(*arguments, "--stage", "match", "--shard", "1/2", code=3)
        finally:
            first.send_signal(signal.SIGCONT)
        assert first.wait(120) == 0


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_ends_cleanly(number: signal.Signals, code: int, whole: Path, project: Path) -> None:
    dense = project.parents[1] / "dense"
    arguments = ["run", "--model", project, "--threads", "1"]
    with started(*arguments) as process:
        wait_until(lambda: any(dense.glob("colmap_sph/pairs/*/*")), process)
        process.send_signal(number)
        said = process.communicate(timeout=60)[0]
    assert process.returncode == code
    assert said.splitlines()[-1].startswith("interrupted; what is finished is kept")
    assert "Traceback" not in said
    said_by(*arguments)
    assert results(dense) == results(whole / "dense")
    assert not list(dense.rglob(".*.tmp"))


def test_a_file_that_is_not_finished_is_not_there(tmp_path: Path) -> None:
    """Whoever is killed while a file is written leaves what was there before."""
    dense = tmp_path / "dense"
    (dense / "colmap_sph").mkdir(parents=True)
    code = """
        import os, sys
        from pathlib import Path
        from colmap_sph.project.claim import claimed
        from colmap_sph.project.files import atomic_file
        from colmap_sph.project.workspace import Workspace

        workspace = Workspace(Path(sys.argv[1]))
        path = workspace.state_dir / "file"
        with claimed(workspace):
            assert not list(workspace.state_dir.glob(".*.tmp"))
            with atomic_file(path) as file:
                file.write(sys.argv[2].encode())
                if sys.argv[3] == "killed":
                    os._exit(9)
    """
    assert in_python(code, dense, "first", "finished").returncode == 0
    assert in_python(code, dense, "second", "killed").returncode == 9
    assert (dense / "colmap_sph/file").read_text() == "first"
    done = in_python(code, dense, "third", "finished")
    assert (done.returncode, done.stderr) == (0, "")
    assert (dense / "colmap_sph/file").read_text() == "third"


def test_the_memory_budget_is_kept(project: Path) -> None:
    # Memory of the process that starts another counts as that one's, too: so a small one starts and measures it.
    measure = (
        "import resource, subprocess, sys; code = subprocess.call(sys.argv[1:]);"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, file=sys.stderr); sys.exit(code)"
    )
    options = ["--model", str(project), "--threads", "2", "--memory", "500MiB"]
    command = [sys.executable, "-I", "-c", measure, sys.executable, "-P", "-m", "colmap_sph", "run", *options]
    done = subprocess.run(command, capture_output=True, text=True, env=BARE)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stderr.split()[-1]) * 1024 < 500 * MIB
