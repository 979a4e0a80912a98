"""The boundary between Python and C: wrong arguments raise, odd ones are survived, nothing crashes."""

import importlib
import inspect
import itertools
import re

import numpy as np
import oracle
import pytest

from colmap_sph import _native

BACKENDS = _native.backends()
every_backend = pytest.mark.parametrize("backend", BACKENDS)

H, W, TARGET, DEPTH = 4, 40, 45, 32
STATE = _native.sweep_bytes("scalar", W, DEPTH)
SCRATCH = np.zeros((2, H * W, DEPTH), np.uint8)


def arguments(function):
    """Valid arguments of every function, by name, outputs last."""
    f32, f64, u8 = np.float32, np.float64, np.uint8
    census_pair = {"reference": np.zeros((H, W), np.uint64), "target": np.zeros((H, TARGET), np.uint64)}
    shown = {"columns": np.zeros((H, TARGET), np.int32), "source_width": 50}
    matrix = np.hstack([np.eye(3), np.zeros((3, 1))])
    table = {
        "census": {
            "backend": "scalar",
            "padded": np.zeros((H + 6, W + 8), np.int16),
            "valid": np.ones((H, W), u8),
            "fine": True,
            "grey_step": 100,
            "first": 3,
            "out census": np.zeros((H, W + 5), np.uint64),
        },
        "matching_cost": {
            "backend": "scalar",
            **census_pair,
            "base": np.zeros((H, W), np.int32),
            "out cost": np.zeros((H, W, DEPTH), u8),
        },
        "aggregation": {
            "backend": "scalar",
            "cost": np.zeros((H, W, DEPTH), u8),
            "base": np.zeros((H, W), np.int32),
            "image": np.zeros((H, W), u8),
            "p1": 10,
            "p2": np.full(256, 60, u8),
            "max_slant": 2,
            "out detours": np.zeros((H, W, DEPTH), u8),
            "out aggregated": np.zeros((H, W, DEPTH), u8),
        },
        "selection": {
            "backend": "scalar",
            "aggregated": np.zeros((H, W, DEPTH), u8),
            "base": np.zeros((H, W), np.int32),
            **census_pair,
            **shown,
            "max_difference": 2,
            "max_excess": 4,
            "out offset": np.zeros((H, W), np.int32),
        },
        "match": {
            "backend": "scalar",
            **census_pair,
            **shown,
            "base": np.zeros((H, W), np.int32),
            "surface": np.zeros((H, W), np.int32),
            "image": np.zeros((H, W), u8),
            "p1": 10,
            "p2": np.full(256, 60, u8),
            "max_slant": 2,
            "max_difference": 2,
            "max_excess": 4,
            "first": 1,
            "above": 7,
            "below": 3,
            "out forward": np.zeros(STATE, u8),
            "out backward": np.zeros(STATE, u8),
            "out scratch": np.zeros((2, (H - 2) * W, DEPTH), u8),
            "out offset": np.zeros((H - 2, W), np.int32),
        },
        "sweep_bytes": {"backend": "scalar", "width": W, "depth": DEPTH},
        "sweep": {
            "backend": "scalar",
            **census_pair,
            "base": np.zeros((H, W), np.int32),
            "surface": np.zeros((H, W), np.int32),
            "image": np.zeros((H, W), u8),
            "depth": DEPTH,
            "p1": 10,
            "p2": np.full(256, 60, u8),
            "max_slant": 2,
            "first": 1,
            "end": H - 1,
            "above": 7,
            "below": 3,
            "backward": False,
            "out state": np.zeros(STATE, u8),
        },
        "fit_offsets": {
            "backend": "scalar",
            "offset": np.zeros((H, W), np.int32),
            **census_pair,
            "out fitted": np.zeros((H, W), np.int32),
        },
        "warp": {
            "source": np.zeros((H, 50), f32),
            "valid": np.ones((H, 50), u8),
            "prediction": np.zeros((H, W), np.int32),
            "margin": 3,
            "out warped": np.zeros((H, TARGET), f32),
            "out warped_valid": np.zeros((H, TARGET), u8),
            "out columns": np.zeros((H, TARGET), np.int32),
        },
        "unwarp_offsets": {
            "offset": np.zeros((H, W), np.int32),
            "prediction": np.zeros((H, W), np.int32),
            "margin": 3,
            "out unwarped": np.zeros((H, W), np.int32),
        },
        "mean_offsets": {
            "backend": "scalar",
            "offset": np.zeros((H, W), np.int32),
            "radius": 2,
            "max_step": 300,
            "out mean": np.zeros((H, W), np.int32),
        },
        "upsample_offsets": {
            "backend": "scalar",
            "offset": np.zeros((H, W), np.int32),
            "max_step": 300,
            "out fine": np.zeros((2 * H, 2 * W - 1), np.int32),
        },
        "search_windows": {
            "least": np.zeros((H, W), f32),
            "most": np.zeros((H, W), f32),
            "predicted": np.zeros((2 * H - 1, 2 * W), np.int32),
            "depth": 32,
            "clearance": 4,
            "own_clearance": 6,
            "out base": np.zeros((2 * H - 1, 2 * W), np.int32),
        },
        "to_disparity": {
            "offset": np.zeros((H, W), np.int32),
            "shifts": np.zeros(256, f32),
            "out disparity": np.zeros((H, W), f32),
        },
        **offsets_arguments(),
        **ties_arguments(),
        "transfer_disparity": {
            "left": np.zeros((H, W), f32),
            "max_step": 2.0,
            "out right": np.zeros((H, TARGET), f32),
        },
        "depth_candidates": {
            "backend": "scalar",
            "disparity": np.zeros((H, W), f32),
            "rectified_from_pixel": np.eye(3),
            "scales": (100.0, 100.0),
            "origins": (0.0, 0.0),
            "disparity_origin": 3.0,
            "baseline": 1.0,
            "disparity_sigma": 0.3,
            "max_disparity_step": 2.0,
            "spherical": True,
            "flatness": 0.9,
            "is_left": True,
            "first_row": 0,
            "out depth": np.zeros((5, 6), f32),
            "out sigma": np.zeros((5, 6), f32),
        },
        "vote_depth": {
            "backend": "scalar",
            "depths": np.zeros((3, H, W), f32),
            "sigmas": np.zeros((3, H, W), f32),
            "stations": np.array([1, 1, 2], np.int32),
            "tolerance": 3.0,
            "out depth": np.zeros((H, W), f32),
            "out sigma": np.zeros((H, W), f32),
            "out support": np.zeros((H, W), u8),
        },
        "compare_depths": {
            "backend": "scalar",
            "depth": np.ones((H, W), f32),
            "sigma": np.ones((H, W), f32),
            "partner_depth": np.ones((5, 6), f32),
            "partner_sigma": np.ones((5, 6), f32),
            "partner_support": np.ones((5, 6), u8),
            "partner_from_reference": matrix,
            "reference_from_partner": matrix.copy(),
            "max_reprojection_error": 1.0,
            "tolerance": 4.0,
            "min_support": 2,
            "silence_counts": False,
            "out observing": np.zeros((H, W), u8),
            "out agreeing": np.zeros((H, W), u8),
            "out contradicting": np.zeros((H, W), u8),
            "out weighted_shift": np.zeros((H, W), f32),
            "out weight": np.zeros((H, W), f32),
        },
        "fuse_partner": {
            **fused_maps(),
            "ray_from_pixel": np.eye(3),
            "partner_depth": np.ones((5, 6), f32),
            "partner_normals": np.ones((3, 5, 6), f32),
            "partner_ray_from_pixel": np.eye(3),
            "partner_image": np.ones((5, 6, 3), u8),
            "partner_from_reference": matrix,
            "normal_from_partner": np.eye(3),
            "max_reprojection_error": 0.5,
            "max_depth_error": 0.01,
            "min_normal_cosine": 0.9,
            "partner_wins": True,
            "bit": 0,
            "first_row": 1,
            "end_row": H,
            "out covered": np.zeros((H, W), u8),
            "out agreeing": np.zeros((8, H, W), u8),
            "out colour": np.zeros((H, W, 3), np.uint16),
        },
        "find_gates": {
            **fused_maps(),
            "partner_depth": np.ones((5, 6), f32),
            "partner_normals": np.ones((3, 5, 6), f32),
            "partner_from_reference": matrix,
            "normal_from_partner": np.eye(3),
            "max_depth_error": 0.01,
            "min_normal_cosine": 0.9,
            "rows": np.array([0, H - 1, 1], np.int32),
            "columns": np.array([W - 1, 0, 1], np.int32),
            "out gate": np.zeros(3, u8),
            "out distance": np.zeros(3, f32),
        },
        "pack_normals": {
            "normals": np.ones((3, H, W), f32),
            "out pair": np.zeros((2, H, W), f32),
            "out codes": np.zeros((H, W), u8),
        },
        "unpack_normals": {
            "pair": np.ones((2, H, W), f32),
            "codes": np.zeros((H, W), u8),
            "out normals": np.zeros((3, H, W), f32),
        },
        "count_points": {
            **fused_maps(),
            **verdicts(),
            "min_stations": 1,
            "stations": every_station(),
            "first_row": 0,
            "end_row": H,
        },
        "write_points": {
            **fused_maps(),
            **verdicts(),
            "min_stations": 1,
            "stations": every_station(),
            "first_row": 1,
            "end_row": H,
            "world_from_pixel": np.eye(3),
            "world_from_camera": np.eye(3),
            "centre": np.zeros(3),
            "indices": np.arange(65, dtype=np.uint32),
            "out points": np.zeros(((H - 1) * W, 27), u8),
            "out visibility": np.zeros(2 * (H - 1) * W, np.uint32),
        },
        "draw_heights": {
            "depth": np.ones((5, 6), f32),
            "normals": np.full((3, 5, 6), -0.5, f32),
            "ray_from_pixel": np.eye(3),
            "cells_from_camera": np.eye(3),
            "shift": np.zeros(3),
            "half": 0.5,
            "max_ratio": 2.0,
            "out raster": np.zeros((H, W), f32),
        },
        "confirm_depth": {
            "depth": np.ones((H, W), f32),
            "sigma": np.ones((H, W), f32),
            "min_consistent": 2,
            "may_miss": 1,
            "max_contradiction": 0.5,
            "min_surface": 0.8,
            "steepest": 0.01,
            "observing": np.ones((H, W), u8),
            "out agreeing": np.ones((H, W), u8),
            "out contradicting": np.zeros((H, W), u8),
            "out weighted_shift": np.zeros((H, W), f32),
            "out weight": np.zeros((H, W), f32),
        },
        "fit_planes": {
            "backend": "scalar",
            "inverse_depth": np.ones((H, W), f32),
            "inverse_sigma": np.ones((H, W), f32),
            "support": np.ones((H, W), u8),
            "K": np.eye(3, dtype=f64),
            "radius": 4,
            "tolerance": 3.0,
            "max_shift": 1.0,
            "shift_sigma": 2.0,
            "min_cosine": 0.2,
            "supported": 3,
            "out normals": np.zeros((H, W, 3), f32),
            "out fitted_depth": np.zeros((H, W), f32),
        },
        "add_relief": {
            "depth": np.ones((H, W), f32),
            "sigma": np.ones((H, W), f32),
            "out fitted_depth": np.ones((H, W), f32),
        },
        "add_patch_equations": {
            "backend": "scalar",
            "image": np.zeros((H, W), u8),
            "sources": (np.zeros((9, 20), np.uint16), np.zeros((8, 7), np.uint16)),
            "sources_from_reference": np.stack([matrix, matrix]),
            "used": np.full((W + 31) // 32, 3, np.uint32),
            "planes": np.ones((3, H, W), f32),
            "first_row": 0,
            "row_step": 1,
            "contrast": 20.0,
            "min_score": 0.5,
            "out equations": np.zeros((12, H, W), f32),
        },
        "source_pixels": {
            "backend": "scalar",
            "ray_rows": np.ones((3, H), f32),
            "ray_columns": np.ones((3, W), f32),
            "weights": np.ones(W, f32),
            "source_width": 30,
            "source_height": 20,
            "out columns": np.zeros((H, W), f32),
            "out rows": np.zeros((H, W), f32),
            "out inside": np.zeros((H, W), u8),
        },
        "resample": {
            "backend": "scalar",
            "ray_rows": np.ones((3, H), f32),
            "ray_columns": np.ones((3, W), f32),
            "weights": np.ones(W, f32),
            "image": np.ones((20, 30), f32),
            "mask": np.ones((20, 30), u8),
            "out grey": np.zeros((H, W), f32),
            "out valid": np.zeros((H, W), u8),
        },
        "half_image": {
            "image": np.ones((2 * H - 1, 2 * W), f32),
            "out half": np.zeros((H, W), f32),
        },
        "half_mask": {
            "mask": np.ones((2 * H, 2 * W - 1), u8),
            "out half": np.zeros((H, W), u8),
        },
        "sharpen": {
            "backend": "scalar",
            "image": np.zeros((H, W), f32),
            "sharpening": 0.6,
            "out padded": np.zeros((H + 6, W + 8), np.int16),
        },
        "planes_of_maps": {
            "normals": np.ones((H, W, 3), f32),
            "depth": np.ones((H, W), f32),
            "inverse_K": np.eye(3),
            "first_row": 0,
            "row_step": 1,
            "out planes": np.zeros((3, H, W), f32),
        },
        "maps_of_planes": {
            "planes": np.ones((3, H, W), f32),
            "K": np.eye(3),
            "first_row": 0,
            "out normals": np.zeros((H, W, 3), f32),
            "out depth": np.zeros((H, W), f32),
        },
        "refine_planes": {
            "equations": np.zeros((12, H, W), f32),
            "sigma": np.ones((H, W), f32),
            "slope_sigma": 0.1,
            "out planes": np.ones((3, H, W), f32),
        },
    }
    return table[function]


def offsets_arguments():
    """Those of the functions that work on offsets between the kernels of matching."""

    def ints():
        return np.zeros((H, W), np.int32)

    def torn():
        return np.zeros((H, W), np.uint8)

    return {
        "keep_between": {"out offset": ints(), "first": -300, "last": 300},
        "remove_small_segments": {"out offset": ints(), "min_segment": 20},
        "count_fractions": {"offset": ints(), "out counts": np.zeros(256, np.uint32)},
        "unwarp_torn": {"offset": ints(), "torn": torn(), "as_it_is": 70, "out unwarped": ints()},
        "first_offsets": {"predicted": ints(), "base": ints(), "torn": torn(), "out first": ints()},
        "target_bases": {
            "base": ints(),
            "torn": torn(),
            "margin": 32,
            "as_it_is": 70,
            "gap": 32,
            "out target_base": ints(),
        },
        "join_targets": {
            "warped_width": W,
            "source_width": 50,
            "out census": np.zeros((H, W + 55), np.uint64),
            "out columns": np.zeros((H, W + 55), np.int32),
        },
        "bases_about": {"out offset": ints(), "depth": 32, "first": -40, "last": 40},
        "mark_steps": {"offset": ints(), "max_step": 700, "out marks": np.zeros((H, W), np.uint8)},
        "count_slopes": {"offset": ints(), "edge": 1000, "slope": 100},
        "disparity_range": {"disparity": np.zeros((H, W), np.float32), "out ends": np.zeros(2, np.float32)},
        "code_disparity": {
            "disparity": np.zeros((H, W), np.float32),
            "least": 0.0,
            "step": 0.5,
            "out codes": np.zeros((H, W), np.uint16),
        },
        "decode_disparity": {
            "codes": np.zeros((H, W), np.uint16),
            "least": 0.0,
            "step": 0.5,
            "out disparity": np.zeros((H, W), np.float32),
        },
        "seed_planes": {
            "columns": np.zeros(9),
            "rows": np.zeros(9),
            "values": np.ones(9),
            "neighbours": 5,
            "alike": 4.0,
            "stiffness": 0.1,
            "unknown_stiffness": 0.1,
            "cell": 3,
            "out planes": np.zeros((H, W), np.float32),
        },
    }


def ties_arguments():
    """Those of the functions that measure ties."""
    count, side = 3, 5

    def floats(*shape):
        return np.zeros(shape, np.float32)

    return {
        "fit_surfaces": {
            "disparity": floats(20, 30),
            "places": np.full((count, 2), 9.5),
            "least_found": 0.8,
            "out planes": np.zeros((count, 3)),
            "out roughness": floats(count),
        },
        "place_windows": {
            "backend": "scalar",
            "places": np.zeros((count, 2)),
            "slopes": np.ones((count, 2)),
            "pixel_from_ray": np.eye(3),
            "origins": (0.0, 0.0),
            "scales": (9.0, 9.0),
            "spherical": True,
            "flatness": 0.9,
            "out columns": floats(count, side, side),
            "out rows": floats(count, side, side),
        },
        "make_templates": {
            "windows": floats(count, side + 2, side + 2),
            "least_contrast": 0.5,
            "out values": floats(count, side**2),
            "out jacobian": floats(count, 4, side**2),
            "out normal": floats(count, 4, 4),
        },
        "step_windows": {
            "values": floats(count, side**2),
            "jacobian": floats(count, 4, side**2),
            "inverse": floats(count, 4, 4),
            "windows": floats(count, side**2),
            "least_contrast": 0.5,
            "out move": floats(count, 4),
            "out correlation": floats(count),
            "out variance": floats(count),
        },
    }


def fused_maps():
    return {"depth": np.ones((H, W), np.float32), "normals": np.ones((3, H, W), np.float32)}


def every_station():
    """Each partner stands alone, and elsewhere than the view."""
    return np.full(2, 2**64 - 1, np.uint64)


def verdicts():
    return {
        "covered": np.zeros((H, W), np.uint8),
        "agreeing": np.zeros((8, H, W), np.uint8),
        "colour": np.zeros((H, W, 3), np.uint16),
    }


FUNCTIONS = [
    "census",
    "matching_cost",
    "aggregation",
    "selection",
    "match",
    "fit_offsets",
    "sweep_bytes",
    "sweep",
    "warp",
    "unwarp_offsets",
    "mean_offsets",
    "upsample_offsets",
    "search_windows",
    "to_disparity",
    "transfer_disparity",
    "depth_candidates",
    "vote_depth",
    "compare_depths",
    "fuse_partner",
    "find_gates",
    "pack_normals",
    "unpack_normals",
    "count_points",
    "write_points",
    "draw_heights",
    "confirm_depth",
    "fit_planes",
    "add_relief",
    "add_patch_equations",
    "planes_of_maps",
    "maps_of_planes",
    "refine_planes",
    "source_pixels",
    "resample",
    "half_image",
    "half_mask",
    "sharpen",
    *offsets_arguments(),
    *ties_arguments(),
]
MATCHING = FUNCTIONS[:6]


def call(function, values):
    return getattr(_native, function)(*values.values())


def each_array(function):
    return [name for name, value in arguments(function).items() if isinstance(value, np.ndarray)]


ARRAYS = [(function, name) for function in FUNCTIONS for name in each_array(function)]
OUTPUTS = [(function, name) for function, name in ARRAYS if name.startswith("out ")]
# Axes whose length no other argument fixes, so that any size is right.
FREE = {
    ("matching_cost", "target"): {1},
    ("fit_offsets", "target"): {1},
    ("sweep", "target"): {1},
    ("census", "out census"): {1},
    ("resample", "mask"): {0},  # none has no rows
    ("warp", "prediction"): {1},
    ("warp", "out columns"): {1},
    ("upsample_offsets", "out fine"): {0, 1},  # one less than twice as many will do, see below
    **{
        (function, name): {0, 1}
        for function, name in (
            ("keep_between", "out offset"),
            ("remove_small_segments", "out offset"),
            ("count_fractions", "offset"),
            ("bases_about", "out offset"),
            ("count_slopes", "offset"),
            ("disparity_range", "disparity"),
            ("seed_planes", "out planes"),
            ("half_image", "image"),  # one less than twice as many will do, see below
            ("half_mask", "mask"),
            ("fit_surfaces", "disparity"),
        )
    },
    ("transfer_disparity", "left"): {1},
    ("transfer_disparity", "out right"): {1},
    ("depth_candidates", "disparity"): {0, 1},
    ("add_patch_equations", "image"): {0},
    ("draw_heights", "out raster"): {0, 1},
    ("fuse_partner", "out agreeing"): {0},
    ("count_points", "agreeing"): {0},
    ("write_points", "agreeing"): {0},
    ("planes_of_maps", "out planes"): {1},
    ("maps_of_planes", "planes"): {1},
}


# ---- the tables of arguments -------------------------------------------------------------------------------

SIGNATURES = dict(_native.signatures())


def taken(function):
    """(name, role, type, sizes) of what a function takes."""
    return [argument for argument in SIGNATURES[function] if argument[1] != "result"]


def test_the_tables_name_every_function_and_argument():
    assert set(SIGNATURES) == set(FUNCTIONS)
    for function in FUNCTIONS:
        names = [("out " if role == "out" else "") + name for name, role, *_ in taken(function)]
        assert names == list(arguments(function))


@pytest.mark.parametrize("function", FUNCTIONS)
def test_docstrings_describe_every_argument(function):
    native = getattr(_native, function)
    assert list(inspect.signature(native).parameters) == [name for name, *_ in taken(function)]
    for name, role, kind, _ in SIGNATURES[function]:
        line = f"\nreturned: {name}" if role == "result" else rf"\n{name} : .*{re.escape(kind)}"
        assert re.search(line, native.__doc__)


def test_the_stub_is_what_the_tables_say(scripts_on_path):
    script = importlib.import_module("make_native_stub")
    assert script.STUB.read_text() == script.stub(), "run scripts/make_native_stub.py"


def refusals(function, place):
    """What is wrong with an array and must be said with its name: (error, another array)."""
    right = list(arguments(function).values())[place]
    _, role, kind, size = SIGNATURES[function][place]
    assert right.dtype == kind and right.ndim == len(size)
    yield TypeError, right.astype(np.float32 if kind != "float32" else np.uint8)
    yield TypeError, np.zeros((*right.shape[:-1], 2 * right.shape[-1]), kind)[..., ::2]
    yield ValueError, right[None]
    if role == "out":
        right.flags.writeable = False
        yield TypeError, right
    before = {symbol for argument in SIGNATURES[function][:place] for symbol, _ in argument[3]}
    for axis, (symbol, least) in enumerate(size):
        if symbol is None or symbol in before:
            for wrong in (right.shape[axis] + 1, right.shape[axis] - 1):
                yield ValueError, np.zeros((*right.shape[:axis], wrong, *right.shape[axis + 1 :]), kind)
        elif least:
            yield ValueError, np.zeros((*right.shape[:axis], least - 1, *right.shape[axis + 1 :]), kind)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_what_is_refused_is_named(function):
    names = list(arguments(function))
    for place, (name, role, kind, _) in enumerate(taken(function)):
        if role in ("in", "out"):
            wrongs = list(refusals(function, place))
        elif kind == "bool":
            continue  # anything is true or false
        else:
            wrongs = [(TypeError, object())]
        if kind == "int":
            wrongs += [(TypeError, 1.5), (OverflowError, 2**63), (OverflowError, -(2**63) - 1)]
        if role == "images":
            wrongs += [(TypeError, (None,))]
        for error, wrong in wrongs:
            with pytest.raises(error, match=rf"^{name}\b"):
                call(function, {**arguments(function), names[place]: wrong})


@pytest.mark.parametrize("function", FUNCTIONS)
def test_arrays_are_let_go_of(function):
    """After a call, and after one that is refused at each of the arguments."""
    for wrong in (None, *(name for name, value in arguments(function).items() if not isinstance(value, bool))):
        values = arguments(function)
        views = [value.data for value in values.values() if isinstance(value, np.ndarray)]
        kept = iter(views)
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                values[name] = next(kept)
            if name == wrong:
                values[name] = object()
        if wrong is None:
            call(function, values)
        else:
            with pytest.raises(TypeError):
                call(function, values)
        for view in views:
            view.release()  # BufferError where C still has it


# ---- wrong arguments ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("function", FUNCTIONS)
def test_valid_arguments_are_accepted(function):
    state = (8 * W + 1) * DEPTH  # two rows of four paths, and a pixel
    results = {
        "count_points": (H * W, 2 * H * W),
        "count_slopes": ((W - 1) // 2, 0),
        "sweep_bytes": (state,),
    }
    assert call(function, arguments(function)) == results.get(function)


@pytest.mark.parametrize(("function", "name"), ARRAYS)
def test_wrong_item_type_is_refused(function, name):
    right = arguments(function)[name]
    wrong_types = {np.uint8, np.int8, np.int32, np.uint32, np.int64, np.float32, np.float64, np.complex64}
    for dtype in wrong_types - {right.dtype.type}:
        values = {**arguments(function), name: right.astype(dtype)}
        with pytest.raises(TypeError, match=r"items of type"):
            call(function, values)
    for odd in (
        right.astype(right.dtype.newbyteorder(">")),
        np.zeros(right.shape, dtype="O"),
        None,
        "text",
        [1],
    ):
        if isinstance(odd, np.ndarray) and odd.dtype == right.dtype:
            continue  # single bytes have no order
        with pytest.raises(TypeError):
            call(function, {**arguments(function), name: odd})


@pytest.mark.parametrize(("function", "name"), ARRAYS)
def test_wrong_shape_is_refused(function, name):
    right = arguments(function)[name]
    for axis in range(right.ndim):
        if axis in FREE.get((function, name), ()):
            continue
        for shape in (right.shape[axis] + 1, right.shape[axis] - 1, 0):
            wrong = np.zeros((*right.shape[:axis], shape, *right.shape[axis + 1 :]), right.dtype)
            with pytest.raises(ValueError, match=r"size|dimensions|disparities"):
                call(function, {**arguments(function), name: wrong})


@pytest.mark.parametrize(("function", "name"), ARRAYS)
def test_wrong_number_of_dimensions_is_refused(function, name):
    right = arguments(function)[name]
    for wrong in (
        right[..., None],
        right.ravel() if right.ndim > 1 else right[None],
        np.zeros((), right.dtype),
    ):
        with pytest.raises(ValueError, match="dimensions"):
            call(function, {**arguments(function), name: np.ascontiguousarray(wrong).reshape(wrong.shape)})


@pytest.mark.parametrize(("function", "name"), ARRAYS)
def test_memory_that_is_not_contiguous_is_refused(function, name):
    right = arguments(function)[name]
    strided = np.zeros((*right.shape[:-1], 2 * right.shape[-1]), right.dtype)[..., ::2]
    backwards = np.zeros_like(right)[..., ::-1]
    fortran = np.asfortranarray(np.zeros_like(right)) if right.ndim > 1 else strided
    for wrong in (strided, backwards, fortran):
        assert wrong.shape == right.shape
        with pytest.raises(TypeError, match="contiguous"):
            call(function, {**arguments(function), name: wrong})


@pytest.mark.parametrize(("function", "name"), ARRAYS)
def test_misaligned_memory_is_refused(function, name):
    right = arguments(function)[name]
    if right.itemsize == 1:
        return
    memory = np.zeros(right.nbytes + 1, dtype=np.uint8)
    wrong = memory[1:].view(right.dtype).reshape(right.shape)
    with pytest.raises((TypeError, ValueError)):
        call(function, {**arguments(function), name: wrong})


@pytest.mark.parametrize(("function", "name"), OUTPUTS)
def test_read_only_output_is_refused(function, name):
    values = arguments(function)
    values[name].flags.writeable = False
    with pytest.raises(TypeError, match="writable"):
        call(function, values)


@pytest.mark.parametrize(("function", "name"), [pair for pair in ARRAYS if pair not in OUTPUTS])
def test_read_only_input_is_accepted(function, name):
    values = arguments(function)
    values[name].flags.writeable = False
    call(function, values)


@pytest.mark.parametrize(("function", "name"), OUTPUTS)
def test_output_that_overlaps_another_array_is_refused(function, name):
    for other in each_array(function):
        if other == name:
            continue
        values = arguments(function)
        first, second = values[name], values[other]
        # Both in one block of memory, the last item of one under the first of the other.
        memory = np.full(first.nbytes + second.nbytes, 60, dtype=np.uint8)
        start = (first.nbytes - 1) // second.itemsize * second.itemsize
        values[name] = memory[: first.nbytes].view(first.dtype).reshape(first.shape)
        values[other] = memory[start : start + second.nbytes].view(second.dtype).reshape(second.shape)
        # With other verdicts there are other points to write, for which the arrays have not the size.
        sized = function == "write_points" and other in ("depth", "covered", "agreeing")
        with pytest.raises(ValueError, match="overlaps|size" if sized else "overlaps"):
            call(function, values)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_wrong_number_of_arguments_is_refused(function):
    values = list(arguments(function).values())
    for wrong in (values[:-1], [*values, None], []):
        with pytest.raises(TypeError):
            getattr(_native, function)(*wrong)


@pytest.mark.parametrize("function", MATCHING)
@pytest.mark.parametrize("backend", ["", "AVX2", "avx1024", "scalar ", "scälar"])
def test_unknown_backend_is_refused(function, backend):
    with pytest.raises(ValueError, match="no kernels named"):
        call(function, {**arguments(function), "backend": backend})


@pytest.mark.parametrize("function", MATCHING)
def test_backend_must_be_text(function):
    for backend in (None, 1, b"scalar"):
        with pytest.raises(TypeError):
            call(function, {**arguments(function), "backend": backend})
    with pytest.raises(ValueError, match="null character"):
        call(function, {**arguments(function), "backend": "scalar\0"})


@pytest.mark.parametrize("depth", [0, 1, 31, 33, 48, 1056, 2048])
def test_number_of_disparities_out_of_bounds_is_refused(depth):
    volumes = {
        "matching_cost": ["out cost"],
        "selection": ["aggregated"],
        "aggregation": ["cost", "out detours", "out aggregated"],
        "match": ["out scratch"],
    }
    for function, names in volumes.items():
        values = arguments(function)
        for name in names:
            values[name] = np.zeros((*values[name].shape[:-1], depth), values[name].dtype)
        with pytest.raises(ValueError, match="multiple of 32"):
            call(function, values)


@pytest.mark.parametrize(
    ("p1", "p2"), [(-1, 60), (256, 60), (266, 60), (10, 128), (10, 255), (64, 64), (61, 60), (-246, 60)]
)
def test_penalties_out_of_bounds_are_refused(p1, p2):
    table = np.full(256, 100, np.uint8)
    table[255] = p2
    with pytest.raises(ValueError, match="penalties"):
        call("aggregation", {**arguments("aggregation"), "p1": p1, "p2": table})


@pytest.mark.parametrize("p1", [2**31, -(2**31) - 1, 2**70])
def test_penalty_beyond_32_bits_is_refused(p1):
    with pytest.raises(OverflowError):
        call("aggregation", {**arguments("aggregation"), "p1": p1})


@pytest.mark.parametrize("function", ["selection", "match"])
@pytest.mark.parametrize("limit", ["max_difference", "max_excess"])
def test_negative_limits_of_the_left_right_check_are_refused(function, limit):
    with pytest.raises(ValueError, match="difference must" if limit == "max_difference" else "excess"):
        call(function, {**arguments(function), limit: -1})


@pytest.mark.parametrize("function", ["selection", "match"])
@pytest.mark.parametrize(
    ("width", "message"), [(-1, "negative"), (-(2**31), "negative"), (65536, "65535"), (2**31 - 1, "65535")]
)
def test_sources_of_impossible_width_are_refused(function, width, message):
    with pytest.raises(ValueError, match=message):
        call(function, {**arguments(function), "source_width": width})


@pytest.mark.parametrize(
    ("function", "change"),
    [
        *((function, {"first": first}) for function in ("sweep", "match") for first in (-1, 0, H, 2**40)),
        *(("sweep", {"end": end}) for end in (0, H, H + 1, 2**40)),
        *((function, {beside: -1}) for function in ("sweep", "match") for beside in ("above", "below")),
        ("match", {"first": 2}),
        (
            "match",
            {"out offset": np.zeros((H, W), np.int32), "out scratch": np.zeros((2, H * W, DEPTH), np.uint8)},
        ),
        ("match", {"out scratch": SCRATCH}),
        ("match", {"out forward": np.zeros(9, np.uint8), "out backward": np.zeros(9, np.uint8)}),
        ("sweep", {"out state": np.zeros(9, np.uint8)}),
        ("sweep", {"depth": 33}),
    ],
)
def test_bands_that_are_not_among_the_rows_are_refused(function, change):
    with pytest.raises(ValueError, match=r"row|scratch|state|multiple"):
        call(function, {**arguments(function), **change})


@every_backend
def test_the_size_of_a_state_is_told_without_memory_for_one(backend):
    """Where memory is refused, functions say that, and not that the state they are given has another size."""
    resource, psutil = map(pytest.importorskip, ("resource", "psutil"))
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + (64 << 20), before[1]))
    try:
        (size,) = _native.sweep_bytes(backend, 65535, 1024)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert size >= 3 * 65535 * 1024  # at least three paths come from the row before


@pytest.mark.parametrize("change", [{"first": -1}, {"first": 6}, {"out census": np.zeros((H, W + 2), np.uint64)}])
def test_census_must_fit_into_the_rows(change):
    with pytest.raises(ValueError, match="must fit"):
        call("census", {**arguments("census"), **change})


def test_steps_of_grey_values_must_not_be_negative():
    with pytest.raises(ValueError, match="negative"):
        call("census", {**arguments("census"), "grey_step": -1})


def test_columns_must_have_room_for_the_warped_image():
    call("warp", {**arguments("warp"), "out columns": np.zeros((H, TARGET + 1), np.int32)})
    with pytest.raises(ValueError, match="room"):
        call("warp", {**arguments("warp"), "out columns": np.zeros((H, TARGET - 1), np.int32)})


@pytest.mark.parametrize("change", [{"warped_width": -1}, {"warped_width": W + 6}, {"source_width": 56}])
def test_targets_must_fit_beside_each_other(change):
    with pytest.raises(ValueError, match="beside"):
        call("join_targets", {**arguments("join_targets"), **change})


@pytest.mark.parametrize("function", ["warp", "unwarp_offsets"])
@pytest.mark.parametrize("margin", [-1, 65536, 2**31 - 1, -(2**31)])
def test_margins_out_of_bounds_are_refused(function, margin):
    with pytest.raises(ValueError, match="margin"):
        call(function, {**arguments(function), "margin": margin})


@pytest.mark.parametrize(("name", "most"), [("radius", 10), ("max_step", 1 << 20)])
def test_bounds_of_means_are_kept(name, most):
    for value in (0, most):
        call("mean_offsets", {**arguments("mean_offsets"), name: value})
    for value in (-1, most + 1, 2**31 - 1):
        with pytest.raises(ValueError, match=name):
            call("mean_offsets", {**arguments("mean_offsets"), name: value})


@pytest.mark.parametrize("function", ["upsample_offsets", "search_windows", "half_image", "half_mask"])
@pytest.mark.parametrize("size", [(2 * H + 1, 2 * W), (2 * H, 2 * W + 1), (2 * H - 2, 2 * W), (H, W), (0, 0)])
def test_levels_of_other_sizes_are_refused(function, size):
    values = arguments(function)
    names = {"out fine", "predicted", "out base", "image", "mask"} & set(values)
    fine = {name: np.zeros(size, values[name].dtype) for name in names}
    with pytest.raises(ValueError, match="twice the size"):
        call(function, {**values, **fine})


def test_bounds_of_search_windows_are_kept():
    values = arguments("search_windows")
    for name in ("clearance", "own_clearance"):
        for value in (0, 16):
            call("search_windows", {**values, name: value})
        for value in (-1, 17, 2**31 - 1, -(2**31)):
            with pytest.raises(ValueError, match="clearance"):
                call("search_windows", {**values, name: value})
    for value in (0, 31, -32, 1056):
        with pytest.raises(ValueError, match="multiple of 32"):
            call("search_windows", {**values, "depth": value})
    for step in (-1, 2**20 + 1):
        with pytest.raises(ValueError, match="max_step"):
            call("upsample_offsets", {**arguments("upsample_offsets"), "max_step": step})


def test_windows_about_numbers_out_of_this_world():
    values = arguments("search_windows")
    for least, most in itertools.product([np.nan, np.inf, -np.inf, 3e38, -3e38], repeat=2):
        values["least"], values["most"] = (np.full((H, W), value, np.float32) for value in (least, most))
        values["predicted"][:] = np.random.default_rng(0).choice([-(2**31), 0, 2**31 - 1], (2 * H - 1, 2 * W))
        call("search_windows", values)
        assert (np.abs(values["out base"] + 16) <= 10).all()


@pytest.mark.parametrize(
    ("function", "name", "wrong"),
    [
        *[("unwarp_torn", "as_it_is", value) for value in (-1, 2**20 + 1)],
        *[("target_bases", name, value) for name in ("margin", "as_it_is", "gap") for value in (-1, 2**20 + 1)],
        *[("bases_about", "depth", value) for value in (-1, 0, 1025)],
        *[("bases_about", "first", value) for value in (41, 2**31 - 1)],
        ("mark_steps", "max_step", -1),
        *[("count_slopes", name, -1) for name in ("edge", "slope")],
        *[("seed_planes", "neighbours", value) for value in (0, 33)],
        ("seed_planes", "cell", 0),
    ],
)
def test_bounds_of_the_passes_over_offsets_are_kept(function, name, wrong):
    with pytest.raises(ValueError, match="must"):
        call(function, {**arguments(function), name: wrong})


@pytest.mark.parametrize("count", [0, 2049])
def test_impossible_numbers_of_seeds_are_refused(count):
    seeds = {name: np.zeros(count) for name in ("columns", "rows", "values")}
    with pytest.raises(ValueError, match="1 to 2048 seeds"):
        call("seed_planes", {**arguments("seed_planes"), **seeds})


@pytest.mark.parametrize("size", [(0, 5), (33, 32)])
def test_windows_of_impossible_sizes_are_refused(size):
    places = {f"out {name}": np.zeros((3, *size), np.float32) for name in ("columns", "rows")}
    with pytest.raises(ValueError, match="1 to 1024 pixels"):
        call("place_windows", {**arguments("place_windows"), **places})
    windows = np.zeros((3, size[0] + 2, size[1] + 2), np.float32)
    templates = {
        name: np.zeros((*shape, size[0] * size[1]), np.float32)
        for name, shape in (("out values", (3,)), ("out jacobian", (3, 4)))
    }
    with pytest.raises(ValueError, match="1 to 1024 pixels"):
        call("make_templates", {**arguments("make_templates"), "windows": windows, **templates})


def test_negative_slant_is_refused():
    with pytest.raises(ValueError, match="slant"):
        call("aggregation", {**arguments("aggregation"), "max_slant": -1})


@pytest.mark.parametrize("bit", [-1, 64, 2**31 - 1, -(2**31)])
def test_more_partners_than_bits_are_refused(bit):
    with pytest.raises(ValueError, match="bit must be one of a pixel's"):
        call("fuse_partner", {**arguments("fuse_partner"), "bit": bit})


@pytest.mark.parametrize("function", ["count_points", "write_points"])
def test_more_than_64_bits_are_refused(function):
    with pytest.raises(ValueError, match="no more than 64 bits"):
        call(function, {**arguments(function), "agreeing": np.zeros((9, H, W), np.uint8)})


@pytest.mark.parametrize("function", ["fuse_partner", "count_points", "write_points"])
@pytest.mark.parametrize("rows", [(-1, 2), (0, H + 1), (3, 2), (H + 1, H + 1), (-(2**62), 2**62)])
def test_rows_outside_the_map_are_refused(function, rows):
    with pytest.raises(ValueError, match="rows must lie in the map"):
        call(function, {**arguments(function), "first_row": rows[0], "end_row": rows[1]})


@pytest.mark.parametrize("least", [-(2**31), 0, 1, 2, 65, 2**31 - 1])
def test_points_are_counted_for_any_number_of_views(least):
    values = {**arguments("count_points"), "min_stations": least}
    values["agreeing"][:, 0, 0] = 255
    values["covered"][1] = 1
    expected = {1: ((H - 1) * W, 2 * (H - 1) * W + 64), 2: (1, 66), 66: (0, 0)}
    assert call("count_points", values) == expected[min(max(least, 1), 2) if least <= 65 else 66]


def test_agreeing_partners_of_one_station_count_as_one():
    """Bits 0 and 1 stand where the view does, 2 to 4 side by side, 5 and all others each alone."""
    values = arguments("count_points")
    values["stations"][:] = (~np.uint64(0b11), ~np.uint64(0b001101))
    agreeing = [0b000000, 0b000011, 0b000100, 0b011000, 0b011111, 0b100000, 0b111100, 2**63 | 0b100001]
    stations = [1, 1, 2, 2, 2, 2, 3, 3]
    for bits, expected in zip(agreeing, stations, strict=True):
        values["agreeing"][:] = np.frombuffer(bits.to_bytes(8, "little"), np.uint8)[:, None, None]
        for least in range(1, 5):
            words = H * W * (2 + bits.bit_count())
            seen = call("count_points", {**values, "min_stations": least})
            assert seen == ((H * W, words) if least <= expected else (0, 0)), (bits, least)


def test_stations_that_do_not_ascend_are_refused():
    values = arguments("vote_depth")
    values["stations"][:] = [2, 1, 3]
    with pytest.raises(ValueError, match="stations must ascend"):
        call("vote_depth", values)


@pytest.mark.parametrize("radius", [-1, 0, 17, 2**31 - 1])
def test_window_radius_out_of_bounds_is_refused(radius):
    with pytest.raises(ValueError, match="radius"):
        call("fit_planes", {**arguments("fit_planes"), "radius": radius})


@pytest.mark.parametrize("count", [0, 33])
def test_number_of_sources_out_of_bounds_is_refused(count):
    values = arguments("add_patch_equations")
    values["sources"] = (np.zeros((9, 20), np.uint16),) * count
    values["sources_from_reference"] = np.zeros((count, 3, 4))
    with pytest.raises(ValueError, match=r"sources must lie in 1\.\.32"):
        call("add_patch_equations", values)


def test_as_many_sources_as_are_allowed_are_accepted():
    values = arguments("add_patch_equations")
    values["sources"] = tuple(np.zeros((9 + k, 20), np.uint16) for k in range(32))
    values["sources_from_reference"] = np.zeros((32, 3, 4))
    call("add_patch_equations", values)


@pytest.mark.parametrize("place", [0, 1])
def test_every_source_is_checked(place):
    right = np.zeros((9, 20), np.uint16)
    values = arguments("add_patch_equations")
    memory = np.zeros(values["out equations"].nbytes, np.uint8)
    for wrong, error, message in [
        (right.astype(np.float32), TypeError, "items of type"),
        (None, TypeError, "contiguous"),
        (right[:, ::2], TypeError, "contiguous"),
        (right[None], ValueError, "dimensions"),
        (np.zeros((0, 65536), np.uint16), ValueError, "65535"),
        (np.broadcast_to(right, (2, 9, 20))[0].T, TypeError, "contiguous"),
        (memory[-24:].view(np.uint16).reshape(3, 4), ValueError, "overlaps"),
    ]:
        sources = list(values["sources"])
        sources[place] = wrong
        equations = memory.view(np.float32).reshape(values["out equations"].shape)
        with pytest.raises(error, match=message):
            call("add_patch_equations", {**values, "sources": tuple(sources), "out equations": equations})


@pytest.mark.parametrize("sources", [None, np.zeros((2, 9, 20), np.uint16), [np.zeros((9, 20), np.uint16)] * 2])
def test_sources_must_be_a_tuple(sources):
    with pytest.raises(TypeError, match="tuple"):
        call("add_patch_equations", {**arguments("add_patch_equations"), "sources": sources})


@pytest.mark.parametrize("function", ["add_patch_equations", "planes_of_maps", "maps_of_planes"])
@pytest.mark.parametrize("first_row", [-1, 1, 2**62])
def test_rows_beyond_the_image_are_refused(function, first_row):
    with pytest.raises(ValueError, match="rows"):
        call(function, {**arguments(function), "first_row": first_row})


@pytest.mark.parametrize(("rows", "step"), [(H, 0), (H, -1), (H, 2), (2, H), (2, 2**63 - 1), (1, 0)])
def test_steps_beyond_the_image_are_refused(rows, step):
    planes, equations = np.ones((3, rows, W), np.float32), np.zeros((12, rows, W), np.float32)
    changed = {"planes": planes, "row_step": step, "out equations": equations}
    with pytest.raises(ValueError, match="rows must lie in the image"):
        call("add_patch_equations", {**arguments("add_patch_equations"), **changed})
    with pytest.raises(ValueError, match="rows must lie in the image"):
        call("planes_of_maps", {**arguments("planes_of_maps"), "row_step": step, "out planes": planes})


@pytest.mark.parametrize(("rows", "step"), [(1, 2**63 - 1), (2, H - 1), (0, 5)])
def test_steps_within_the_image_are_accepted(rows, step):
    planes, equations = np.ones((3, rows, W), np.float32), np.zeros((12, rows, W), np.float32)
    changed = {"planes": planes, "row_step": step, "out equations": equations}
    call("add_patch_equations", {**arguments("add_patch_equations"), **changed})


def test_rows_beyond_16_bits_are_refused():
    values = arguments("selection")
    values["target"] = np.zeros((H, 65536), np.uint64)
    values["columns"] = np.zeros((H, 65536), np.int32)
    with pytest.raises(ValueError, match="65535"):
        call("selection", values)
    wide = {
        name: np.zeros((1, 65536, *value.shape[2:]), value.dtype)
        for name, value in values.items()
        if name in ("aggregated", "base", "reference", "out offset")
    }
    with pytest.raises(ValueError, match="65535"):
        narrow = {"target": np.zeros((1, 8), np.uint64), "columns": np.zeros((1, 8), np.int32)}
        call("selection", {**arguments("selection"), **wide, **narrow})
    values = arguments("warp")
    for names in (["source", "valid"], ["prediction"], ["out warped", "out warped_valid", "out columns"]):
        wide = {name: np.zeros((H, 65536), values[name].dtype) for name in names}
        with pytest.raises(ValueError, match="65535"):
            call("warp", {**values, **wide})
    for function in ("unwarp_offsets", "mean_offsets"):
        values = arguments(function)
        wide = {name: np.zeros((1, 65536), np.int32) for name in each_array(function)}
        with pytest.raises(ValueError, match="65535"):
            call(function, {**values, **wide})


@every_backend
@pytest.mark.parametrize("size", [(0, 0), (0, 40), (3, 0)])
@pytest.mark.parametrize("target_width", [0, 9])
def test_empty_images_are_no_work(backend, size, target_width):
    image, base, words = np.zeros(size, np.uint8), np.zeros(size, np.int32), np.zeros(size, np.uint64)
    target = np.zeros((size[0], target_width), np.uint64)
    shown = np.zeros((size[0], target_width), np.int32), 9
    volume, sums = np.zeros((*size, 32), np.uint8), np.zeros((*size, 32), np.uint8)
    _native.census(backend, np.zeros((size[0] + 6, size[1] + 8), np.int16), image, True, 100, 0, words)
    _native.matching_cost(backend, words, target, base, volume)
    _native.aggregation(backend, volume, base, image, 10, np.full(256, 60, np.uint8), 2, volume.copy(), sums)
    offset = np.zeros(size, np.int32)
    _native.selection(backend, sums, base, words, target, *shown, 2, 0, offset)
    _native.unwarp_offsets(offset, base, 65535, offset.copy())
    _native.mean_offsets(backend, offset, 10, 1 << 20, offset.copy())
    _native.upsample_offsets(backend, offset, 0, np.zeros((2 * size[0], 2 * size[1]), np.int32))
    _native.to_disparity(offset, np.zeros(256, np.float32), np.zeros(size, np.float32))


@every_backend
def test_target_without_columns_is_never_matched(backend):
    target = np.zeros((H, 0), np.uint64)
    base, reference = np.zeros((H, W), np.int32), np.zeros((H, W), np.uint64)
    cost, offset = np.zeros((H, W, DEPTH), np.uint8), np.zeros((H, W), np.int32)
    _native.matching_cost(backend, reference, target, base, cost)
    np.testing.assert_array_equal(cost, oracle.COST_UNSEEN)
    _native.selection(backend, cost, base, reference, target, target.astype(np.int32), 50, 2, 0, offset)
    np.testing.assert_array_equal(offset, oracle.OFFSET_INVALID)


@every_backend
def test_empty_images_of_absurd_width_are_refused_or_no_work(backend):
    """Sizes whose product overflows fit into no memory, but an array without rows can claim them."""
    width = 2**56
    base = np.empty((0, width), np.int32)
    p2 = np.full(256, 60, np.uint8)
    volume = np.empty((0, width, 32), np.uint8)
    image = np.empty((0, width), np.uint8)
    words = np.empty((0, width), np.uint64)
    for function, values in {
        "aggregation": (volume, base, image, 10, p2, 2, volume.copy(), volume.copy()),
        "matching_cost": (words, words, base, volume),
        "selection": (volume, base, words, words, base.copy(), 9, 2, 0, np.empty((0, width), np.int32)),
    }.items():
        with pytest.raises((ValueError, MemoryError)):
            getattr(_native, function)(backend, *values)


def test_endless_rows_of_nothing_are_refused():
    nothing = np.empty((2**40, 0), np.float32)
    with pytest.raises(ValueError, match="left is empty, yet has size 1099511627776 along axis 0"):
        _native.transfer_disparity(nothing, 1.0, nothing.copy())


@pytest.mark.parametrize("shape", [(0, 0), (0, 7), (7, 0)])
def test_empty_maps_are_no_work(shape):
    empty, bytes_ = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    matrix = np.hstack([np.eye(3), np.zeros((3, 1))])
    partner = np.ones((5, 6), np.float32)
    right = np.ones((shape[0], 4), np.float32)
    _native.transfer_disparity(empty, 2.0, right)
    assert np.isnan(right).all()
    _native.transfer_disparity(np.ones((shape[0], 4), np.float32), 2.0, empty)
    geometry = (np.eye(3), (9.0, 9.0), (0.0, 0.0), 1.0, 1.0, 0.3, 2.0, True, 0.9, True, 0)
    depth = np.ones((5, 6), np.float32)
    _native.depth_candidates("scalar", empty, *geometry, depth, np.ones_like(depth))
    assert not depth.any()
    _native.depth_candidates("scalar", partner, *geometry, empty, empty.copy())
    _native.vote_depth(
        "scalar",
        np.ones((3, *shape), np.float32),
        np.ones((3, *shape), np.float32),
        *(np.arange(3, dtype=np.int32), 3.0, empty, empty.copy(), bytes_),
    )
    for reference, other in ((empty, partner), (partner, empty)):
        counts = [np.zeros(reference.shape, dtype) for dtype in (*[np.uint8] * 3, *[np.float32] * 2)]
        for backend in BACKENDS:
            maps = reference, reference, other, other, np.ones(other.shape, np.uint8)
            _native.compare_depths(backend, *maps, matrix, matrix, 1.0, 4.0, 2, False, *counts)
            assert not any(count.any() for count in counts)
        fuse_empty(reference, other, matrix)
    _native.fit_planes(
        "scalar",
        empty,
        empty,
        np.zeros(shape, np.uint8),
        np.eye(3),
        *(4, 3.0, 1.0, 2.0, 0.2, 3),
        np.zeros((*shape, 3), np.float32),
        empty.copy(),
    )


def fuse_empty(reference, other, matrix):
    """Fuse a map with another, one of which has no pixels, and write its points."""
    maps = [(depth, np.ones((3, *depth.shape), np.float32), np.eye(3)) for depth in (reference, other)]
    shape = reference.shape
    verdict = (np.zeros(shape, np.uint8), np.zeros((8, *shape), np.uint8), np.zeros((*shape, 3), np.uint16))
    image = np.ones((*other.shape, 3), np.uint8)
    _native.fuse_partner(
        *maps[0], *maps[1], image, matrix, np.eye(3), 0.5, 0.01, 0.9, True, 63, 0, shape[0], *verdict
    )
    assert not any(array.any() for array in verdict)
    rows = (*maps[0][:2], *verdict, 2, every_station(), 0, shape[0])
    assert _native.count_points(*rows) == (0, 0)
    none = np.zeros((0, 27), np.uint8), np.zeros(0, np.uint32)
    _native.write_points(*rows, np.eye(3), np.eye(3), np.zeros(3), np.zeros(65, np.uint32), *none)


def test_vote_of_no_pairs_is_no_depth():
    depth, sigma, support = (
        np.ones((2, 3), np.float32),
        np.ones((2, 3), np.float32),
        np.ones((2, 3), np.uint8),
    )
    none = np.zeros((0, 2, 3), np.float32)
    _native.vote_depth("scalar", none, none, np.zeros(0, np.int32), 3.0, depth, sigma, support)
    assert not depth.any() and not sigma.any() and not support.any()


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30, -1e30, 1e-40])
def test_numbers_out_of_this_world_do_not_crash(odd):
    """NaN, infinities and magnitudes beyond any image, everywhere a float goes in."""
    rng = np.random.default_rng(0)
    for function in FUNCTIONS[4:]:
        for mixed in (False, True):
            values = arguments(function)
            for name, value in values.items():
                if isinstance(value, float):
                    values[name] = odd
                elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and not name.startswith("out "):
                    chosen = rng.random(value.shape) < 0.5 if mixed else np.ones(value.shape, bool)
                    value[chosen] = odd
            if function == "depth_candidates":
                values["scales"], values["origins"] = (odd, 100.0), (odd, 0.0)
            if function == "write_points":
                count = _native.count_points(*list(values.values())[:9])
                values["out points"] = np.zeros((count[0], 27), np.uint8)
                values["out visibility"] = np.zeros(count[1], np.uint32)
            call(function, values)


@pytest.mark.parametrize("u", [np.nextafter(0.5, 0), np.nextafter(-0.5, 0), 0.5, -0.5])
@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1)])
def test_rays_at_the_rim_of_a_map_stay_inside(u, size):
    """The number before 0.5, plus 0.5, rounds to 1: beyond a map of one column or row."""
    depth, sigma = np.ones((1, 1), np.float32), np.ones((1, 1), np.float32)
    disparity = np.full(size, 4, np.float32)
    for x, y in ((u, 0.0), (0.0, u), (u, u)):
        matrix = np.array([[0, 0, x], [0, 0, y], [0, 0, 1.0]])
        geometry = disparity, matrix, (1.0, 1.0), (0.0, 0.0), 0.0, 1.0, 1.0, 9.0, False, 0.0, True, 0
        _native.depth_candidates("scalar", *geometry, depth, sigma)
        assert depth[0, 0] in (0.0, 0.25)
