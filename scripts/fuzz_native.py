"""Call every C function, and the reader of depth maps, with random arguments, right and wrong ones.

Whatever comes in, a call must return or raise one of Python's own errors. Worth most in a build with
sanitizers (see CONTRIBUTING.md), which turn a stray read or write into the end of the process; the seed of the
call is printed then, and ``--seed N --calls 1`` repeats it.

A new C function needs one entry in `FUNCTIONS`: valid arguments of random size.
"""

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import InputError
from colmap_sph.project.map_files import read_depth_map, read_normal_map

Random = np.random.Generator
Arguments = list[Any]

ALLOWED = (TypeError, ValueError, OverflowError, MemoryError)
DTYPES = (np.uint8, np.int8, np.uint16, np.int32, np.uint64, np.float32, np.float64, np.complex64, np.bool_)
FLOATS = (np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 0.5, 1e-300, 5e-324, 1e30, -1e300)
INTEGERS = (-(2**63), -(2**31), -1, 0, 1, 17, 255, 256, 2**31 - 1, 2**31, 2**63, 2**70)
ODD_OBJECTS: tuple[object, ...] = (None, "text", b"bytes", [1, 2], (), {}, 1.5, 3, True)


# ---- valid arguments ---------------------------------------------------------------------------------------


def filled(rng: Random, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """Random bits, or small numbers, or one number out of this world among small ones."""
    kind = rng.integers(3)
    if kind == 0:
        return (
            np.frombuffer(rng.bytes(int(np.prod(shape)) * np.dtype(dtype).itemsize), dtype).reshape(shape).copy()
        )
    array: NDArray[Any] = rng.integers(0, 60, shape).astype(dtype)
    if kind == 1 and array.size and array.dtype.kind == "f":
        with np.errstate(over="ignore"):
            array.flat[int(rng.integers(array.size))] = FLOATS[int(rng.integers(len(FLOATS)))]
    return array


def size(rng: Random) -> tuple[int, int]:
    """Height and width, either of which may be 0."""
    return int(rng.integers(0, 12)), int(rng.integers(0, 70))


def census(rng: Random) -> Arguments:
    h, w = size(rng)
    padded = filled(rng, (h + 6, w + 8), np.int16)
    first, spare = rng.integers(0, 9, 2).tolist()
    words = np.zeros((h, first + w + spare), np.uint64)
    return [
        backend(rng),
        padded,
        filled(rng, (h, w), np.uint8),
        bool(rng.integers(2)),
        int(rng.integers(0, 9)),
        first,
        words,
    ]


def matching_cost(rng: Random) -> Arguments:
    h, w = size(rng)
    target = int(rng.integers(0, 70))
    depth = 32 * int(rng.integers(1, 4))
    words = [filled(rng, (h, width), np.uint64) for width in (w, target)]
    return [backend(rng), *words, filled(rng, (h, w), np.int32), np.zeros((h, w, depth), np.uint8)]


def aggregation(rng: Random) -> Arguments:
    h, w = size(rng)
    depth = 32 * int(rng.integers(1, 4))
    p1 = int(rng.integers(0, 64))
    cost = filled(rng, (h, w, depth), np.uint8)
    image = filled(rng, (h, w), np.uint8)
    p2 = rng.integers(p1, 128, 256).astype(np.uint8)
    base = filled(rng, (h, w), np.int32)
    sums = np.zeros((h, w, depth), np.uint8)
    return [backend(rng), cost, base, image, p1, p2, int(rng.integers(0, 5)), np.zeros_like(cost), sums]


def selection(rng: Random) -> Arguments:
    h, w = size(rng)
    target = int(rng.integers(0, 70))
    depth = 32 * int(rng.integers(1, 4))
    sums = filled(rng, (h, w, depth), np.uint8)
    base = filled(rng, (h, w), np.int32)
    words = [filled(rng, (h, width), np.uint64) for width in (w, target)]
    limits = rng.integers(0, (5, 99)).tolist()
    return [
        backend(rng),
        sums,
        base,
        *words,
        *source_columns(rng, (h, target)),
        *limits,
        np.zeros((h, w), np.int32),
    ]


def source_columns(rng: Random, shape: tuple[int, int]) -> Arguments:
    """Columns of the source that target pixels show, and its width."""
    columns = filled(rng, shape, np.int32)
    if rng.random() < 0.7:  # as a warp gives them
        columns = rng.integers(-1, 6, shape).cumsum(axis=1).astype(np.int32) - 5
    return [columns, int(rng.integers(0, 150))]


def band_inputs(rng: Random) -> tuple[tuple[int, int, int], Arguments, Arguments, Arguments]:
    """Rows, columns and disparities; census; bases and image; penalties."""
    (h, w), target, depth = size(rng), int(rng.integers(0, 70)), 32 * int(rng.integers(1, 4))
    words: Arguments = [filled(rng, (h, width), np.uint64) for width in (w, target)]
    bases = [filled(rng, (h, w), np.int32) for _ in range(2)]
    p1 = int(rng.integers(0, 64))
    penalties = [p1, rng.integers(p1, 128, 256).astype(np.uint8), int(rng.integers(0, 5))]
    return (h, w, depth), words, [*bases, filled(rng, (h, w), np.uint8)], penalties


def state(rng: Random, kernels: str, width: int, depth: int) -> np.ndarray:
    """What a sweep may have left."""
    return rng.integers(0, 193, _native.sweep_bytes(kernels, width, depth)).astype(np.uint8)


def band_of(rng: Random, rows: int) -> list[int]:
    """Rows from the first to before the end, and how many of the image lie above and below."""
    first, end = sorted(rng.integers(0, rows + 1, 2).tolist())
    return [first, end, *(int(rng.integers(0, 9)) if inside else 0 for inside in (first > 0, end < rows))]


def sweep_bytes(rng: Random) -> Arguments:
    return [backend(rng), int(rng.integers(0, 70)), 32 * int(rng.integers(1, 33))]


def sweep(rng: Random) -> Arguments:
    (h, w, depth), words, images, penalties = band_inputs(rng)
    kernels = backend(rng)
    band = [*band_of(rng, h), bool(rng.random() < 0.5)]
    return [kernels, *words, *images, depth, *penalties, *band, state(rng, kernels, w, depth)]


def match(rng: Random) -> Arguments:
    (h, w, depth), words, images, penalties = band_inputs(rng)
    kernels = backend(rng)
    shown = source_columns(rng, words[1].shape)
    limits = rng.integers(0, (5, 99)).tolist()
    first, end, *beside = band_of(rng, h)
    outputs = [np.zeros((2, (end - first) * w, depth), np.uint8), np.zeros((end - first, w), np.int32)]
    states = [state(rng, kernels, w, depth) for _ in range(2)]
    return [kernels, *words, *shown, *images, *penalties, *limits, first, *beside, *states, *outputs]


def fit_offsets(rng: Random) -> Arguments:
    (h, w), target = size(rng), int(rng.integers(0, 70))
    offset = filled(rng, (h, w), np.int32)
    if rng.random() < 0.7:  # one surface within the target, in 1/256 pixel
        offset = (256 * rng.integers(-20, 20) + rng.integers(-300, 300, (h, w))).astype(np.int32)
    words = [filled(rng, (h, width), np.uint64) for width in (w, target)]
    return [backend(rng), offset, *words, np.zeros((h, w), np.int32)]


def warp(rng: Random) -> Arguments:
    (h, w), source, target = size(rng), int(rng.integers(0, 70)), int(rng.integers(0, 99))
    inputs = [filled(rng, (h, source), np.float32), filled(rng, (h, source), np.uint8)]
    outputs = [np.zeros((h, target), kind) for kind in (np.float32, np.uint8, np.int32)]
    return [*inputs, filled(rng, (h, w), np.int32), margin(rng), *outputs]


def unwarp_offsets(rng: Random) -> Arguments:
    shape = size(rng)
    return [*(filled(rng, shape, np.int32) for _ in range(2)), margin(rng), np.zeros(shape, np.int32)]


def mean_offsets(rng: Random) -> Arguments:
    shape = size(rng)
    limits = [int(rng.integers(0, 11)), int(rng.choice([0, 1, 768, 1 << 20]))]
    return [backend(rng), filled(rng, shape, np.int32), *limits, np.zeros(shape, np.int32)]


def finer(rng: Random, shape: tuple[int, int]) -> tuple[int, int]:
    """Size of the next finer level, seldom a wrong one."""
    height, width = (max(2 * length - int(rng.integers(2)), 0) for length in shape)
    return (height, width) if rng.random() < 0.9 else (height + 1, width + 1)


def upsample_offsets(rng: Random) -> Arguments:
    shape = size(rng)
    return [
        backend(rng),
        filled(rng, shape, np.int32),
        int(rng.choice([0, 1024, 2**31 - 1])),
        np.zeros(finer(rng, shape), np.int32),
    ]


def search_windows(rng: Random) -> Arguments:
    shape = size(rng)
    fine = finer(rng, shape)
    limits = [int(32 * rng.integers(1, 4)), *rng.integers(0, 17, 2).tolist()]
    bounds = [filled(rng, shape, np.float32) for _ in range(2)]
    return [*bounds, filled(rng, fine, np.int32), *limits, np.zeros(fine, np.int32)]


def to_disparity(rng: Random) -> Arguments:
    shape = size(rng)
    return [filled(rng, shape, np.int32), filled(rng, (256,), np.float32), np.zeros(shape, np.float32)]


def keep_between(rng: Random) -> Arguments:
    return [filled(rng, size(rng), np.int32), *rng.integers(-99, 99, 2).tolist()]


def remove_small_segments(rng: Random) -> Arguments:
    offset = filled(rng, size(rng), np.int32)
    if rng.random() < 0.7:
        offset = rng.choice(np.array([-(2**31), 0, 300, 500], np.int32), offset.shape)
    return [offset, int(rng.integers(0, 50))]


def count_fractions(rng: Random) -> Arguments:
    return [filled(rng, size(rng), np.int32), np.zeros(256, np.uint32)]


def unwarp_torn(rng: Random) -> Arguments:
    shape = size(rng)
    inputs = [filled(rng, shape, np.int32), filled(rng, shape, np.uint8)]
    return [*inputs, margin(rng), np.zeros(shape, np.int32)]


def first_offsets(rng: Random) -> Arguments:
    shape = size(rng)
    inputs = [filled(rng, shape, kind) for kind in (np.int32, np.int32, np.uint8)]
    return [*inputs, np.zeros(shape, np.int32)]


def target_bases(rng: Random) -> Arguments:
    shape = size(rng)
    inputs = [filled(rng, shape, kind) for kind in (np.int32, np.uint8)]
    return [*inputs, margin(rng), margin(rng), margin(rng), np.zeros(shape, np.int32)]


def join_targets(rng: Random) -> Arguments:
    h, w = size(rng)
    source = int(rng.integers(0, 70))
    joined = (h, w + source + int(rng.integers(0, 40)))
    return [w, source, np.zeros(joined, np.uint64), np.zeros(joined, np.int32)]


def bases_about(rng: Random) -> Arguments:
    return [filled(rng, size(rng), np.int32), 32, *sorted(rng.integers(-99, 99, 2).tolist())]


def mark_steps(rng: Random) -> Arguments:
    shape = size(rng)
    return [filled(rng, shape, np.int32), int(rng.integers(0, 99)), np.zeros(shape, np.uint8)]


def count_slopes(rng: Random) -> Arguments:
    return [filled(rng, size(rng), np.int32), *rng.integers(0, 99, 2).tolist()]


def disparity_range(rng: Random) -> Arguments:
    return [filled(rng, size(rng), np.float32), np.zeros(2, np.float32)]


def code_disparity(rng: Random) -> Arguments:
    shape = size(rng)
    return [filled(rng, shape, np.float32), number(rng), number(rng), np.zeros(shape, np.uint16)]


def decode_disparity(rng: Random) -> Arguments:
    shape = size(rng)
    return [filled(rng, shape, np.uint16), number(rng), number(rng), np.zeros(shape, np.float32)]


def seed_planes(rng: Random) -> Arguments:
    seeds = filled(rng, (3, int(rng.integers(0, 90))), np.float64)
    weights = [int(rng.integers(1, 33)), number(rng), number(rng), number(rng)]
    return [*seeds, *weights, int(rng.integers(1, 9)), np.zeros(size(rng), np.float32)]


def fit_surfaces(rng: Random) -> Arguments:
    count = int(rng.integers(0, 9))
    inputs = [filled(rng, size(rng), np.float32), filled(rng, (count, 2), np.float64), number(rng)]
    return [*inputs, np.zeros((count, 3)), np.zeros(count, np.float32)]


def place_windows(rng: Random) -> Arguments:
    count = int(rng.integers(0, 9))
    inputs = [filled(rng, shape, np.float64) for shape in ((count, 2), (count, 2), (3, 3))]
    pairs = (number(rng), number(rng)), (number(rng), number(rng))
    shape = (count, *rng.integers(1, 33, 2).tolist())
    values = [*inputs, *pairs, bool(rng.integers(2)), number(rng)]
    return [backend(rng), *values, *(np.zeros(shape, np.float32) for _ in range(2))]


def make_templates(rng: Random) -> Arguments:
    count, height, width = rng.integers(1, 33, 3).tolist()
    windows = filled(rng, (count, height + 2, width + 2), np.float32)
    shapes = (count, height * width), (count, 4, height * width), (count, 4, 4)
    return [windows, number(rng), *(np.zeros(shape, np.float32) for shape in shapes)]


def step_windows(rng: Random) -> Arguments:
    count, pixels = int(rng.integers(0, 9)), int(rng.integers(1, 1025))
    shapes = (count, pixels), (count, 4, pixels), (count, 4, 4), (count, pixels)
    inputs = [filled(rng, shape, np.float32) for shape in shapes]
    outputs = [np.zeros(shape, np.float32) for shape in ((count, 4), (count,), (count,))]
    return [*inputs, number(rng), *outputs]


def transfer_disparity(rng: Random) -> Arguments:
    h, w = size(rng)
    target = int(rng.integers(0, 70))
    return [filled(rng, (h, w), np.float32), number(rng), np.zeros((h, target), np.float32)]


def depth_candidates(rng: Random) -> Arguments:
    maps = [np.zeros(size(rng), np.float32)] * 2
    geometry = [filled(rng, (3, 3), np.float64), (number(rng), number(rng)), (number(rng), number(rng))]
    numbers = [number(rng) for _ in range(4)]
    flags = [bool(rng.integers(2)), number(rng), bool(rng.integers(2)), int(rng.integers(0, 9))]
    disparity = filled(rng, size(rng), np.float32)
    return [backend(rng), disparity, *geometry, *numbers, *flags, maps[0], maps[1].copy()]


def vote_depth(rng: Random) -> Arguments:
    h, w = size(rng)
    pairs = int(rng.integers(0, 12))
    inputs = [filled(rng, (pairs, h, w), np.float32) for _ in range(2)]
    stations = np.sort(filled(rng, (pairs,), np.int32))
    return [
        backend(rng),
        *inputs,
        stations,
        number(rng),
        *(np.zeros((h, w), kind) for kind in (np.float32, np.float32, np.uint8)),
    ]


def compare_depths(rng: Random) -> Arguments:
    sizes = [size(rng)] * 2 + [size(rng)] * 2
    inputs = [filled(rng, shape, np.float32) for shape in sizes]
    support, least = filled(rng, sizes[2], np.uint8), int(rng.integers(-1, 4))
    matrices = [filled(rng, (3, 4), np.float64) for _ in range(2)]
    counts = [filled(rng, sizes[0], np.uint8) for _ in range(3)]
    sums = [filled(rng, sizes[0], np.float32) for _ in range(2)]
    if rng.random() < 0.5:  # a few pixels aside
        matrices = [np.hstack([np.eye(3), rng.uniform(-3, 3, (3, 1))]) for _ in range(2)]
    gates = [number(rng), number(rng), least, bool(rng.integers(2))]
    return [backend(rng), *inputs, support, *matrices, *gates, *counts, *sums]


def fuse_partner(rng: Random) -> Arguments:
    reference, partner = fused_maps(rng), fused_maps(rng)
    shape = reference[0].shape
    matrices = [filled(rng, (3, 4), np.float64), filled(rng, (3, 3), np.float64)]
    if rng.random() < 0.5:  # a few pixels aside
        matrices[0] = np.hstack([np.eye(3), rng.uniform(-3, 3, (3, 1))])
    image = filled(rng, (*partner[0].shape, 3), np.uint8)
    gates = [number(rng) for _ in range(3)]
    rays = [filled(rng, (3, 3), np.float64) for _ in range(2)]
    verdict = verdicts(rng, shape)
    flags = [bool(rng.integers(2)), int(rng.integers(8 * len(verdict[1])))]
    given = [*reference, rays[0], *partner, rays[1], image, *matrices, *gates, *flags]
    return [*given, *some_rows(rng, shape[0]), *verdict]


def find_gates(rng: Random) -> Arguments:
    maps = fuse_partner(rng)
    reference, partner, matrices = maps[:2], maps[3:5], maps[7:9]
    h, w = reference[0].shape
    count = int(rng.integers(0, 50)) if h and w else 0
    places = [rng.integers(0, max(most, 1), count).astype(np.int32) for most in (h, w)]
    outputs = [np.zeros(count, np.uint8), np.zeros(count, np.float32)]
    return [*reference, *partner, *matrices, number(rng), number(rng), *places, *outputs]


def pack_normals(rng: Random) -> Arguments:
    normals = fused_maps(rng)[1]
    h, w = normals.shape[1:]
    return [normals, np.zeros((2, h, w), np.float32), np.zeros((h, w), np.uint8)]


def unpack_normals(rng: Random) -> Arguments:
    h, w = size(rng)
    return [filled(rng, (2, h, w), np.float32), filled(rng, (h, w), np.uint8), np.zeros((3, h, w), np.float32)]


def count_points(rng: Random) -> Arguments:
    maps = fused_maps(rng)
    least, stations = int(rng.integers(0, 5)), filled(rng, (2,), np.uint64)
    return [*maps, *verdicts(rng, maps[0].shape), least, stations, *some_rows(rng, len(maps[0]))]


def write_points(rng: Random) -> Arguments:
    rows = count_points(rng)
    points, words = _native.count_points(*rows)
    frame = [filled(rng, shape, np.float64) for shape in ((3, 3), (3, 3), (3,))]
    outputs = [np.zeros((points, 27), np.uint8), np.zeros(words, np.uint32)]
    return [*rows, *frame, filled(rng, (65,), np.uint32), *outputs]


def draw_heights(rng: Random) -> Arguments:
    frame = [filled(rng, shape, np.float64) for shape in ((3, 3), (3, 3), (3,))]
    return [*fused_maps(rng), *frame, number(rng), number(rng), filled(rng, size(rng), np.float32)]


def fused_maps(rng: Random) -> Arguments:
    h, w = size(rng)
    return [filled(rng, (h, w), np.float32), filled(rng, (3, h, w), np.float32)]


def some_rows(rng: Random, height: int) -> Arguments:
    return sorted(int(row) for row in rng.integers(0, height + 1, 2))


def verdicts(rng: Random, shape: tuple[int, ...]) -> Arguments:
    covered = rng.integers(0, 2, shape, np.uint8)
    agreeing = filled(rng, (int(rng.integers(1, 9)), *shape), np.uint8)
    return [covered, agreeing, filled(rng, (*shape, 3), np.uint16)]


def fit_planes(rng: Random) -> Arguments:
    h, w = size(rng)
    inputs = [filled(rng, (h, w), np.float32) for _ in range(2)]
    outputs = [np.zeros((h, w, 3), np.float32), np.zeros((h, w), np.float32)]
    K = filled(rng, (3, 3), np.float64)
    support = filled(rng, (h, w), np.uint8)
    gates = [number(rng), number(rng), number(rng), int(rng.integers(-1, 5))]
    return [backend(rng), *inputs, support, K, int(rng.integers(1, 17)), number(rng), *gates, *outputs]


def add_relief(rng: Random) -> Arguments:
    shape = size(rng)
    return [filled(rng, shape, np.float32) for _ in range(3)]


def confirm_depth(rng: Random) -> Arguments:
    shape = size(rng)
    maps = [filled(rng, shape, np.float32) for _ in range(2)]
    counts = [filled(rng, shape, np.uint8) for _ in range(3)]
    sums = [filled(rng, shape, np.float32) for _ in range(2)]
    views = [int(rng.integers(-1, 300)), int(rng.integers(-1, 3))]
    return [*maps, *views, number(rng), number(rng), number(rng), *counts, *sums]


def add_patch_equations(rng: Random) -> Arguments:
    h, w = size(rng)
    step = int(rng.integers(1, 4))
    first = int(rng.integers(0, h + 1))
    rows = int(rng.integers(0, (h - first + step - 1) // step + 1))
    image = filled(rng, (h, w), np.uint8)
    count = int(rng.integers(1, 5))
    sources = tuple(filled(rng, size(rng), np.uint16) for _ in range(count))
    matrices = np.zeros((count, 3, 4))
    for matrix in matrices:
        # Half of them look at the same place, so that windows do meet.
        same = np.hstack([np.eye(3), np.zeros((3, 1))])
        matrix[:] = same if rng.random() < 0.5 else filled(rng, (3, 4), np.float64)
    used = filled(rng, (-(-w // 32),), np.uint32)
    planes = filled(rng, (3, rows, w), np.float32)
    equations = np.zeros((12, rows, w), np.float32)
    limits = (number(rng), number(rng) / 10)
    return [backend(rng), image, sources, matrices, used, planes, first, step, *limits, equations]


def source_pixels(rng: Random) -> Arguments:
    h, w = size(rng)
    tables = [filled(rng, shape, np.float32) for shape in ((3, h), (3, w), (w,))]
    places = [np.zeros((h, w), kind) for kind in (np.float32, np.float32, np.uint8)]
    return [backend(rng), *tables, int(rng.integers(0, 100)), int(rng.integers(0, 100)), *places]


def resample(rng: Random) -> Arguments:
    h, w = size(rng)
    tables = [filled(rng, shape, np.float32) for shape in ((3, h), (3, w), (w,))]
    source = tuple(int(side) for side in rng.integers(2, 30, 2))
    mask = filled(rng, source, np.uint8)[: source[0] * int(rng.integers(0, 2))]
    places = [np.zeros((h, w), kind) for kind in (np.float32, np.uint8)]
    return [backend(rng), *tables, filled(rng, source, np.float32), mask, *places]


def half_image(rng: Random) -> Arguments:
    h, w = size(rng)
    fine = finer(rng, (h, w))
    return [filled(rng, fine, np.float32), np.zeros((h, w), np.float32)]


def half_mask(rng: Random) -> Arguments:
    h, w = size(rng)
    fine = finer(rng, (h, w))
    return [filled(rng, fine, np.uint8), np.zeros((h, w), np.uint8)]


def sharpen(rng: Random) -> Arguments:
    h, w = size(rng)
    return [backend(rng), filled(rng, (h, w), np.float32), number(rng), np.zeros((h + 6, w + 8), np.int16)]


def planes_of_maps(rng: Random) -> Arguments:
    h, w = size(rng)
    step = int(rng.integers(1, 4))
    first = int(rng.integers(0, h + 1))
    rows = int(rng.integers(0, (h - first + step - 1) // step + 1))
    maps = [filled(rng, (h, w, 3), np.float32), filled(rng, (h, w), np.float32)]
    return [*maps, filled(rng, (3, 3), np.float64), first, step, np.zeros((3, rows, w), np.float32)]


def maps_of_planes(rng: Random) -> Arguments:
    h, w = size(rng)
    first, end = sorted(int(row) for row in rng.integers(0, h + 1, 2))
    planes = filled(rng, (3, end - first, w), np.float32)
    maps = [np.zeros((h, w, 3), np.float32), np.zeros((h, w), np.float32)]
    return [planes, filled(rng, (3, 3), np.float64), first, *maps]


def refine_planes(rng: Random) -> Arguments:
    shape = size(rng)
    inputs = [filled(rng, (12, *shape), np.float32), filled(rng, shape, np.float32)]
    return [*inputs, number(rng), filled(rng, (3, *shape), np.float32)]


def backend(rng: Random) -> str:
    """A name of kernels that this processor has."""
    return str(rng.choice(_native.backends()))


def margin(rng: Random) -> int:
    """Of a warped image, columns."""
    return int(rng.integers(0, 40)) if rng.random() < 0.8 else 65535


def number(rng: Random) -> float:
    """A likely number, or an odd one."""
    return float(rng.uniform(0, 10)) if rng.random() < 0.7 else float(rng.choice(FLOATS))


FUNCTIONS: dict[str, Callable[[Random], Arguments]] = {
    function.__name__: function
    for function in (
        census,
        matching_cost,
        aggregation,
        selection,
        sweep_bytes,
        sweep,
        match,
        fit_offsets,
        warp,
        unwarp_offsets,
        mean_offsets,
        upsample_offsets,
        search_windows,
        to_disparity,
        transfer_disparity,
        depth_candidates,
        vote_depth,
        compare_depths,
        fuse_partner,
        find_gates,
        pack_normals,
        unpack_normals,
        count_points,
        write_points,
        draw_heights,
        confirm_depth,
        fit_planes,
        add_relief,
        add_patch_equations,
        planes_of_maps,
        maps_of_planes,
        refine_planes,
        keep_between,
        remove_small_segments,
        count_fractions,
        unwarp_torn,
        source_pixels,
        resample,
        half_image,
        half_mask,
        sharpen,
        first_offsets,
        target_bases,
        join_targets,
        bases_about,
        mark_steps,
        count_slopes,
        disparity_range,
        code_disparity,
        decode_disparity,
        seed_planes,
        fit_surfaces,
        place_windows,
        make_templates,
        step_windows,
    )
}


# ---- wrong arguments ---------------------------------------------------------------------------------------


def spoiled(value: Any, others: Arguments, rng: Random) -> Any:
    """Another value in the place of a valid one: mostly of the right kind, but wrong."""
    if rng.random() < 0.1:
        return ODD_OBJECTS[int(rng.integers(len(ODD_OBJECTS)))]
    if isinstance(value, np.ndarray):
        return spoiled_array(value, others, rng)
    if isinstance(value, bool | int):
        return INTEGERS[int(rng.integers(len(INTEGERS)))]
    if isinstance(value, float):
        return FLOATS[int(rng.integers(len(FLOATS)))]
    if isinstance(value, tuple) and value and isinstance(value[0], np.ndarray) and rng.random() < 0.7:
        place = int(rng.integers(len(value)))
        return (*value[:place], spoiled(value[place], others, rng), *value[place + 1 :])
    if isinstance(value, tuple):
        return [value[:1], (*value, 1.0), (None, None), list(value), (np.nan, np.inf)][int(rng.integers(5))]
    return ["", "avx1024", "scalar\0", "é" * 1000][int(rng.integers(4))]


def spoiled_array(array: np.ndarray, others: Arguments, rng: Random) -> Any:
    """Another item type, shape, layout or memory."""
    arrays = [other for other in others if isinstance(other, np.ndarray)]
    longer = tuple(n + int(rng.integers(-1, 2)) if n else n for n in array.shape)
    with np.errstate(all="ignore"):
        ways: list[Callable[[], np.ndarray]] = [
            lambda: np.zeros(array.shape, DTYPES[int(rng.integers(len(DTYPES)))]),
            lambda: np.zeros(longer, array.dtype),
            lambda: np.zeros(array.shape[::-1], array.dtype),
            lambda: array.ravel(),
            lambda: array[None],
            lambda: array[..., ::-1],
            lambda: np.repeat(array, 2, axis=-1)[..., ::2],
            lambda: np.asfortranarray(array),
            lambda: np.broadcast_to(np.zeros((), array.dtype), array.shape),
            lambda: np.broadcast_to(np.zeros((), array.dtype), (2**31,) * array.ndim)[:0],
            lambda: np.zeros((*array.shape[:-1], 0), array.dtype),
            lambda: np.zeros((0, *array.shape[1:-1], 2**40), array.dtype),
            lambda: array.astype(array.dtype.newbyteorder()),
            lambda: np.frombuffer(bytes(array.nbytes + 1), np.uint8)[1:].view(array.dtype).reshape(array.shape),
            lambda: arrays[int(rng.integers(len(arrays)))],
            lambda: (
                arrays[int(rng.integers(len(arrays)))].ravel().view(np.uint8)[: array.nbytes].view(array.dtype)
            ),
        ]
        try:
            return ways[int(rng.integers(len(ways)))]()
        except (ValueError, TypeError):  # such an array cannot be had of this one
            return None


def call_function(rng: Random) -> None:
    """One call of a C function, half of them with one to three wrong arguments."""
    name = str(rng.choice(list(FUNCTIONS)))
    arguments = FUNCTIONS[name](rng)
    if rng.random() < 0.5:
        for place in rng.integers(len(arguments), size=int(rng.integers(1, 4))):
            arguments[place] = spoiled(arguments[place], arguments, rng)
    try:
        result = getattr(_native, name)(*arguments)
    except ALLOWED:
        return
    if result is not None and name not in ("count_points", "count_slopes", "sweep_bytes"):
        raise AssertionError(f"{name} returned {result!r}")


def read_map(rng: Random) -> None:
    """One file of random content, mostly with a header, through the readers of maps."""
    words = [b"%d" % INTEGERS[int(rng.integers(len(INTEGERS)))] if rng.random() < 0.3 else b"2" for _ in range(3)]
    header = b"&".join(words) + (b"&" if rng.random() < 0.9 else b"")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.bin"
        path.write_bytes((header if rng.random() < 0.9 else b"") + rng.bytes(int(rng.choice([0, 3, 16, 32, 48]))))
        for read in (read_depth_map, read_normal_map):
            try:
                read(path)
            except InputError:
                continue


# ---- the loop ----------------------------------------------------------------------------------------------


def work(first: int, calls: int, seconds: float, current: Any) -> None:
    """Call until the time is over, telling the seed before each call."""
    end = time.monotonic() + seconds
    for seed in range(first, first + calls):
        if time.monotonic() > end:
            break
        current.value = seed
        rng = np.random.default_rng(seed)
        if rng.random() < 0.02:
            read_map(rng)
        else:
            call_function(rng)
    else:
        seed += 1
    print(f"{seed - first} calls, seeds {first} to {seed - 1}: no failure")


def main() -> int:
    """Entry point; 1 where a call failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30, help="time to spend (default: 30)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first call (default: 0)")
    parser.add_argument("--calls", type=int, default=10**9, help="number of calls, at most")
    options = parser.parse_args()
    missing = {name for name in dir(_native) if not name.startswith("_")} - {
        "backends",
        "missing",
        "signatures",
        *FUNCTIONS,
    }
    if missing:
        print(f"{', '.join(sorted(missing))}: no entry in FUNCTIONS of {Path(__file__).name}")
        return 1
    context = multiprocessing.get_context("fork")
    current = context.Value("Q", options.seed, lock=False)
    child = context.Process(target=work, args=(options.seed, options.calls, options.seconds, current))
    child.start()
    # A call that hangs holds the process longer than any of them takes.
    child.join(options.seconds + 60)
    if child.is_alive():
        child.kill()
        child.join()
    if child.exitcode:
        seed = current.value
        print(f"seed {seed} failed (exit code {child.exitcode}); repeat it with --seed {seed} --calls 1")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
