"""What a dry run foresees against what the run then takes, stage by stage.

    python scripts/calibrate_plan.py --output FOLDER --scene block=block/sparse/0 --scene wall=wall/sparse/0@1536

Every scene is planned and then run from scratch, with one thread and with all cores. Seconds are compared stage by
stage with one thread, as the constants in `pipeline/stages/` are processor seconds; the last
table says by what to multiply those of each stage so that this machine's runs come out right.
"""

import argparse
import json
import math
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench_pipeline import command
from benchmarking import PARTIAL_EXIT_CODE, machine, run_process, table
from compare_revisions import Scene, parse_scene

_PLAN = """
import dataclasses, json, sys
from pathlib import Path
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.project.project import Project
from colmap_sph.project.undistortion import UndistortionOptions
model, images, output, size, threads = json.loads(sys.argv[1])
project = Project(Path(model), images and Path(images), output=Path(output))
options = RunOptions(threads=threads, undistortion=UndistortionOptions(size))
print(json.dumps(dataclasses.asdict(make_plan(project, options))))
"""


@dataclass(frozen=True)
class Comparison:
    """A plan, as plain values, and what the run took: seconds by stage and in all, bytes in memory and on disk."""

    scene: str
    threads: int
    plan: dict[str, Any]
    stages: dict[str, float]
    seconds: float
    memory: float
    disk: float


def compare(scene: Scene, folder: Path, threads: int) -> Comparison:
    """Plan a scene and run it from scratch in a new folder; ends the program if that fails."""
    folder.mkdir(parents=True)
    dense = scene.workspace(folder)
    images = None if scene.images is None else str(scene.images)
    given = [str(scene.model), images, str(dense), scene.max_image_size or -1, threads]
    _run([sys.executable, "-P", "-c", _PLAN, json.dumps(given)], folder / "plan.txt")
    plan = json.loads((folder / "plan.txt").read_text().splitlines()[-1])
    wall, _, peak = _run([*command(), *scene.arguments(folder, threads)], folder / "run.txt")
    report = json.loads((dense / "colmap_sph" / "report.json").read_text())
    files = [path for path in dense.rglob("*") if path.is_file() and not path.is_symlink()]
    disk = sum(path.stat().st_size for path in files)
    shutil.rmtree(dense)
    return Comparison(scene.name, threads, plan, report["seconds"], wall, peak, disk)


def _run(arguments: Sequence[str], log: Path) -> tuple[float, float, int]:
    code, wall, processor, peak = run_process(arguments, log)
    if code not in (0, PARTIAL_EXIT_CODE):
        raise SystemExit(f"exit code {code}; see {log}")
    return wall, processor, peak


def totals(comparisons: Sequence[Comparison]) -> str:
    """Planned, measured and their ratio: of seconds, memory and disk."""
    rows = []
    for each in comparisons:
        measured = {"seconds": each.seconds, "memory": each.memory, "disk": each.disk}
        row = [f"{each.scene}, {each.threads} threads"]
        for name, value in measured.items():
            planned = each.plan[name]
            unit = 1 if name == "seconds" else 1e6
            row.append(f"{planned / unit:.1f} / {value / unit:.1f} = {planned / value:.2f}")
        rows.append(row)
    return table(["scene", "seconds, planned / measured", "memory, MB", "disk, MB"], rows)


def factors(comparisons: Sequence[Comparison]) -> str:
    """Of runs with one thread: measured by planned seconds of each stage, by scene, and their geometric mean."""
    single = [each for each in comparisons if each.threads == 1]
    rows = []
    for name in [stage["name"] for stage in single[0].plan["stages"]]:
        ratios = []
        for each in single:
            (planned,) = (stage["seconds"] for stage in each.plan["stages"] if stage["name"] == name)
            ratios.append(each.stages[name] / planned)
        mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
        rows.append([name, *(f"{ratio:.2f}" for ratio in ratios), f"{mean:.2f}"])
    return table(["stage", *(each.scene for each in single), "multiply by"], rows)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scene", action="append", type=parse_scene, required=True, metavar="NAME=MODEL[:IMAGES][@SIZE]"
    )
    parser.add_argument("--output", type=Path, required=True, help="new folder for the workspaces and logs")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 0])
    arguments = parser.parse_args()
    comparisons = [
        compare(scene, arguments.output / f"{scene.name}-{threads}", threads)
        for scene in arguments.scene
        for threads in arguments.threads
    ]
    print(f"{machine()}\n\n{totals(comparisons)}\n")
    if 1 in arguments.threads:
        print(factors(comparisons))


if __name__ == "__main__":
    main()
