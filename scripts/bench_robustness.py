"""What photographs as people have them do to the result: one imperfection after the other, at three strengths.

    python scripts/bench_robustness.py [--only CASE ...] [--variant "NAME=OPTIONS" ...] [--peer "NAME=COMMAND" ...]

Each case renders a small block of twelve images (a village from the air; where there is sky, houses across a
street), runs `colmap_sph run` with its default options and with those of each variant, and compares depth maps and
cloud with exact depth. A peer's command gets an ordinary COLMAP dense workspace, whose folder takes the place of
{workspace} in it; scored is what it leaves there: ``stereo/depth_maps/NAME.geometric.bin`` (``.photometric.bin``)
and ``fused.ply``, each where it exists. Everything is made in a temporary folder and removed.

Depth maps are compared with what each pixel of the bent picture sees, the cloud with all that stands still, both
without registration: poses that are wrong count.
"""

import argparse
import shlex
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from benchmarking import PARTIAL_EXIT_CODE, machine, run_process, table
from numpy.typing import NDArray

from colmap_sph import synthetic as syn
from colmap_sph.errors import ColmapSphError, NoResultError
from colmap_sph.evaluation import (
    DepthView,
    EvaluationOptions,
    compare_depth_map,
    evaluate_cloud,
    make_reference,
    read_geometry,
)
from colmap_sph.project.map_files import read_depth_map

_HEADER = (
    "case",
    "strength",
    "method",
    "coverage %",
    "< 1 GSD %",
    "< 2 GSD %",
    "of sky %",
    "blank, wrong %",
    "accuracy 1 / 2 / 4 GSD",
    "completeness",
    "F",
    "processor, s",
)
_WIDTH = 480
_HEIGHT = 360
_GSD = 0.17
_TAUS = (1.0, 2.0, 4.0)

# ---- the cases ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Block:
    """A block to be rendered: its options, and whether it is the street under a sky."""

    options: syn.BlockOptions | syn.StreetOptions

    def render(self, folder: Path, threads: int) -> syn.Capture:
        """Write its images, exact depth and model."""
        if isinstance(self.options, syn.StreetOptions):
            return syn.make_street_block(folder, self.options, threads=threads)
        return syn.make_demo_block(folder, self.options, threads=threads)


def village(size: float, effects: syn.Imperfections | None = None, noise: float = 1.5, quality: int = 95) -> Block:
    """Eight vertical and four oblique images; `size` scales their sides, and the GSD against it."""
    options = syn.BlockOptions(
        width=round(size * _WIDTH),
        height=round(size * _HEIGHT),
        nadir_gsd=_GSD / size,
        oblique_gsd=1.15 * _GSD / size,
        strips=2,
        strip_images=4,
        oblique_images=1,
        points=2500,
        image_noise=noise,
        jpeg_quality=quality,
        effects=effects or syn.Imperfections(),
    )
    return Block(options)


def street(size: float, effects: syn.Imperfections | None = None, noise: float = 1.5, quality: int = 95) -> Block:
    """Twelve images of houses before the sky."""
    options = syn.StreetOptions(
        width=round(size * _WIDTH),
        height=round(size * _HEIGHT),
        points=2500,
        image_noise=noise,
        jpeg_quality=quality,
        effects=effects or syn.Imperfections(sky=True),
    )
    return Block(options)


def effect(name: str, size: float, strength: float) -> Block:
    """The village with one effect, of the name that it has in `Imperfections`."""
    return village(size, _with(name, strength))


def adjusted(name: str, size: float, strength: float) -> Block:
    """The same, with poses adjusted to the tracks as they are."""
    return village(size, replace(_with(name, strength), bundle_adjusted=True))


def _with(name: str, strength: float) -> syn.Imperfections:
    change: dict[str, Any] = {name: strength}
    return syn.Imperfections(**change)


def noisy(size: float, strength: float) -> Block:
    """Photon noise at white, and half as much in the dark."""
    return village(size, syn.Imperfections(photon_noise=strength), noise=strength / 2)


def compressed(size: float, strength: float) -> Block:
    """JPEG quality."""
    return village(size, quality=int(strength))


def cloudy(size: float, strength: float) -> Block:
    """The street under clouds."""
    return street(size, syn.Imperfections(sky=True, clouds=strength))


def sky_of_a_phone(size: float, strength: float) -> Block:
    """The street under soft clouds, with noise and JPEG of the quality that leaves its blocks visible."""
    effects = syn.Imperfections(sky=True, clouds=0.3, photon_noise=strength)
    return street(size, effects, noise=strength / 2, quality=80)


def phone_video(size: float, strength: float) -> Block:
    """Frames of a film: a shutter that rolls, blur, exposure that follows the light, noise and coarse JPEG."""
    effects = syn.Imperfections(
        rolling_shutter=3 * strength,
        motion_blur=3 * strength,
        exposure=0.5 * strength,
        photon_noise=3 * strength,
        bundle_adjusted=True,
    )
    return village(size, effects, noise=1.5 * strength, quality=int(90 - 25 * strength))


def cheap_drone(size: float, strength: float) -> Block:
    """A lens that no camera model knows, which darkens and blurs."""
    effects = syn.Imperfections(
        lens=0.6 * strength, vignetting=0.4 * strength, blur=0.8 * strength, bundle_adjusted=True
    )
    return village(size, effects, noise=2 * strength, quality=int(95 - 10 * strength))


def poor_light(size: float, strength: float) -> Block:
    """Noise, long exposures, and highlights."""
    effects = syn.Imperfections(
        photon_noise=8 * strength, motion_blur=3 * strength, exposure=0.5 * strength, specular=0.5 * strength
    )
    return village(size, effects, noise=5 * strength, quality=85)


@dataclass(frozen=True)
class Case:
    """What a block's maker takes for strengths, and their unit."""

    make: Callable[[float, float], Block]
    strengths: tuple[float, ...]
    unit: str = ""


CASES: dict[str, Case] = {
    "none, village": Case(lambda size, _: village(size), (0,)),
    "none, street": Case(lambda size, _: street(size), (0,)),
    "noise": Case(noisy, (4, 8, 16), "grey values"),
    "JPEG": Case(compressed, (80, 50, 25), "quality"),
    "vignetting": Case(partial(effect, "vignetting"), (0.3, 0.6, 0.9), "of the light"),
    "exposure": Case(partial(effect, "exposure"), (0.3, 0.7, 1.5), "stops"),
    "Gaussian blur": Case(partial(effect, "blur"), (0.7, 1.4, 2.8), "px"),
    "defocus": Case(partial(effect, "defocus"), (1, 2, 4), "px radius"),
    "motion blur": Case(partial(effect, "motion_blur"), (2, 5, 10), "px"),
    "rolling shutter": Case(partial(adjusted, "rolling_shutter"), (2, 5, 10), "px"),
    "lens": Case(partial(adjusted, "lens"), (0.3, 0.6, 1.2), "px rms"),
    "wobble": Case(partial(adjusted, "wobble"), (0.3, 0.6, 1.2), "px rms"),
    "rotations": Case(partial(effect, "rotation_error"), (0.25, 0.5, 1.0), "px"),
    "centres": Case(partial(effect, "centre_error"), (0.25, 0.5, 1.0), "px"),
    "highlights": Case(partial(effect, "specular"), (0.2, 0.5, 1.0), "of white"),
    "moving things": Case(lambda size, count: effect("moving", size, int(count)), (10, 40, 120), "per image"),
    "clouds": Case(cloudy, (0.2, 0.5, 1.0), "of the blue"),
    "phone's film": Case(phone_video, (0.5, 1, 2), "times"),
    "cheap drone": Case(cheap_drone, (0.5, 1, 2), "times"),
    "poor light": Case(poor_light, (0.5, 1, 2), "times"),
    "sky, noise, JPEG 80": Case(sky_of_a_phone, (2, 5, 10), "grey values"),
}

# ---- running and scoring -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Method:
    """Ours with options, or a peer's command."""

    name: str
    arguments: tuple[str, ...]
    is_peer: bool = False


@dataclass(frozen=True)
class Prepared:
    """A rendered block, and what the cloud is measured against."""

    capture: syn.Capture
    blank: int | None
    threads: int

    def straight(self, index: int) -> syn.Camera:
        """An image's camera as a model knows it."""
        camera = self.capture.cameras[index]
        return syn.Camera(camera.K, camera.R, camera.t, camera.width, camera.height)


def run_ours(prepared: Prepared, method: Method, folder: Path) -> float:
    """Run the program into `folder`; its processor seconds."""
    arguments = [sys.executable, "-P", "-m", "colmap_sph", "run", "--model", str(prepared.capture.sparse_dir)]
    arguments += ["--output", str(folder), "--threads", str(prepared.threads), *method.arguments]
    return _seconds(arguments, folder.parent / f"{folder.name}.log", (0, PARTIAL_EXIT_CODE))


def run_peer(prepared: Prepared, method: Method, folder: Path) -> float:
    """Run a peer on an ordinary dense workspace made in `folder`; its processor seconds."""
    capture = prepared.capture
    pycolmap.undistort_images(folder, capture.sparse_dir, capture.images_dir)
    arguments = [part.replace("{workspace}", str(folder)) for part in method.arguments]
    return _seconds(arguments, folder.parent / f"{folder.name}.log", (0,))


def _seconds(arguments: Sequence[str], log: Path, good: Sequence[int]) -> float:
    code, _, processor, _ = run_process(arguments, log)
    if code not in good:
        said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:] or ["no message"]
        raise NoResultError(f"`{shlex.join(arguments)}` ended with exit code {code}: {said[0]}")
    return processor


def depth_of(workspace: Path, name: str, shape: tuple[int, int]) -> NDArray[np.float32]:
    """An image's depth map, geometric where there is one; zeros without any."""
    for kind in ("geometric", "photometric"):
        path = workspace / "stereo" / "depth_maps" / f"{name}.{kind}.bin"
        if path.is_file():
            return read_depth_map(path)
    return np.zeros(shape, np.float32)


def map_scores(prepared: Prepared, workspace: Path) -> list[str]:
    """Coverage, shares within 1 and 2 GSD, share of sky with depth, share of the blank house that is wrong."""
    capture = prepared.capture
    shares = []
    # Pixels that say nothing, and those of them with a depth, or a wrong one: of the sky, of the blank house.
    counts = np.zeros((2, 2))
    for index, name in enumerate(capture.names):
        truth = capture.truth(name)[0]
        depth = depth_of(workspace, name, truth.shape)
        gsd = np.maximum(truth, 1e-9) / np.float32(capture.cameras[index].K[0, 0])
        scores = compare_depth_map(depth, truth, gsd=gsd, thresholds=_TAUS)
        shares.append([scores.coverage, scores.within[0], scores.within[1]])
        counts[0] += [np.sum(truth == 0), np.sum((truth == 0) & (depth > 0))]
        if prepared.blank is not None:
            number = syn.exact_geometry(capture.surfaces, prepared.straight(index), origin=0.0)[2]
            blank = number == prepared.blank
            wrong = blank & (depth > 0) & (np.abs(depth - truth) > 2 * gsd)
            counts[1] += [np.sum(blank), np.sum(wrong)]
    void = [f"{100 * part / whole:.2f}" if whole else "-" for whole, part in counts]
    return [*(f"{100 * share:.1f}" for share in np.mean(shares, axis=0)), *void]


def cloud_scores(prepared: Prepared, workspace: Path) -> list[str]:
    """Accuracy, completeness and F of the cloud against the surface that images see and that stands still."""
    cloud = workspace / "fused.ply"
    if not cloud.is_file():
        return ["-"] * 3
    capture = prepared.capture
    options = EvaluationOptions(gsd=capture.gsd, register=False, threads=prepared.threads)
    views = []
    for index, name in enumerate(capture.names):
        camera = prepared.straight(index)
        views.append(DepthView(name, camera.K, camera.R, camera.t, partial(_static_depth, capture, camera)))
    scores = evaluate_cloud(read_geometry(cloud), make_reference(views, options), options).thresholds[:3]
    columns = [
        [score.accuracy for score in scores],
        [score.completeness for score in scores],
        [score.f_score for score in scores],
    ]
    return [" / ".join(f"{100 * value:.1f}" for value in column) for column in columns]


def _static_depth(capture: syn.Capture, camera: syn.Camera) -> NDArray[np.float32]:
    return syn.exact_geometry(capture.surfaces, camera)[0].astype(np.float32)


def rows_of(name: str, strength: float, size: float, methods: Sequence[Method], threads: int) -> list[list[str]]:
    """Render a case at one strength, run all methods on it; their rows of the table."""
    case = CASES[name]
    rows = []
    with tempfile.TemporaryDirectory(prefix="bench_robustness_") as scratch:
        block = case.make(size, strength)
        capture = block.render(Path(scratch) / "block", threads)
        has_blank = isinstance(block.options, syn.StreetOptions)
        prepared = Prepared(capture, syn.BLANK_HOUSE if has_blank else None, threads)
        for number, method in enumerate(methods):
            workspace = Path(scratch) / f"dense{number}"
            label = [name, f"{strength:g} {case.unit}".strip(), method.name]
            try:
                seconds = (run_peer if method.is_peer else run_ours)(prepared, method, workspace)
                scores = [*map_scores(prepared, workspace), *cloud_scores(prepared, workspace)]
                rows.append([*label, *scores, f"{seconds:.1f}"])
            except ColmapSphError as error:
                print(f"{name}, {strength:g}, {method.name}: {error}", file=sys.stderr)
                rows.append([*label, "failed", *["-"] * (len(_HEADER) - 4)])
            print("|", " | ".join(rows[-1]), "|", file=sys.stderr, flush=True)
    return rows


def named(text: str) -> tuple[str, tuple[str, ...]]:
    """``NAME=WORDS`` as a name and its words."""
    name, equals, words = text.partition("=")
    if not (name and equals and words.strip()):
        raise argparse.ArgumentTypeError(f'{text!r} is not NAME=..., such as "coarse=--sampling 0.5"')
    return name, tuple(shlex.split(words))


def main() -> None:
    """Run the cases, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES), help="these cases")
    parser.add_argument(
        "--strengths", type=int, nargs="+", choices=(1, 2, 3), default=[1, 2, 3], help="these of the three"
    )
    parser.add_argument("--variant", type=named, action="append", default=[], help="NAME=OPTIONS of another run")
    parser.add_argument("--peer", type=named, action="append", default=[], help="NAME=COMMAND with {workspace}")
    parser.add_argument("--size", type=float, default=1.0, help="scale of the images' sides; 1 is 480 x 360")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    # An ended benchmark leaves nothing behind, either.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    methods = [Method("default", ()), *(Method(name, words) for name, words in arguments.variant)]
    methods += [Method(name, words, is_peer=True) for name, words in arguments.peer]
    rows = []
    for name in arguments.only:
        strengths = CASES[name].strengths
        # A case without strengths is run whichever are asked for.
        chosen = strengths if len(strengths) == 1 else [strengths[k - 1] for k in sorted(set(arguments.strengths))]
        for strength in chosen:
            rows += rows_of(name, strength, arguments.size, methods, arguments.threads)
    print(f"{machine()}\n\n{table(_HEADER, rows)}")


if __name__ == "__main__":
    main()
