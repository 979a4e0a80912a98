"""The compiled kernels; see `_native/kernels.h` for what they compute and `_native/module.c` for their checks."""

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]

def backends() -> list[str]: ...
def census(backend: str, padded: Array, valid: Array, census: Array, /) -> None: ...
def matching_cost(backend: str, reference: Array, target: Array, base: Array, cost: Array, /) -> None: ...
def aggregation(
    backend: str,
    cost: Array,
    base: Array,
    image: Array,
    p1: int,
    p2: Array,
    max_slant: int,
    detours: Array,
    aggregated: Array,
    /,
) -> None: ...
def selection(
    backend: str,
    aggregated: Array,
    base: Array,
    reference: Array,
    target: Array,
    max_difference: int,
    max_excess: int,
    offset: Array,
    /,
) -> None: ...
def match(
    backend: str,
    reference: Array,
    target: Array,
    base: Array,
    image: Array,
    p1: int,
    p2: Array,
    max_slant: int,
    max_difference: int,
    max_excess: int,
    scratch: Array,
    offset: Array,
    /,
) -> None: ...
def refine_offsets(backend: str, offset: Array, reference: Array, target: Array, refined: Array, /) -> None: ...
def transfer_disparity(left: Array, max_step: float, right: Array, /) -> None: ...
def depth_candidates(
    backend: str,
    disparity: Array,
    rectified_from_pixel: Array,
    scales: tuple[float, float],
    origins: tuple[float, float],
    disparity_origin: float,
    baseline: float,
    disparity_sigma: float,
    max_disparity_step: float,
    spherical: bool,
    is_left: bool,
    first_row: int,
    depth: Array,
    sigma: Array,
    /,
) -> None: ...
def vote_depth(
    depths: Array, sigmas: Array, tolerance: float, depth: Array, sigma: Array, support: Array, /
) -> None: ...
def check_consistency(
    backend: str,
    depth: Array,
    sigma: Array,
    partner_depth: Array,
    partner_sigma: Array,
    partner_support: Array,
    partner_from_reference: Array,
    reference_from_partner: Array,
    max_reprojection_error: float,
    tolerance: float,
    min_support: int,
    observing: Array,
    agreeing: Array,
    contradicting: Array,
    weighted_depth: Array,
    weight: Array,
    /,
) -> None: ...
def confirm_depth(
    depth: Array,
    sigma: Array,
    min_consistent: int,
    max_contradiction: float,
    min_surface: float,
    steepest: float,
    observing: Array,
    agreeing: Array,
    contradicting: Array,
    weighted_depth: Array,
    weight: Array,
    /,
) -> None: ...
def fuse_partner(
    depth: Array,
    normals: Array,
    ray_from_pixel: Array,
    partner_depth: Array,
    partner_normals: Array,
    partner_ray_from_pixel: Array,
    partner_image: Array,
    partner_from_reference: Array,
    normal_from_partner: Array,
    max_reprojection_error: float,
    max_depth_error: float,
    min_normal_cosine: float,
    partner_wins: bool,
    bit: int,
    covered: Array,
    agreeing: Array,
    colour: Array,
    /,
) -> None: ...
def count_points(
    depth: Array,
    normals: Array,
    covered: Array,
    agreeing: Array,
    colour: Array,
    min_views: int,
    first_row: int,
    end_row: int,
    /,
) -> tuple[int, int]: ...
def write_points(
    depth: Array,
    normals: Array,
    covered: Array,
    agreeing: Array,
    colour: Array,
    min_views: int,
    first_row: int,
    end_row: int,
    world_from_pixel: Array,
    world_from_camera: Array,
    centre: Array,
    indices: Array,
    points: Array,
    visibility: Array,
    /,
) -> None: ...
def fit_planes(
    backend: str,
    inverse_depth: Array,
    inverse_sigma: Array,
    support: Array,
    K: Array,
    radius: int,
    tolerance: float,
    max_shift: float,
    shift_sigma: float,
    min_cosine: float,
    supported: int,
    normals: Array,
    fitted_depth: Array,
    /,
) -> None: ...
def add_patch_equations(
    backend: str,
    image: Array,
    sources: tuple[Array, ...],
    sources_from_reference: Array,
    planes: Array,
    first_row: int,
    row_step: int,
    contrast: float,
    min_score: float,
    equations: Array,
    /,
) -> None: ...
def refine_planes(equations: Array, sigma: Array, slope_sigma: float, planes: Array, /) -> None: ...
