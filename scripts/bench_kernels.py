"""Speed of the compiled kernels, against OpenCV's semi-global matcher and against what the machine can do.

    python scripts/bench_kernels.py [--width 1024] [--height 768] [--disparities 128] [--runs 5]

On a synthetic pair: texture, seen with the disparities of slanted planes, with noise. First all versions of every
kernel must give the same bits (exit code 1 if not), then each is timed, in one thread: median of the runs, in
million disparity evaluations per second (MDE/s = width * height * disparities / seconds / 1e6), or in megapixels
per second; seconds are of the processor. OpenCV is counted in the same way, though it leaves out the leftmost
`disparities` columns.

With --disparities all pixels search the same range, as at the matcher's coarsest level; with 32 and 64 disparities
each searches around its surface, as at its other levels.
"""

import argparse
import hashlib
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from benchmarking import machine, table
from machine_limits import copy_bandwidth, vector_throughput
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.stereo.matching import MatchingOptions
from colmap_sph.stereo.normals import NormalOptions

LEVELS = (32, 64)  # disparities at the matcher's levels below the coarsest
SOURCES = 8  # images that the refinement matches in at once; each counts as so many pixels
OPTIONS = MatchingOptions()
P2 = np.round(OPTIONS.p2_min + (OPTIONS.p2 - OPTIONS.p2_min) / (1 + np.arange(256) / OPTIONS.p2_contrast)).astype(
    np.uint8
)
OFFSET_INVALID = np.iinfo(np.int32).min

REGISTER_BYTES = {"avx2": 32, "avx512": 64}
MATCHES_AS = {"avx512bw": "avx2"}
"""Version → the one whose matching kernels it has."""
# Bytes of the volumes read and written per slot; that stored lines are first read into the cache is not counted.
# All volumes have 1 byte per slot. `aggregation` reads costs twice, writes and reads what the forward paths add to
# them, and writes sums; `match` writes and reads costs and what the forward paths add, but sums stay in the cache.
TRAFFIC = {"matching_cost": 1, "aggregation": 5, "selection": 1, "match": 4}
"""Kernel → bytes of memory traffic per slot."""


def sweep_instructions(register: int, depth: int) -> float:
    """Vector instructions per register of both sweeps, in aggregation_vector.c and aggregation_vector.h."""
    # Each of 4 paths has 6 (3 min, 2 add, subtract), and from the second register on the running minimum; `one_up`
    # and `one_down` have 2 each; 3 adds sum what the paths add. The backward sweep's sums take 4 more (average, 3
    # adds).
    return 2 * (4 * (7 - register / depth) + 4 + 3) + 4


def instructions(version: str, name: str, depth: int) -> dict[int, float]:
    """Vector arithmetic and shuffles per 32 slots, by bytes of a register, as the C sources have them.

    Without loads, stores and what is done per pixel.
    """
    if name == "match":
        steps = [instructions(version, step, depth) for step in ("matching_cost", "aggregation", "selection")]
        return {register: sum(step.get(register, 0) for step in steps) for register in set().union(*steps)}
    if version == "avx512" and name in ("aggregation", "selection") and depth % 64:
        return instructions("avx2", name, depth)
    register = REGISTER_BYTES[version]
    counts = {
        # 16 times shuffle and add.
        ("avx2", "matching_cost"): 16 * 2,
        # hamming_32 has 4 times xor and popcnt, and 3 multiply-adds; for 64 slots a shuffle and a permute.
        ("avx512", "matching_cost"): 4 * 2 + 3 + 1,
        # 2 min, a compare and a movemask for 32 sums.
        ("avx2", "selection"): 4,
        # 2 min and a compare for 64 sums.
        ("avx512", "selection"): 1.5,
        (version, "aggregation"): sweep_instructions(register, depth) * 32 / register,
    }
    return {register: counts[version, name]}


@dataclass(frozen=True, eq=False)
class Scene:
    """A rectified pair with exact disparities, and where the pixels search.

    Attributes
    ----------
    left, right : (H, W) uint8 ndarray
    disparity : (H, W) float32 ndarray
        Left column - right column, of every left pixel.
    depth : int
        Disparities searched per pixel.
    base : (H, W) int32 ndarray
        First offset (right column - left column) searched.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    disparity: NDArray[np.float32]
    depth: int
    base: NDArray[np.int32]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.base.shape[0], self.base.shape[1]


@dataclass(frozen=True, eq=False)
class Kernel:
    """A kernel with its input: `call` writes the `outputs`, `work` evaluations (or pixels, without `depth`)."""

    name: str
    call: Callable[[str], None]
    outputs: Sequence[NDArray[Any]]
    work: int
    depth: int | None = None


@dataclass(frozen=True)
class Timing:
    """Median seconds of a kernel, one per version, the fastest version first."""

    name: str
    depth: int | None
    work: int
    seconds: list[float]

    @property
    def speed(self) -> float:
        """Million evaluations (or pixels) per second of the fastest version."""
        return self.work / self.seconds[0] / 1e6


# ---- the pair ----------------------------------------------------------------------------------------------


def make_scene(width: int, height: int, depth: int, *, same_range: bool, seed: int = 0) -> Scene:
    """Slanted planes whose disparities lie well within 0..depth."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    share = 0.15 + 0.2 * x + 0.2 * y
    for _ in range(5):
        left, top = rng.uniform(0, 0.75, 2)
        inside = (x >= left) & (x < left + 0.2) & (y >= top) & (y < top + 0.2)
        slope_x, slope_y = rng.uniform(-0.5, 0.5, 2)
        plane = rng.uniform(0.5, 0.75) + slope_x * (x - left) + slope_y * (y - top)
        share = np.where(inside, plane, share)
    disparity = (depth * np.clip(share, 0.1, 0.9)).astype(np.float32)
    right = cv2.GaussianBlur(rng.normal(0, 1, (height, width)).astype(np.float32), (0, 0), 1.2)
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    left = cv2.remap(right, columns - disparity, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    images = [np.clip(128 + 180 * image + rng.normal(0, 2, image.shape), 0, 255) for image in (left, right)]
    middle = np.zeros_like(disparity) + depth / 2 if same_range else disparity
    base = -np.round(middle).astype(np.int32) - depth // 2
    return Scene(images[0].astype(np.uint8), images[1].astype(np.uint8), disparity, depth, base)


def share_right(scene: Scene, disparity: NDArray[np.floating]) -> float:
    """Share of the pixels that OpenCV treats, too, within one pixel of the true disparity (NaN = none)."""
    return float((np.abs(disparity - scene.disparity)[:, scene.depth :] <= 1).mean())


def disparity_of(offset: NDArray[np.int32]) -> NDArray[np.float32]:
    """Disparities from the kernels' offsets."""
    return np.where(offset == OFFSET_INVALID, np.float32(np.nan), offset.astype(np.float32) / -256)


# ---- the kernels -------------------------------------------------------------------------------------------


def with_border(image: NDArray[np.uint8]) -> NDArray[np.int16]:
    """The image in 1/64 grey value with the census window's border."""
    return np.asarray(cv2.copyMakeBorder(image, 3, 3, 4, 4, cv2.BORDER_REPLICATE), dtype=np.int16) * np.int16(64)


def census_pair(scene: Scene) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Census of both images, which are valid everywhere."""
    left, right = np.empty(scene.shape, np.uint64), np.empty(scene.shape, np.uint64)
    for image, census in ((scene.left, left), (scene.right, right)):
        _native.census("scalar", with_border(image), np.full(scene.shape, 255, np.uint8), False, 0, 0, census)
    return left, right


def matching_kernels(scene: Scene) -> list[Kernel]:
    """The kernels whose work grows with the number of disparities; the last is `match`."""
    left, right = census_pair(scene)
    columns = np.tile(np.arange(scene.shape[1], dtype=np.int32), (scene.shape[0], 1))
    shown = columns, scene.shape[1]
    volume = (*scene.shape, scene.depth)
    cost, sums = np.empty(volume, np.uint8), np.empty(volume, np.uint8)
    scratch = np.empty((2, scene.base.size, scene.depth), np.uint8)
    detours = scratch[0].reshape(volume)
    selected, matched = np.empty(scene.shape, np.int32), np.empty(scene.shape, np.int32)
    base = scene.base
    image = scene.left
    p1 = OPTIONS.p1
    slant = OPTIONS.max_slant
    limits = OPTIONS.max_left_right_difference, OPTIONS.max_left_right_excess

    def matching_cost(backend: str) -> None:
        _native.matching_cost(backend, left, right, base, cost)

    def aggregation(backend: str) -> None:
        _native.aggregation(backend, cost, base, image, p1, P2, slant, detours, sums)

    def selection(backend: str) -> None:
        _native.selection(backend, sums, base, left, right, *shown, *limits, selected)

    def match(backend: str) -> None:
        images = left, right, *shown, base, base, image
        size = _native.sweep_bytes(backend, scene.shape[1], scene.depth)
        states = np.empty(size, np.uint8), np.empty(size, np.uint8)
        _native.match(backend, *images, p1, P2, slant, *limits, 0, 0, 0, *states, scratch, matched)

    steps: list[tuple[Callable[[str], None], NDArray[Any]]] = [
        (matching_cost, cost),
        (aggregation, sums),
        (selection, selected),
        (match, matched),
    ]
    return [Kernel(call.__name__, call, [output], cost.size, scene.depth) for call, output in steps]


def image_kernels(scene: Scene) -> list[Kernel]:
    """The kernels that work on images, on the results of those before them."""
    left, right = census_pair(scene)
    census = np.empty_like(left)
    fitted_offset = np.empty(scene.shape, np.int32)
    offset = np.round(-256 * scene.disparity).astype(np.int32)
    # A camera whose focal length is its width: the sphere's columns and rows are about its own.
    height, width = scene.shape
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=np.float64)
    origins = (-width * np.arctan(0.5), -width * np.arctan(0.5 * height / width))
    inverse_K = np.linalg.inv(K)
    disparity = scene.disparity
    depth, sigma, fitted = (np.empty(scene.shape, np.float32) for _ in range(3))
    normals = np.empty((*scene.shape, 3), np.float32)
    padded = with_border(scene.left)
    valid = np.full(scene.shape, 255, dtype=np.uint8)

    def candidates(backend: str) -> None:
        arguments = ((width, width), origins, 0.0, 1.0, 0.25, 1.0, True, 1.0, True, 0, depth, sigma)
        _native.depth_candidates(backend, disparity, inverse_K, *arguments)

    candidates("scalar")
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depth > 0, 1 / depth, 0).astype(np.float32)
    inverse_sigma = (sigma * inverse * inverse).astype(np.float32)
    window = NormalOptions()
    support = np.ones(scene.shape, np.uint8)

    def fit(backend: str) -> None:
        gates = (window.radius, window.tolerance, window.max_shift, 2.0, 0.0, 0)
        _native.fit_planes(backend, inverse, inverse_sigma, support, K, *gates, normals, fitted)

    source = scene.right.astype(np.float32)
    warped, warped_valid, columns = (np.empty(scene.shape, kind) for kind in (np.float32, np.uint8, np.int32))
    unwarped, mean = np.empty(scene.shape, np.int32), np.empty(scene.shape, np.int32)

    def warp(_: str) -> None:
        _native.warp(source, valid, offset, 0, warped, warped_valid, columns)

    def unwarp_offsets(_: str) -> None:
        _native.unwarp_offsets(offset, offset, 0, unwarped)

    def mean_offsets(backend: str) -> None:
        _native.mean_offsets(backend, offset, 3, 768, mean)

    # As if the pixels were those of the finer level.
    half_offset = np.ascontiguousarray(offset[::2, ::2])
    near = np.asarray(half_offset / 512, dtype=np.float32)

    def upsample_offsets(backend: str) -> None:
        _native.upsample_offsets(backend, half_offset, 1024, unwarped)

    def search_windows(_: str) -> None:
        _native.search_windows(near, near, offset, 32, 4, 6, unwarped)

    pixels = width * height
    return [
        Kernel("warp", warp, [warped, warped_valid, columns], pixels),
        Kernel("unwarp_offsets", unwarp_offsets, [unwarped], pixels),
        Kernel("mean_offsets", mean_offsets, [mean], pixels),
        Kernel("upsample_offsets", upsample_offsets, [unwarped], pixels),
        Kernel("search_windows", search_windows, [unwarped], pixels),
        Kernel(
            "census", lambda backend: _native.census(backend, padded, valid, False, 0, 0, census), [census], pixels
        ),
        Kernel(
            "fit_offsets",
            lambda backend: _native.fit_offsets(backend, offset, left, right, fitted_offset),
            [fitted_offset],
            pixels,
        ),
        Kernel("depth_candidates", candidates, [depth, sigma], pixels),
        Kernel("fit_planes", fit, [normals, fitted], pixels),
    ]


def partner_kernels(scene: Scene) -> list[Kernel]:
    """The kernels that compare a view with its partners: the right camera stands one unit beside the left one."""
    focal = float(scene.shape[1])
    shape = scene.shape
    pixels = scene.base.size
    beside = np.column_stack([np.eye(3), [-focal, 0, 0]])
    from_right = np.empty(shape, np.float32)
    back = beside * np.where(np.arange(4) == 3, -1, 1)
    _native.transfer_disparity(scene.disparity, 2.0, from_right)
    known = [np.where(map_ > 0, map_, np.inf) for map_ in (scene.disparity, from_right)]  # no depth: 0
    maps = [((focal / one).astype(np.float32), (0.3 * focal / one**2).astype(np.float32)) for one in known]
    support = np.full(shape, 2, np.uint8)
    counts, sums = np.empty((3, *shape), np.uint8), np.empty((2, *shape), np.float32)

    def compare_depths(backend: str) -> None:
        counts.fill(0)
        sums.fill(0)
        found = (*maps[0], *maps[1], support)
        _native.compare_depths(backend, *found, beside, back, 2.0, 4.5, 2, False, *counts, *sums)

    inverse = scene.disparity / focal
    planes = np.stack([inverse, *np.gradient(inverse)[::-1]]).astype(np.float32)
    pairs = scene.right[:-1] + np.uint16(256) * scene.right[1:]  # pixels, and in upper bytes those below them
    sources = (pairs.astype(np.uint16),) * SOURCES
    transfers = np.stack([beside] * SOURCES)
    used = np.full(-(-shape[1] // 32), 2**SOURCES - 1, np.uint32)
    equations = np.empty((12, *shape), np.float32)

    def add_patch_equations(backend: str) -> None:
        equations.fill(0)
        given = (scene.left, sources, transfers, used, planes)
        _native.add_patch_equations(backend, *given, 0, 1, 20.0, 0.5, equations)

    return [
        Kernel("compare_depths", compare_depths, [counts, sums], pixels),
        Kernel("add_patch_equations", add_patch_equations, [equations], SOURCES * pixels),
    ]


def check_equality(kernel: Kernel, backends: Sequence[str]) -> None:
    """End the program where two versions of a kernel differ in a bit."""
    digests = {}
    for backend in backends:
        for output in kernel.outputs:
            output.view(np.uint8).fill(0xA5)  # what one version leaves unwritten must not pass for its result
        kernel.call(backend)
        digests[backend] = [hashlib.blake2b(output.data).digest() for output in kernel.outputs]
    different = [backend for backend in backends if digests[backend] != digests[backends[-1]]]
    if different:
        at = f" with {kernel.depth} disparities" if kernel.depth else ""
        sys.exit(f"error: {kernel.name}{at}: {', '.join(different)} and {backends[-1]} differ; run the tests.")


def median_seconds(call: Callable[[], object], runs: int) -> float:
    """Median processor time of a call that has been made before; other programs' time is not counted."""
    seconds = []
    for _ in range(runs):
        start = time.process_time()
        call()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds)


# ---- OpenCV ------------------------------------------------------------------------------------------------

OPENCV_MODES = {
    "SGBM": cv2.STEREO_SGBM_MODE_SGBM,
    "HH": cv2.STEREO_SGBM_MODE_HH,
    "HH4": cv2.STEREO_SGBM_MODE_HH4,
    "SGBM_3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
}


def opencv_matcher(mode: str, depth: int) -> cv2.StereoSGBM:
    """OpenCV's matcher with the penalties of its documentation for windows of 3 x 3 pixels."""
    return cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=depth,
        blockSize=3,
        P1=8 * 9,
        P2=32 * 9,
        disp12MaxDiff=OPTIONS.max_left_right_difference,
        preFilterCap=63,
        mode=OPENCV_MODES[mode],
    )


# ---- tables ------------------------------------------------------------------------------------------------


def time_kernel(kernel: Kernel, backends: Sequence[str], runs: int) -> Timing:
    """Time all versions of a kernel."""
    seconds = [median_seconds(partial(kernel.call, backend), runs) for backend in backends]
    return Timing(kernel.name, kernel.depth, kernel.work, seconds)


def kernel_row(timing: Timing) -> list[str]:
    """Row of the table of kernels."""
    unit, digits = ("MDE/s", 0) if timing.depth else ("Mpixel/s", 1)
    rates = [f"{timing.work / s / 1e6:.{digits}f}" for s in timing.seconds]
    cells = [c for s, rate in zip(timing.seconds, rates, strict=True) for c in (f"{1000 * s:.1f}", rate)]
    return [timing.name, str(timing.depth or "-"), unit, *cells]


def time_matchers(scene: Scene, ours: Kernel, ours_seconds: float, runs: int) -> list[list[str]]:
    """Rows of the comparison: `match` and OpenCV's modes on the same pair."""
    results = {"colmap_sph match": (ours_seconds, share_right(scene, disparity_of(ours.outputs[0])))}
    for mode in OPENCV_MODES:
        matcher = opencv_matcher(mode, scene.depth)
        found = matcher.compute(scene.left, scene.right).astype(np.float32) / 16
        seconds = median_seconds(partial(matcher.compute, scene.left, scene.right), runs)
        results[f"OpenCV MODE_{mode}"] = seconds, share_right(scene, np.where(found < 0, np.nan, found))
    hh_seconds = results["OpenCV MODE_HH"][0]
    return [
        [
            name,
            str(scene.depth),
            f"{100 * right:.1f}",
            f"{1000 * seconds:.1f}",
            f"{ours.work / seconds / 1e6:.0f}",
            f"{hh_seconds / seconds:.2f}",
        ]
        for name, (seconds, right) in results.items()
    ]


def limit_mde(work: dict[int, float], traffic: float, throughput: dict[int, float], bandwidth: float) -> float:
    """What a kernel could reach, MDE/s.

    Parameters
    ----------
    work, throughput
        Vector instructions per 32 slots, and per second, by bytes of a register.
    traffic, bandwidth
        Bytes read and written per slot, and copied per second.
    """
    seconds = sum(count / throughput[register] for register, count in work.items()) / 32
    return 1 / max(seconds, traffic / bandwidth) / 1e6


def print_limits(version: str, timings: Sequence[Timing]) -> None:
    """The machine's limits, and how near to them this version's matching kernels come."""
    bandwidth = copy_bandwidth()
    traffic = TRAFFIC["match"]
    print(
        f"\nCopy bandwidth, read and written: {bandwidth / 1e9:.1f} GB/s; `match` moves {traffic} bytes per ",
        end="",
    )
    print(f"slot: at most {bandwidth / traffic / 1e6:.0f} MDE/s.")
    throughput: dict[int, float] = {}
    for register in sorted(size for size in REGISTER_BYTES.values() if size <= REGISTER_BYTES[version]):
        measured = vector_throughput(register)
        if isinstance(measured, str):
            print(f"No arithmetic bound: {measured}.")
            return
        throughput[register] = measured
        print(f"Independent vector instructions of {register} bytes: {measured / 1e9:.1f} billion/s.")
    print()
    rows = []
    for timing in timings:
        depth = timing.depth or 0
        work = instructions(version, timing.name, depth)
        limit = limit_mde(work, TRAFFIC[timing.name], throughput, bandwidth)
        counts = " + ".join(f"{count:.0f} x {register}" for register, count in sorted(work.items()))
        share = f"{100 * timing.speed / limit:.0f} %"
        rows.append([timing.name, str(depth), counts, f"{timing.speed:.0f}", f"{limit:.0f}", share])
    print(table(["kernel", "disparities", "per 32 slots", "MDE/s", "bound, MDE/s", "share"], rows))
    print(
        "\nThe rest: loads and stores, what is done per pixel (penalties, horizontal minima, shifted ranges, "
        "sub-pixel fit), minima and shuffles that fewer units can do, and each pixel's wait for the one before "
        "it on its row."
    )


def bench(width: int, height: int, disparities: int, runs: int) -> None:
    """Check, time and print all tables."""
    backends = _native.backends()
    timings: list[Timing] = []
    comparison: list[list[str]] = []
    wall, processor = time.perf_counter(), time.process_time()
    for depth in dict.fromkeys((disparities, *LEVELS)):
        coarsest = depth == disparities
        scene = make_scene(width, height, depth, same_range=coarsest)
        others = [*image_kernels(scene), *partner_kernels(scene)] if coarsest else []
        kernels = [*others, *matching_kernels(scene)]
        for kernel in kernels:
            check_equality(kernel, backends)
        timings += [time_kernel(kernel, backends, runs) for kernel in kernels]
        comparison += time_matchers(scene, kernels[-1], timings[-1].seconds[0], runs)
    share = (time.process_time() - processor) / (time.perf_counter() - wall)
    print(f"Equal to the bit: {', '.join(backends)}.\n" if len(backends) > 1 else "One version only.\n")
    header = ["kernel", "disparities", "unit", *(c for b in backends for c in (f"{b}, ms", f"{b}, per s"))]
    print(table(header, map(kernel_row, timings)) + "\n")
    header = ["matcher", "disparities", "within 1 pixel, %", "ms", "MDE/s", "times as fast as HH"]
    print(table(header, comparison))
    if share < 0.95:
        print(f"\nOnly {100 * share:.0f} % of the time on a processor: other programs share its caches, too.")
    version = MATCHES_AS.get(backends[0], backends[0])
    if version in REGISTER_BYTES:
        print_limits(version, [timing for timing in timings if timing.depth])


def main() -> None:
    """Check, time, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--height", type=int, default=768)
    parser.add_argument("--disparities", type=int, default=128, help="of the coarsest level; a multiple of 32")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each kernel")
    arguments = parser.parse_args()
    if arguments.disparities % 32 or not 32 <= arguments.disparities <= 1024:
        parser.error(f"--disparities must be a multiple of 32 up to 1024, not {arguments.disparities}")
    if not (arguments.disparities + 64 <= arguments.width <= 65535 and arguments.height >= 32):
        parser.error("--width must lie between --disparities + 64 and 65535, and --height be at least 32")
    if arguments.runs < 1:
        parser.error(f"--runs must be at least 1, not {arguments.runs}")
    cv2.setNumThreads(1)
    print(f"{machine()}; OpenCV {cv2.__version__}; {arguments.width} x {arguments.height} pixels; ", end="")
    print(f"one thread, median of {arguments.runs} runs\n", flush=True)
    bench(arguments.width, arguments.height, arguments.disparities, arguments.runs)


if __name__ == "__main__":
    main()
