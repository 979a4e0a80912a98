"""Seconds, processor seconds and peak memory of whole runs, by image size, threads and pairs.

    python scripts/bench_pipeline.py --model sparse/0 --sizes 800 1600 0 --threads 1 2 --num-pairs 10

Every combination runs `colmap_sph run` as a process of its own, into a new folder which is removed afterwards. The
system may have read the input files before and still hold them in memory. Ratios are against the first row.
"""

import argparse
import itertools
import json
import math
import statistics
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarking import PARTIAL_EXIT_CODE, machine, run_process, table

# A process's peak memory begins, for the system, with that of the process that started it: import nothing large.


@dataclass(frozen=True)
class Setting:
    """Options of a run: longest side of its images (0: full size), worker threads, partners of each image."""

    size: int
    threads: int
    num_pairs: int


@dataclass(frozen=True)
class Measured:
    """What a run took.

    Attributes
    ----------
    wall, processor : float
        Seconds; those of the processor are of all threads.
    peak_memory : int
        Largest resident set, bytes, as the system counted it.
    stages : dict
        Stage → seconds, from the run's report.
    images, pairs, pixels : int
        Images with depth maps, pairs matched, pixels of all depth maps.
    """

    wall: float
    processor: float
    peak_memory: int
    stages: dict[str, float]
    images: int
    pairs: int
    pixels: int


def command() -> list[str]:
    """The installed command beside this Python, else the package's module."""
    script = Path(sys.executable).parent / "colmap_sph"
    return [str(script)] if script.is_file() else [sys.executable, "-P", "-m", "colmap_sph"]


def depth_map_pixels(workspace: Path) -> int:
    """Pixels of all geometric depth maps, from the headers ``width&height&channels&``."""
    pixels = 0
    for path in (workspace / "stereo" / "depth_maps").rglob("*.geometric.bin"):
        with path.open("rb") as file:
            width, height = file.read(64).split(b"&")[:2]
        pixels += int(width) * int(height)
    return pixels


def measure(model: Path, images: Path | None, setting: Setting) -> Measured:
    """One run into a folder of its own; ends the program if it fails."""
    with tempfile.TemporaryDirectory(prefix="bench_pipeline_") as folder:
        workspace = Path(folder) / "dense"
        log = Path(folder) / "output.txt"
        arguments = [*command(), "run", "--model", str(model), "--output", str(workspace)]
        arguments += ["--threads", str(setting.threads), "--num-pairs", str(setting.num_pairs)]
        arguments += ["--images", str(images)] if images else []
        arguments += ["--max-image-size", str(setting.size)] if setting.size else []
        code, wall, processor, peak = run_process(arguments, log)
        if code not in (0, PARTIAL_EXIT_CODE):
            said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:] or ["no message"]
            sys.exit(f"error: `{' '.join(arguments)}` ended with exit code {code}: {said[0]}")
        report = json.loads((workspace / "colmap_sph" / "report.json").read_text(encoding="utf-8"))
        pixels = depth_map_pixels(workspace)
        return Measured(wall, processor, peak, report["seconds"], report["images"], report["pairs"], pixels)


def median_run(measured: Sequence[Measured]) -> Measured:
    """The run with the median wall time (of an even number, the slower of the two)."""
    return sorted(measured, key=lambda run: run.wall)[len(measured) // 2]


# ---- what the numbers say ----------------------------------------------------------------------------------


def exponent(pixels: Sequence[float], seconds: Sequence[float]) -> float:
    """Exponent e of seconds = constant * pixels ** e, fitted to the logarithms."""
    return statistics.linear_regression([math.log(p) for p in pixels], [math.log(s) for s in seconds]).slope


def results_table(results: dict[Setting, Measured]) -> str:
    """One row per setting; ratios of wall, processor seconds and memory are against the first."""
    stages = list(dict.fromkeys(stage for run in results.values() for stage in run.stages))
    header = ["size", "threads", "num pairs", "images", "pairs", "megapixels", *(f"{s}, s" for s in stages)]
    header += ["wall, s", "ratio", "processor, s", "ratio", "peak memory, GiB", "ratio"]
    first = next(iter(results.values()))
    rows = []
    for setting, run in results.items():
        row = [str(setting.size or "full"), str(setting.threads or "all"), str(setting.num_pairs)]
        row += [str(run.images), str(run.pairs), f"{run.pixels / 1e6:.2f}"]
        row += [f"{run.stages[s]:.2f}" if s in run.stages else "-" for s in stages]
        row += [f"{run.wall:.2f}", f"{run.wall / first.wall:.2f}"]
        row += [f"{run.processor:.2f}", f"{run.processor / first.processor:.2f}"]
        row += [f"{run.peak_memory / 2**30:.2f}", f"{run.peak_memory / first.peak_memory:.2f}"]
        rows.append(row)
    return table(header, rows)


def groups(
    results: dict[Setting, Measured], key: Callable[[Setting], tuple[int, int]]
) -> list[tuple[tuple[int, int], list[tuple[Setting, Measured]]]]:
    """Results with equal keys together, where there is more than one."""
    ordered = sorted(results.items(), key=lambda item: key(item[0]))
    together = [(k, list(items)) for k, items in itertools.groupby(ordered, key=lambda item: key(item[0]))]
    return [(k, items) for k, items in together if len(items) > 1]


def growth_lines(results: dict[Setting, Measured]) -> list[str]:
    """How time grows with pixels, one line per number of threads and pairs."""
    lines = []
    for (threads, num_pairs), items in groups(results, lambda s: (s.threads, s.num_pairs)):
        runs = [run for _, run in items]
        pixels = [run.pixels for run in runs]
        if len(set(pixels)) < 2:
            continue
        wall, processor = (exponent(pixels, [getattr(r, name) for r in runs]) for name in ("wall", "processor"))
        lines.append(
            f"{threads or 'all'} threads, {num_pairs} pairs: wall time grows with pixels ** {wall:.2f}, "
            f"processor time with pixels ** {processor:.2f}"
        )
    return lines


def speedup_lines(results: dict[Setting, Measured]) -> list[str]:
    """What more threads bring, one line per size and number of pairs."""
    lines = []
    for (size, num_pairs), items in groups(results, lambda s: (s.size, s.num_pairs)):
        # 0 stands for all cores: the most.
        (least, base), *others = sorted(items, key=lambda item: item[0].threads or math.inf)
        gains = [f"{base.wall / run.wall:.2f} with {s.threads or 'all'} threads" for s, run in others]
        lines.append(f"size {size or 'full'}, {num_pairs} pairs: {', '.join(gains)}, against {least.threads}")
    return lines


def main() -> None:
    """Run every setting, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="COLMAP sparse model")
    parser.add_argument("--images", type=Path, help="original images; default: as `colmap_sph run` finds them")
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[800], help="longest sides in pixels; 0: full size"
    )
    parser.add_argument("--threads", type=int, nargs="+", default=[0], help="worker threads; 0: all cores")
    parser.add_argument("--num-pairs", type=int, nargs="+", default=[10], help="partners of each image, at most")
    parser.add_argument("--runs", type=int, default=1, help="runs of each setting; the median one is shown")
    arguments = parser.parse_args()
    if arguments.runs < 1:
        parser.error(f"--runs must be at least 1, not {arguments.runs}")
    print(f"{machine()}; {arguments.model}, median of {arguments.runs} runs\n", flush=True)
    results = {}
    for values in itertools.product(arguments.sizes, arguments.threads, arguments.num_pairs):
        setting = Setting(*values)
        runs = [measure(arguments.model, arguments.images, setting) for _ in range(arguments.runs)]
        results[setting] = median_run(runs)
    print(results_table(results))
    for title, lines in (("Growth", growth_lines(results)), ("Speed-up", speedup_lines(results))):
        if lines:
            print(f"\n{title}\n\n" + "\n".join(f"- {line}" for line in lines))


if __name__ == "__main__":
    main()
