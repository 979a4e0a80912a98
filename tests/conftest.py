"""Fixtures shared by all tests."""

import os
import shutil
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pycolmap
import pytest
from hypothesis import HealthCheck, settings

import colmap_sph
from colmap_sph.project.undistortion.process import ChildProcess
from colmap_sph.synthetic import BlockOptions, DemoBlock, make_demo_block

SMALL_BLOCK = BlockOptions(
    width=320, height=240, nadir_gsd=0.2, oblique_gsd=0.22, strip_images=3, oblique_images=1, points=1500
)
IMAGES = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg"]
"""Three of the block's, in a row: what `small` has."""

_CALL = ChildProcess.call
_START_FOR = ChildProcess.start_for
SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"

# On a busy machine nothing fails for being slow.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """What was written goes to the process that collects reports, and that takes no half characters."""
    report = yield
    report.sections = [(name, text.encode(errors="backslashreplace").decode()) for name, text in report.sections]
    return report


@pytest.fixture(scope="session", autouse=True)
def without_child_processes() -> Iterator[None]:
    """COLMAP works in the tests' own process: a process of its own takes longer to start than most of its work."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ChildProcess, "call", lambda _, function, argument, what: function(argument))
        patch.setattr(ChildProcess, "start_for", lambda _, function: None)
        yield


@pytest.fixture
def with_child_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """COLMAP works in a process of its own, as it does for users."""
    monkeypatch.setattr(ChildProcess, "call", _CALL)
    monkeypatch.setattr(ChildProcess, "start_for", _START_FOR)


@pytest.fixture
def scripts_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Benchmarks and studies can be imported."""
    monkeypatch.syspath_prepend(str(SCRIPTS))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real data; the test is skipped where it is absent."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    folder = Path(os.environ.get("COLMAP_SPH_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}; set COLMAP_SPH_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def block(tmp_path_factory: pytest.TempPathFactory) -> DemoBlock:
    """A small rendered block of six vertical and four oblique pictures; not to be changed."""
    return make_demo_block(tmp_path_factory.mktemp("block"), SMALL_BLOCK, threads=2)


@pytest.fixture
def project(block: DemoBlock, tmp_path: Path) -> Path:
    """A copy of the block's images and model, to do with as a test likes."""
    copy_block(block, tmp_path)
    return tmp_path


@pytest.fixture
def small(project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project of three images, which is also the current folder."""
    keep_images(project, IMAGES)
    monkeypatch.chdir(project)
    return project


@dataclass(frozen=True)
class FinishedRun:
    """A run with default options: its workspace, and its report."""

    dense: Path
    report: colmap_sph.RunReport


@pytest.fixture(scope="session")
def finished(block: DemoBlock, tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    """The small block reconstructed with default options; not to be changed."""
    dense = tmp_path_factory.mktemp("finished") / "dense"
    return FinishedRun(dense, colmap_sph.run(block.sparse_dir, output=dense))


def copy_block(block: DemoBlock, project: Path, names: Sequence[str] | None = None) -> None:
    """Copy a block's images and model; where `names` are given, only these images stay registered."""
    shutil.copytree(block.images_dir, project / "images")
    shutil.copytree(block.root / "sparse", project / "sparse")
    if names is not None:
        keep_images(project, names)


def keep_images(project: Path, names: Sequence[str]) -> None:
    """Leave only images `names` registered in a project's model."""
    model = pycolmap.Reconstruction(project / "sparse" / "0")
    for image_id in list(model.reg_image_ids()):
        image = model.image(image_id)
        if image.name not in names:
            model.deregister_frame(image.frame_id)
    model.write(project / "sparse" / "0")


@contextmanager
def no_room_beyond(size: int) -> Iterator[None]:
    """As on a disk that gets full: no file can be longer."""
    import resource  # which Windows does not have

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
