"""Two revisions of this program on the same scenes: do they give the same bytes, and what do they take?

    python scripts/compare_revisions.py BEFORE AFTER --output FOLDER --demo
    python scripts/compare_revisions.py main . --output FOLDER --scene block=sparse/0:images@800 --rounds 3

BEFORE and AFTER are git revisions, or `.` for the working tree. Each is checked out into FOLDER and installed
there in a virtual environment of its own; the repository and the environment of this Python stay as they are, and
the latter need not have the package. Every scene is run from scratch with both, by turns (before, after, before,
after, …), and after each turn maps and clouds are compared byte for byte. The workspaces of the last round, the
logs and both environments stay in FOLDER.

Exit code 0: all identical; 1: something differs; 2: something failed. Times and memory are told, not judged.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tarfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shutil import copy2, rmtree
from typing import Any, NoReturn

from benchmarking import PARTIAL_EXIT_CODE, machine, run_process, table

# From the standard library alone, for two reasons: any Python can run it, and a process's peak memory begins, for
# the system, with that of the process that started it.

_SCRIPTS = Path(__file__).resolve().parent
_REPOSITORY = _SCRIPTS.parent
_MAX_NAMED = 20  # files that differ, of each scene
_SIDES = ("before", "after")
_MAY_REDIRECT = ("PYTHONPATH", "PYTHONHOME", "PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_USER")


@dataclass(frozen=True)
class Scene:
    """What is run: a sparse model, or the demo where `model` is None."""

    name: str
    model: Path | None
    images: Path | None = None
    max_image_size: int | None = None

    def arguments(self, folder: Path, threads: int) -> list[str]:
        """Of the command `colmap_sph`, with options that every revision has; it may write into `folder`."""
        common = ["--threads", str(threads)]
        if self.model is None:
            return ["demo", "--output", str(folder), *common]
        given = ["--model", str(self.model), "--output", str(self.workspace(folder))]
        given += ["--images", str(self.images)] if self.images else []
        given += ["--max-image-size", str(self.max_image_size)] if self.max_image_size else []
        return ["run", *given, *common]

    def workspace(self, folder: Path) -> Path:
        """The dense workspace that these arguments make."""
        return folder / "dense"


@dataclass(frozen=True)
class Cost:
    """What a run took: seconds, processor seconds of all its threads, largest resident set in bytes."""

    wall: float
    processor: float
    peak_memory: int


def parse_scene(text: str) -> Scene:
    """A scene from ``NAME=MODEL[:IMAGES][@MAX_IMAGE_SIZE]``."""
    found = re.fullmatch(r"([\w.-]+)=([^:]+?)(?::([^:]+?))?(?:@(\d+))?", text)
    if not found or found[1] == "demo":
        raise argparse.ArgumentTypeError(f"not NAME=MODEL[:IMAGES][@MAX_IMAGE_SIZE]: {text}")
    model, images = (Path(part).resolve() if part else None for part in found.group(2, 3))
    return Scene(found[1], model, images, int(found[4]) if found[4] else None)


def fail(sentence: str) -> NoReturn:
    """End the program: what was to be compared could not be made."""
    print(f"error: {sentence}", file=sys.stderr)
    raise SystemExit(2)


# ---- the two revisions -------------------------------------------------------------------------------------


def git(*arguments: str) -> str:
    """What git says of this repository; ends the program where it refuses."""
    done = subprocess.run(["git", "-C", str(_REPOSITORY), *arguments], capture_output=True, text=True)
    if done.returncode:
        fail(f"git {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout


def check_out(revision: str, folder: Path) -> str:
    """Write a revision's files into a new folder; returns what it is called in the report."""
    folder.mkdir(parents=True)
    described = git("log", "-1", "--format=%h %s", "HEAD" if revision == "." else revision, "--").strip()
    if revision == ".":
        for name in git("ls-files", "-z", "--cached", "--others", "--exclude-standard").split("\0"):
            source = _REPOSITORY / name
            if source.is_file():  # the index may name files that are removed
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                copy2(source, folder / name)
        return f"working tree on {described}"
    archive = folder.with_suffix(".tar")
    git("archive", f"--output={archive}", revision)
    with tarfile.open(archive) as files:
        files.extractall(folder, filter="data")
    archive.unlink()
    return described


def install(checkout: Path, environment: Path, log: Path) -> None:
    """Make a virtual environment and install a checkout in it."""
    python = str(environment / "bin" / "python")
    for command in (
        [sys.executable, "-m", "venv", str(environment)],
        [python, "-m", "pip", "install", "--disable-pip-version-check", "--quiet", str(checkout)],
    ):
        code, *_ = run_process(command, log)
        if code:
            fail(f"`{' '.join(command)}` ended with exit code {code}; see {log}")


def other_versions(before: Path, after: Path) -> list[str]:
    """Packages that two environments have in different versions; such may differ whatever our code does."""
    frozen = []
    for environment in (before, after):
        command = [str(environment / "bin" / "python"), "-m", "pip", "list", "--format=json"]
        packages = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        frozen.append({package["name"]: package["version"] for package in packages})
    names = sorted({name for one in frozen for name in one} - {"colmap_sph", "colmap-sph"})
    versions = [(name, *(one.get(name, "none") for one in frozen)) for name in names]
    return [f"{name} {old} before, {new} after" for name, old, new in versions if old != new]


# ---- runs --------------------------------------------------------------------------------------------------


def run_scene(scene: Scene, environment: Path, folder: Path, threads: int) -> Cost:
    """Run a scene from scratch in a folder of its own; ends the program if it fails."""
    if folder.exists():
        rmtree(folder)
    folder.mkdir(parents=True)
    log = folder.parent / f"{folder.name}.log"  # not in the folder, which the demo wants for itself
    command = [str(environment / "bin" / "colmap_sph"), *scene.arguments(folder, threads)]
    code, wall, processor, peak = run_process(command, log)
    if code not in (0, PARTIAL_EXIT_CODE):
        said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:] or ["no message"]
        fail(f"`{' '.join(command)}` ended with exit code {code}: {said[0]}")
    return Cost(wall, processor, peak)


def compare(before: Path, after: Path, python: Path) -> dict[str, Any]:
    """What `compare_workspaces.py` finds, in a process of its own."""
    command = [str(python), str(_SCRIPTS / "compare_workspaces.py"), str(before), str(after), "--json"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode not in (0, 1):
        fail(done.stderr.strip().removeprefix("error: "))
    found: dict[str, Any] = json.loads(done.stdout)
    return found


# ---- what is told ------------------------------------------------------------------------------------------


def identity_table(compared: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """One row per scene: of its rounds the one with the most files that differ."""
    header = ["scene", "files", "MB", "identical", "differ", "bytes", "pixels", "largest depth difference"]
    rows = []
    for scene, rounds in compared.items():
        worst = worst_round(rounds)
        differences = worst["differences"]
        depths = [one["depth"] for one in differences if one["depth"] is not None]
        pixels = sum(one["pixels"] or 0 for one in differences)
        row = [scene, str(worst["files"]), f"{worst['bytes'] / 1e6:.1f}", str(worst["files"] - len(differences))]
        row += [str(len(differences)), f"{sum(one['bytes'] for one in differences):,}", f"{pixels:,}"]
        rows.append([*row, f"{max(depths):.3g}" if depths else "-"])
    return table(header, rows)


def worst_round(rounds: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """The round with the most files that differ."""
    return max(rounds, key=lambda one: len(one["differences"]))


def difference_lines(compared: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """The files of each scene that differ, by name, up to a number."""
    lines = []
    for scene, rounds in compared.items():
        differences = worst_round(rounds)["differences"]
        lines += [f"- {scene}: {one['text']}" for one in differences[:_MAX_NAMED]]
        if len(differences) > _MAX_NAMED:
            lines.append(f"- {scene}: {len(differences) - _MAX_NAMED} more")
    return lines


def cost_table(costs: Mapping[str, Sequence[tuple[Cost, Cost]]]) -> str:
    """Medians over the rounds, and the median of the ratios after / before of each round."""
    quantities: list[tuple[str, Callable[[Cost], float]]] = [
        ("wall, s", lambda cost: cost.wall),
        ("processor, s", lambda cost: cost.processor),
        ("peak memory, GiB", lambda cost: cost.peak_memory / 2**30),
    ]
    header = ["scene", "rounds"]
    for name, _ in quantities:
        header += [f"{name}, before", "after", "ratio"]
    rows = []
    for scene, rounds in costs.items():
        row = [scene, str(len(rounds))]
        for _, of in quantities:
            row += [f"{statistics.median(of(pair[side]) for pair in rounds):.2f}" for side in (0, 1)]
            row.append(f"{statistics.median(of(after) / of(before) for before, after in rounds):.3f}")
        rows.append(row)
    return table(header, rows)


def main() -> int:
    """Install, run, compare, print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", help="git revision, or . for the working tree")
    parser.add_argument("after", help="git revision, or . for the working tree")
    parser.add_argument("--output", type=Path, required=True, help="folder to make; grows large")
    parser.add_argument(
        "--scene",
        dest="scenes",
        type=parse_scene,
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=MODEL[:IMAGES][@MAX_IMAGE_SIZE]",
        help="sparse models, as for `colmap_sph run`",
    )
    parser.add_argument("--demo", action="store_true", help="the built-in example, too")
    parser.add_argument("--rounds", type=int, default=1, help="runs of each scene with each revision")
    parser.add_argument("--threads", type=int, default=0, help="worker threads; 0: all cores")
    arguments = parser.parse_args()
    scenes = [*arguments.scenes, *([Scene("demo", None)] if arguments.demo else [])]
    if not scenes:
        parser.error("give a --scene, or --demo")
    if len({scene.name for scene in scenes}) < len(scenes):
        parser.error("two scenes have the same name")
    if arguments.rounds < 1:
        parser.error(f"--rounds must be at least 1, not {arguments.rounds}")
    output = arguments.output.resolve()
    if output.exists() and any(output.iterdir()):
        fail(f"{output} is not empty; choose another --output")
    for name in _MAY_REDIRECT:
        os.environ.pop(name, None)

    print(f"{machine()}\n")
    environments = {side: output / side / "environment" for side in _SIDES}
    for side, revision in zip(_SIDES, (arguments.before, arguments.after), strict=True):
        print(f"- {side}: {check_out(revision, output / side / 'checkout')}", flush=True)
        install(output / side / "checkout", environments[side], output / side / "install.log")
    print("".join(f"- other versions: {line}\n" for line in other_versions(*environments.values())), flush=True)

    compared: dict[str, list[dict[str, Any]]] = {scene.name: [] for scene in scenes}
    costs: dict[str, list[tuple[Cost, Cost]]] = {scene.name: [] for scene in scenes}
    for number in range(1, arguments.rounds + 1):
        for scene in scenes:
            folders = {side: output / side / "runs" / scene.name for side in _SIDES}
            pair = [run_scene(scene, environments[side], folders[side], arguments.threads) for side in _SIDES]
            costs[scene.name].append((pair[0], pair[1]))
            workspaces = [scene.workspace(folders[side]) for side in _SIDES]
            found = compare(workspaces[0], workspaces[1], environments["after"] / "bin" / "python")
            compared[scene.name].append(found)
            said = f"round {number}, {scene.name}: {len(found['differences'])} of {found['files']} files differ"
            print(said, file=sys.stderr, flush=True)

    print(identity_table(compared), end="\n\n")
    lines = difference_lines(compared)
    print("\n".join(lines) + "\n" if lines else "All maps and clouds are identical to the byte.\n")
    print(cost_table(costs))
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
