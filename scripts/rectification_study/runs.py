"""One reconstruction per surface of rectification, in a process of its own, with the cost of every stage."""

import json
import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import colmap_sph
from colmap_sph.errors import InputError, NoResultError, OutputError
from colmap_sph.evaluation import write_json
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report import Silent
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.rectified_pair import Surface

_NOTHING: dict[str, Any] = {"coverage": {}, "points": 0, "skipped_pairs": {}}
SURFACES: tuple[Surface, ...] = ("frame", "spherical")


@dataclass(frozen=True, eq=False)
class Run:
    """A finished reconstruction.

    Attributes
    ----------
    workspace : Workspace
    report : dict
        The pipeline's report.
    cost : dict
        Stage → seconds, cpu_seconds, peak_bytes (of that stage alone).
    failure : str
        Why there is no result, and nothing in the workspace; "" where there is one.
    """

    workspace: Workspace
    report: dict[str, Any]
    cost: dict[str, dict[str, float]]
    failure: str = ""

    def points(self) -> dict[str, Any]:
        """What the paper counts as points: per image its pixels with a geometric depth; and the fused cloud."""
        pixels = {}
        for name in sorted(self.report["coverage"]):
            pixels[name] = int((read_depth_map(self.workspace.depth_map_path(name, "geometric")) > 0).sum())
        return {"pixels_per_image": pixels, "fused": int(self.report["points"])}


class StageMeter(Silent):
    """Progress of a run that notes every stage's time, processor time and peak memory."""

    def __init__(self, label: str) -> None:
        self.label = label
        self.cost: dict[str, dict[str, float]] = {}
        self._stage = ""

    def start(self, stage: str, total: int) -> None:
        """A stage begins: the one before it is done."""
        self.finish()
        print(f"{self.label}: {stage} ({total})", flush=True)
        self._stage = stage
        self._started = time.perf_counter()
        self._cpu_started = time.process_time()
        # Linux: forget the peak so far. Where that is not allowed peaks are those since the start.
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")

    def finish(self) -> None:
        """The last stage is done."""
        if self._stage:
            status = Path("/proc/self/status").read_text().splitlines()
            peak = next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmHWM"))
            seconds, cpu = time.perf_counter() - self._started, time.process_time() - self._cpu_started
            self.cost[self._stage] = {"seconds": seconds, "cpu_seconds": cpu, "peak_bytes": peak}
        self._stage = ""


def reconstruct(model: Path, images: Path | None, folder: Path, options: RunOptions, surface: Surface) -> Run:
    """Reconstruct in ``folder/dense``, or take what an earlier study with the same options left there.

    Raises
    ------
    InputError
        The folder holds a study of another model or with other options.
    OutputError
        The folder is not empty and not a study's.
    """
    options = replace(options, rectification=replace(options.rectification, surface=surface))
    asked = {"model": str(Path(model).resolve()), "options": plain(options)}
    record = folder / "run.json"
    if not record.is_file():
        _make_empty(folder)
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as child:
            done = child.submit(_reconstruct, model, images, folder / "dense", options).result()
        write_json(record, {**asked, **done})
    content = json.loads(record.read_text(encoding="utf-8"))
    if {key: content[key] for key in asked} != asked:
        raise InputError(f"{folder} holds a study of another model or with other options; give another --output.")
    return Run(Workspace(folder / "dense"), content["report"], content["cost"], content["failure"])


def plain(record: Any) -> dict[str, Any]:
    """A dataclass as values that JSON knows."""
    return dict(json.loads(json.dumps(asdict(record), default=str)))


def _make_empty(folder: Path) -> None:
    """An interrupted run is begun anew: its times would mean nothing."""
    if folder.is_dir() and {path.name for path in folder.iterdir()} - {"dense"}:
        raise OutputError(f"{folder} holds other files; give another --output.")
    shutil.rmtree(folder / "dense", ignore_errors=True)
    folder.mkdir(exist_ok=True)


def _reconstruct(model: Path, images: Path | None, root: Path, options: RunOptions) -> dict[str, Any]:
    """In the child process: run and measure."""
    meter = StageMeter(options.rectification.surface)
    failure = ""
    report = _NOTHING
    try:
        report = plain(colmap_sph.run(model, images=images, output=root, options=options, progress=meter))
    except NoResultError as error:
        # Not one pair can be rectified on a plane where the cameras go where they look: a finding, too.
        failure = str(error)
    meter.finish()
    return {"report": report, "cost": meter.cost, "failure": failure}
