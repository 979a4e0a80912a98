"""Processor seconds and memory of all but the work itself, for blocks of more and more images.

    python scripts/bench_growth.py --images 500 2000 8000 --output FOLDER
    python scripts/bench_growth.py --reads 10000

Blocks of 64 x 48 pixels are written as dense workspaces, filled with results that nobody worked out (see
`growth.finished`), and run in again: what is measured is what the program does before, between and after its work.
Exponents are slopes of logarithms between the least and the most images, less what a run of six images takes.
"""

import argparse
import json
import math
import os
import shutil
import sys
from pathlib import Path

from benchmarking import machine, run_process, table

# A process's peak memory begins, for the system, with that of the process that started it: import nothing large.

_HERE = Path(__file__).parent
_STEPS = ("read", "select", "fusion's partners", "order")
_RUNS = ("dry run, nothing there", "no-op run", "dry run, all there")
_MEGAPIXELS = 12
_FEWEST = 6
_CACHE = 10e9


def _python(log: Path, *arguments: str) -> tuple[float, int]:
    """Processor seconds and peak memory of this Python with arguments; ends the program where it fails."""
    os.environ["PYTHONPATH"] = os.pathsep.join([str(_HERE), os.environ.get("PYTHONPATH", "")])
    code, _, processor, peak = run_process([sys.executable, "-P", *arguments], log)
    if code:
        sys.exit(f"{' '.join(arguments)} failed:\n{log.read_text()[-2000:]}")
    return processor, peak


def measure(images: int, observations: int, folder: Path) -> dict[str, tuple[float, int]]:
    """Processor seconds and peak memory of each step and run, for one block."""
    workspace = folder / f"block-{images}"
    shutil.rmtree(workspace, ignore_errors=True)
    log = folder / "log.txt"
    _python(log, "-m", "growth.blocks", str(workspace), str(images), str(observations))
    run = ("-m", "colmap_sph", "run", "--workspace", str(workspace), "--threads", "1")
    found = {_RUNS[0]: _python(log, *run, "--dry-run")}
    _python(log, "-m", "growth.steps", str(workspace), str(folder / "steps.json"))
    found |= {step: (seconds, 0) for step, seconds in json.loads((folder / "steps.json").read_text()).items()}
    _python(log, "-m", "growth.finished", str(workspace))
    found[_RUNS[1]] = _python(log, *run)
    found[_RUNS[2]] = _python(log, *run, "--dry-run")
    shutil.rmtree(workspace)
    return found


def rows_of(
    measured: dict[int, dict[str, tuple[float, int]]], fewest: dict[str, tuple[float, int]]
) -> list[list[str]]:
    """What the table says of each step and run; of runs what the fewest images take does not count as growth."""
    few, *_, many = measured
    rows = []
    for step in (*_STEPS, *_RUNS):
        seconds = [measured[images][step][0] for images in measured]
        start = fewest[step][0] if step in _RUNS else 0.0  # mostly to import the program
        slope = math.log((seconds[-1] - start) / (seconds[0] - start)) / math.log(many / few)
        memory = (measured[many][step][1] - measured[few][step][1]) / (many - few)
        told = f"{memory / 1e6:.3f}" if step in _RUNS else ""
        rows.append([step, *(f"{each:.1f}" for each in seconds), f"{slope:.2f}", told])
    return rows


def main() -> None:
    """Measure, and print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, nargs="+", default=[500, 2000, 8000], metavar="N")
    parser.add_argument("--observations", type=int, default=500, help="of sparse points, of each image")
    parser.add_argument(
        "--reads", type=int, metavar="N", help="simulate reads of maps instead, of a block of N images"
    )
    parser.add_argument("--output", type=Path, default=Path("growth"), help="folder to work in")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    print(machine())
    if arguments.reads:
        told = arguments.output / "reads.json"
        _python(arguments.output / "log.txt", "-m", "growth.steps", "--reads", str(arguments.reads), str(told))
        header = ["", "in the order of place", "in the order of names"]
        print(f"reads of each view's maps, {_MEGAPIXELS} megapixels, {_CACHE / 1e9:g} GB of cache\n")
        print(
            table(
                header,
                [[step, *(f"{x:.2f}" for x in both)] for step, both in json.loads(told.read_text()).items()],
            )
        )
        return
    fewest = measure(_FEWEST, arguments.observations, arguments.output)
    measured = {}
    for images in sorted(arguments.images):
        measured[images] = measure(images, arguments.observations, arguments.output)
        print(images, {step: round(seconds, 1) for step, (seconds, _) in measured[images].items()}, flush=True)
    header = ["processor seconds", *(f"{images} images" for images in measured), "exponent", "MB per image"]
    print(f"\n{table(header, rows_of(measured, fewest))}")


if __name__ == "__main__":
    main()
