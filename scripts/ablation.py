"""What each idea is worth: whole runs with one thing changed at a time, as a Markdown table.

    python scripts/ablation.py --model SPARSE --output FOLDER [--reference DEPTHS --depth-scale S --gsd G]

Every variant starts from a copy of the default run and redoes only what depends on its option, so that hours
become minutes; the seconds are those of the stages made anew. With exact depth maps
(--reference) coverage, shares of right depths, and accuracy, completeness and F-score of the cloud are given;
without them the distance of the cloud from the sparse points that five images or more track within 0.7 pixels.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from benchmarking import PARTIAL_EXIT_CODE, machine, table
from scipy.spatial import cKDTree

from colmap_sph.scene import POINT

_VARIANTS: dict[str, list[str]] = {
    "default": ["--overwrite"],
    "not refined on the images": ["--refinement.rounds", "0"],
    "refined once": ["--refinement.rounds", "1"],
    "fusion by COLMAP": ["--fusion.method", "colmap"],
    "three images must agree on a point": ["--fusion.min-num-pixels", "3"],
    "what one view confirms needs no surface around it": ["--confirm.min-surface", "0"],
    "one confirming view is enough": ["--confirm.min-consistent", "1"],
    "three confirming views": ["--confirm.min-consistent", "3"],
    "depths off their plane or glanced at stay": ["--normals.max-shift", "1e9", "--normals.max-incidence", "90"],
    "only a right pixel's best match passes the left-right check": ["--matching.max-left-right-excess", "0"],
    "only a right pixel's best match passes it above full resolution": [
        "--matching.max-coarse-left-right-excess",
        "0",
    ],
    "matches that are worse by 48 pass the left-right check": ["--matching.max-left-right-excess", "48"],
    "a median of disparities at full resolution": ["--matching.median-filter", "True"],
    "what a single pair says contradicts, too": ["--confirm.min-contradicting-support", "1"],
    "P1 is 18, P2 falls over 16 grey values": ["--matching.p1", "18", "--matching.p2-contrast", "16"],
    "rectified 1.2 times as fine": ["--rectification.sampling", "1.2"],
    "ranges do not follow slopes": ["--matching.max-slant", "0"],
    "64 disparities": ["--matching.disparities", "64"],
    "five pairs": ["--num-pairs", "5"],
    "planar rectification": ["--rectification.surface", "frame"],
}
_MIN_TRACK = 5
_MAX_ERROR = 0.7


def run(command: list[str]) -> None:
    """Run the program; end with its message where it fails."""
    done = subprocess.run([sys.executable, "-m", "colmap_sph", *command], capture_output=True, text=True)
    if done.returncode not in (0, PARTIAL_EXIT_CODE):
        sys.exit(f"colmap_sph {' '.join(command)} failed:\n{done.stdout}{done.stderr}")


def measure(arguments: argparse.Namespace, name: str, options: list[str]) -> list[str]:
    """Run a variant, from the default's results but for the default itself; its row of the table."""
    folder = arguments.output / name.replace(" ", "-").replace(",", "")
    if name != "default" and not folder.exists():
        # The program replaces all files but its log, into which it writes.
        shutil.copytree(
            arguments.output / "default",
            folder,
            copy_function=lambda a, b: Path(b).hardlink_to(a),
            ignore=shutil.ignore_patterns("log.txt"),
        )
    size = ["--max-image-size", str(arguments.max_image_size)]
    run(["run", "--model", str(arguments.model), "--output", str(folder), *size, *options])
    report = json.loads((folder / "colmap_sph" / "report.json").read_text())
    seconds = sum(report["seconds"][stage] for stage, made in report["made"].items() if made)
    score = exact_scores if arguments.reference else sparse_scores
    return [name, f"{seconds:.0f}", f"{report['points']:,}", *score(arguments, folder, report)]


def exact_scores(arguments: argparse.Namespace, folder: Path, _report: dict[str, Any]) -> list[str]:
    """Against exact depth maps."""
    file = folder / "scores.json"
    cloud = ["evaluate", str(folder / "fused.ply"), "--workspace", str(folder), "--json", str(file)]
    truth = ["--reference", str(arguments.reference), "--depth-scale", str(arguments.depth_scale)]
    run([*cloud, *truth, "--gsd", str(arguments.gsd)])
    scores = json.loads(file.read_text())
    maps = scores["depth_maps"]["mean"]
    cloud_scores = scores["clouds"][0]["thresholds"]
    rows = [[f"{100 * one[k]:.1f}" for one in cloud_scores] for k in ("accuracy", "completeness", "f_score")]
    means = [maps["coverage"], *maps["within"][:2]]
    return [*(f"{100 * mean:.1f}" for mean in means), *(" / ".join(row) for row in rows)]


def sparse_scores(arguments: argparse.Namespace, folder: Path, report: dict[str, Any]) -> list[str]:
    """Against well-tracked sparse points."""
    model = pycolmap.Reconstruction(arguments.model)
    known = [p.xyz for p in model.points3D.values() if p.track.length() >= _MIN_TRACK and p.error < _MAX_ERROR]
    body = (folder / "fused.ply").read_bytes().partition(b"end_header\n")[2]
    distance, _ = cKDTree(np.frombuffer(body, POINT)["xyz"].astype(float)).query(np.array(known))
    coverage = np.mean(list(report["coverage"].values()))
    near = [f"{100 * np.mean(distance < limit):.1f}" for limit in (0.005, 0.01)]
    return [f"{100 * coverage:.1f}", f"{1000 * np.median(distance):.2f}", " / ".join(near)]


def main() -> None:
    """Run the variants, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, required=True, help="COLMAP sparse model, images beside or above it")
    parser.add_argument("--output", type=Path, required=True, help="folder for the workspaces; grows large")
    parser.add_argument("--max-image-size", type=int, default=-1)
    parser.add_argument("--reference", type=Path, help="folder of exact depth maps, as for colmap_sph evaluate")
    parser.add_argument("--depth-scale", type=float, default=1.0)
    parser.add_argument("--gsd", type=float, default=1.0)
    parser.add_argument("--only", nargs="*", choices=list(_VARIANTS), help="these variants, beside the default")
    arguments = parser.parse_args()
    truth = ["coverage %", "< 1 GSD %", "< 2 GSD %", "accuracy 1 / 2 / 4 GSD", "completeness", "F"]
    if not arguments.reference:
        truth = ["coverage %", "median to sparse points, mm", "within 5 / 10 mm, %"]
    rows = []
    for name, options in _VARIANTS.items():
        if name == "default" or not arguments.only or name in arguments.only:
            rows.append(measure(arguments, name, options))
            print(rows[-1], file=sys.stderr)
    print(f"{machine()}\n\n{table(['variant', 'seconds', 'points', *truth], rows)}")


if __name__ == "__main__":
    main()
