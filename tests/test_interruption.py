"""Kills, signals and full disks: what is finished is kept, and the run that follows completes the work."""

import importlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SCRIPTS, copy_block, keep_images
from projects import copy_four_images

from colmap_sph.app import cli
from colmap_sph.evaluation import neighbours
from colmap_sph.evaluation.neighbours import PointIndex

NAMES = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_1.jpg"]
STOPS = [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]


def start(*arguments: object) -> "subprocess.Popen[str]":
    command = [sys.executable, "-P", "-m", "colmap_sph", "run", *map(str, arguments), "--threads", "2"]
    return started(command)


def started(command: list[str]) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        # The tests themselves may run in the background of a shell that has SIGINT ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def complete(*arguments: object) -> None:
    """Let a run come to its end, here: a process of its own would load everything again."""
    assert cli.main(["run", *map(str, arguments), "--threads", "2"]) == 0


def maps(dense: Path) -> dict[str, bytes]:
    return {str(path.relative_to(dense)): path.read_bytes() for path in dense.glob("stereo/*_maps/*.bin")}


def results(dense: Path) -> dict[str, bytes]:
    return maps(dense) | {path.name: path.read_bytes() for path in dense.glob("fused*")}


def wait_for(process: "subprocess.Popen[str]", pattern: str, folder: Path, number: int = 1) -> None:
    """Wait until that many files are there; the process must not end before."""
    limit = time.monotonic() + 60
    while len(list(folder.glob(pattern))) < number:
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < limit
        time.sleep(0.005)


# ---- kills -------------------------------------------------------------------------------------------------


def test_signals_between_file_operations(tmp_path: Path) -> None:
    """In three ways to run; the script itself takes 60, and as many errors."""
    done = subprocess.run(
        [
            sys.executable,
            SCRIPTS / "check_interruptions.py",
            "--output",
            tmp_path / "out",
            "--signals",
            "3",
            "--errors",
            "0",
        ],
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 signals: 3 finished, identical, nothing made again" in done.stdout
    assert "not reached" not in done.stdout


@pytest.mark.usefixtures("scripts_on_path")
def test_the_check_of_interruptions_finds_faults(tmp_path: Path) -> None:
    """Work that was done again, a map and a cloud that differ, a map that is missing, leftovers."""
    script = importlib.import_module("check_interruptions")
    for root in ("disturbed", "whole"):
        for folder in ("depth_maps", "normal_maps"):
            path = tmp_path / root / "stereo" / folder / "cam" / "a.jpg.geometric.bin"
            path.parent.mkdir(parents=True)
            path.write_bytes(b"1")
        for name in ("fused.ply", "fused.ply.vis"):
            (tmp_path / root / name).write_bytes(b"1")
    disturbed, whole = tmp_path / "disturbed", tmp_path / "whole"
    for name in ("pairs/1-2", "photometric/cam/a.jpg", "state/cam/a.jpg.geometric.json", "cloud.json"):
        (disturbed / "colmap_sph" / name).parent.mkdir(parents=True, exist_ok=True)
        (disturbed / "colmap_sph" / name).write_bytes(b'{"state": "done"}')
    (disturbed / "colmap_sph/state/b.jpg.geometric.json").write_bytes(b'{"state": "making"}')
    finished = script.finished_files(disturbed)
    assert len(finished) == 6
    assert script.files_made_again(finished) == []
    assert script.differences(disturbed, whole) == script.leftovers(disturbed) == []
    os.utime(disturbed / "colmap_sph/pairs/1-2", ns=(5, 5))
    (disturbed / "stereo/depth_maps/cam/a.jpg.geometric.bin").unlink()
    assert len(script.files_made_again(finished)) == 2
    (disturbed / "stereo/normal_maps/cam/a.jpg.geometric.bin").write_bytes(b"2")
    (disturbed / "fused.ply.vis").write_bytes(b"2")
    assert script.differences(disturbed, whole)[0].startswith("3 results differ")
    (disturbed / "stereo/.1-2.tmp").touch()
    (disturbed / "colmap_sph/.fusion.tmp").mkdir()
    assert script.leftovers(disturbed) == ["left behind: .1-2.tmp, .fusion.tmp"]


def test_stages_of_file_operations(scripts_on_path: None) -> None:
    script = importlib.import_module("check_interruptions")
    operation = script.Operation
    operations = [
        operation("write", "/colmap_sph/.undistorting.tmp/images/a.jpg"),
        operation("rename", "/images"),
        operation("open", "/sparse/images.bin"),
        operation("read", "/colmap_sph/pairs/1-2"),
        operation("write", "/colmap_sph/pairs/.7.tmp"),
        operation("write", "/colmap_sph/photometric/.7.tmp"),
        operation("rename", "/fused.ply"),
    ]
    assert script.stages_of(operations) == {
        "undistortion": [0, 1, 2, 3],
        "publishing": [1, 2],
        "matching": [4],
        "depth": [5],
        "fusion": [6],
    }


# ---- signals -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("moment", "number", "code"),
    [
        ("colmap_sph/pairs/*/*.sph", *STOPS[0]),
        ("colmap_sph/photometric/*.sph", *STOPS[1]),
        ("stereo/depth_maps/*.geometric.bin", *STOPS[2]),
    ],
)
def test_signals_stop_a_run_which_then_goes_on(
    number: signal.Signals, code: int, moment: str, project: Path
) -> None:
    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("this signal is ignored here, as nohup has it, and so in the run")
    keep_images(project, [*NAMES, "N_1_0.jpg", "N_1_2.jpg"])
    dense = project / "dense"
    with start("--model", project / "sparse/0") as process:
        wait_for(process, moment, dense, 2)
        process.send_signal(number)
        said, _ = process.communicate(timeout=30)
    assert process.returncode == code
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith("interrupted; what is finished is kept")
    assert not (dense / "fused.ply").exists()
    assert not list(dense.rglob(".*.tmp"))
    kept = {path: path.stat().st_mtime_ns for path in dense.glob("colmap_sph/p*/**/*.sph")}
    assert len(kept) >= 2
    complete("--model", project / "sparse/0")
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert (dense / "fused.ply.vis").exists()
    log = (dense / "colmap_sph/log.txt").read_text()
    assert "Interrupted" in log
    assert "Traceback" not in log


BUSY = """
    import hashlib, sys, concurrent.futures
    from colmap_sph.app.interruption import stop_on_signals

    def long_work():  # in C, with the interpreter's lock released, for minutes
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000_000)

    with stop_on_signals(lambda stop: print("last words", stop.exit_code, flush=True)):
        print("ready", flush=True)
        if sys.argv[1] == "main":
            long_work()
        with concurrent.futures.ThreadPoolExecutor() as pool:
            pool.submit(long_work).result()
"""


@pytest.mark.parametrize(("thread", "number", "code"), [("main", *STOPS[0]), ("worker", *STOPS[1])])
def test_signals_end_long_calls(thread: str, number: signal.Signals, code: int) -> None:
    """What cannot be interrupted is ended with the process."""
    with started([sys.executable, "-c", textwrap.dedent(BUSY), thread]) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.2)
        process.send_signal(number)
        said, _ = process.communicate(timeout=30)
    assert process.returncode == code
    assert said == f"last words {code}\n"


def test_an_interrupted_comparison_of_clouds_leaves_no_thread() -> None:
    """One that went on in memory that is freed meanwhile would end the process with a crash."""
    random = np.random.default_rng(5)
    index, queries = PointIndex(random.random((100_000, 3))), random.random((1_000_000, 3))

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def send() -> None:
        while threading.active_count() < threads + 3:  # with this one, two that search
            time.sleep(0.001)
        time.sleep(0.05)  # until both are known to whoever waits for them
        os.kill(os.getpid(), signal.SIGUSR1)

    before = signal.signal(signal.SIGUSR1, interrupt)
    threads = threading.active_count()
    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            index.distances(queries, threads=2)
    finally:
        signal.signal(signal.SIGUSR1, before)
    sender.join()
    assert threading.active_count() == threads


def test_an_interrupted_comparison_of_clouds_begins_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the interruption comes while it still puts its chunks into line."""
    begun: list[slice] = []
    submit = ThreadPoolExecutor.submit

    def submit_few(self: ThreadPoolExecutor, *arguments: Any) -> Any:
        if self._work_queue.qsize() > 100:
            raise KeyboardInterrupt
        return submit(self, *arguments)

    def search(chunk: slice) -> None:
        begun.append(chunk)
        time.sleep(0.05)

    monkeypatch.setattr(ThreadPoolExecutor, "submit", submit_few)
    with pytest.raises(KeyboardInterrupt):
        neighbours._in_chunks(search, 1 << 30, 2)
    assert len(begun) < 50


def test_signals_that_are_ignored_stay_ignored(project: Path) -> None:
    """As a shell's background jobs and nohup want it."""
    code = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n" + textwrap.dedent("""
        from colmap_sph.app.interruption import stop_on_signals
        with stop_on_signals(print):
            signal.raise_signal(signal.SIGINT)
        print("went on")
    """)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "went on\n"), done.stderr


def test_interruption_while_the_program_loads() -> None:
    code = textwrap.dedent("""
        import signal, sys
        class Late:
            def find_spec(self, name, *_):
                if name == "colmap_sph.app.cli":
                    signal.raise_signal(signal.SIGINT)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.meta_path.insert(0, Late())
        from colmap_sph.__main__ import main
        sys.exit(main())
    """)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


# ---- full disks --------------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("this user may not mount a small file system (needs root)")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture(scope="module")
def uninterrupted(block, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finished workspace of four images."""
    project = tmp_path_factory.mktemp("uninterrupted")
    copy_block(block, project, NAMES)
    complete("--model", project / "sparse/0")
    return project / "dense"


def size_of(dense: Path, *patterns: str) -> int:
    return sum(path.stat().st_size for pattern in patterns for path in dense.glob(pattern) if path.is_file())


# What fits, as a part of what the stage writes, for each stage in its turn.
WRITTEN = [
    ("undistort", ["images/*", "sparse/*"]),
    ("pairs", ["colmap_sph/pairs/*/*"]),
    ("photometric depth", ["colmap_sph/photometric/*"]),
    ("geometric maps", ["stereo/*/*.geometric.bin"]),
    ("cloud", ["fused*"]),
]


@pytest.mark.parametrize("stage", range(len(WRITTEN)), ids=[name for name, _ in WRITTEN])
def test_full_disk(stage: int, uninterrupted: Path, small_disk: Path) -> None:
    """One sentence, nothing half-written, and the work goes on when there is space."""
    model = uninterrupted.parent / "sparse/0"
    dense = small_disk / "dense"
    fits = sum(size_of(uninterrupted, *patterns) for _, patterns in WRITTEN[:stage])
    # Files take whole pages, and the state some more.
    room = fits + size_of(uninterrupted, *WRITTEN[stage][1]) // 2 + 60 * 4096
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(shutil.disk_usage(small_disk).free - room))
    with start("--model", model, "--output", dense) as process:
        said, _ = process.communicate()
    assert process.returncode == 3, said
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith("error: ")
    assert "free some space" in said or "No space left" in said
    assert not list(small_disk.rglob("*.tmp"))
    assert not (dense / "fused.ply").exists()
    truth = maps(uninterrupted)
    assert {name: content for name, content in maps(dense).items() if truth[name] != content} == {}
    done = {path: path.stat().st_mtime_ns for path in dense.glob("colmap_sph/p*/**/*.sph")}
    assert len(done) >= [0, 1, 6, 10, 10][stage]
    ballast.unlink()
    complete("--model", model, "--output", dense)
    assert results(dense) == results(uninterrupted)
    assert {path: path.stat().st_mtime_ns for path in done} == done


def test_read_only_disk(uninterrupted: Path, small_disk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dense = small_disk / "dense"
    shutil.copytree(uninterrupted, dense)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    for more in ([], ["--overwrite"], ["--normals.radius", "3"]):
        code = cli.main(["run", "--workspace", str(dense), *more])
        said = capsys.readouterr().err
        assert code == 3, said
        assert "Read-only file system" in said.splitlines()[-1]
        assert "Traceback" not in said
    assert results(dense) == results(uninterrupted)


def test_files_that_may_not_grow(uninterrupted: Path, tmp_path: Path) -> None:
    """A limit on the size of a file, which the normal maps exceed, for those who cannot mount a full disk."""
    model = uninterrupted.parent / "sparse/0"
    dense = tmp_path / "dense"
    command = [sys.executable, "-P", "-m", "colmap_sph", "run", "--model", str(model), "--output", str(dense)]

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (800_000, 800_000))

    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit)
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    assert "normal_maps" in done.stderr.splitlines()[-1]
    assert "File too large" in done.stderr.splitlines()[-1]
    assert not list(dense.rglob("*.tmp"))
    assert not list(dense.glob("stereo/normal_maps/*.bin"))
    complete("--model", model, "--output", dense)
    assert results(dense) == results(uninterrupted)


def test_a_model_that_may_not_grow(tmp_path: Path) -> None:
    """COLMAP does not notice that the system cuts off its model: no fault of the one that it was made from."""
    copy_four_images(tmp_path)
    dense = tmp_path / "dense"
    command = [sys.executable, "-P", "-m", "colmap_sph", "run", "--model", str(tmp_path / "sparse/0")]

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_480, 20_480))

    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit)
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    assert "ulimit -f" in done.stderr.splitlines()[-1]
    assert not (dense / "sparse").exists()


@pytest.mark.parametrize("seconds", [0.15, 0.4, 0.6, 0.8, 1.0])
def test_an_end_while_the_program_loads_is_quiet(seconds: float) -> None:
    """COLMAP's library, once loaded, would print its stack."""
    process = started([sys.executable, "-P", "-m", "colmap_sph", "run", "--help-all"])
    time.sleep(seconds)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=20)[0]
    assert process.returncode in (143, -signal.SIGTERM, 0)
    assert "Aborted at" not in said and "SIGTERM" not in said and "Traceback" not in said


def test_colmaps_library_leaves_the_signal_to_us() -> None:
    """The moment after it is loaded, without waiting for it."""
    code = textwrap.dedent(
        """
        import os, signal, sys
        from colmap_sph import __main__
        __main__._load_colmap()
        os.kill(os.getpid(), signal.SIGTERM)
        """
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "")
