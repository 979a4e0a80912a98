"""The compiled kernels; `scripts/make_native_stub.py` writes this from their own tables of arguments."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_Size = tuple[tuple[str | None, int], ...]
_Argument = tuple[str, str, str, _Size]

def backends() -> list[str]:
    """Names of the kernel versions this processor runs, fastest first."""

def missing() -> list[str]:
    """Names of the kernel versions that a build for this kind of processor can have and this one has not."""

def signatures() -> list[tuple[str, tuple[_Argument, ...]]]:
    """Of all other functions (name, ((argument, role, type, ((symbol or None, number), ...)), ...)).

    Roles are value, in, out, images and result; an array's size along an axis is that of the symbol, plus the
    number.
    """

def census(
    backend: str,
    padded: NDArray[np.int16],
    valid: NDArray[np.uint8],
    fine: bool,
    grey_step: int,
    first: int,
    census: NDArray[np.uint64],
    /,
) -> None:
    """Census words from column `first` on, with grey values in steps if not 0; bit 63 where a pixel is not valid.

    backend : str
    padded : (H + 6, W + 8) int16
    valid : (H, W) uint8
    fine : bool
    grey_step : int
    first : int
    census : (H, TARGET_W) uint64, written
    """

def matching_cost(
    backend: str,
    reference: NDArray[np.uint64],
    target: NDArray[np.uint64],
    base: NDArray[np.int32],
    cost: NDArray[np.uint8],
    /,
) -> None:
    """Bits in which census words differ from those of the target, `base` + 0 to D - 1 columns further.

    backend : str
    reference : (H, W) uint64
    target : (H, TARGET_W) uint64
    base : (H, W) int32
    cost : (H, W, D) uint8, written
    """

def aggregation(
    backend: str,
    cost: NDArray[np.uint8],
    base: NDArray[np.int32],
    image: NDArray[np.uint8],
    p1: int,
    p2: NDArray[np.uint8],
    max_slant: int,
    detours: NDArray[np.uint8],
    aggregated: NDArray[np.uint8],
    /,
) -> None:
    """Half of the sums of costs over 8 paths, and on the way what the first four paths add to the costs.

    backend : str
    cost : (H, W, D) uint8
    base : (H, W) int32
    image : (H, W) uint8
    p1 : int
    p2 : (256) uint8
    max_slant : int
    detours : (H, W, D) uint8, written
    aggregated : (H, W, D) uint8, written
    """

def selection(
    backend: str,
    aggregated: NDArray[np.uint8],
    base: NDArray[np.int32],
    reference: NDArray[np.uint64],
    target: NDArray[np.uint64],
    columns: NDArray[np.int32],
    source_width: int,
    max_difference: int,
    max_excess: int,
    offset: NDArray[np.int32],
    /,
) -> None:
    """Offsets of the least sums in 1/256 pixel, -2^31 where the left-right check or content lacks.

    backend : str
    aggregated : (H, W, D) uint8
    base : (H, W) int32
    reference : (H, W) uint64
    target : (H, TARGET_W) uint64
    columns : (H, TARGET_W) int32
    source_width : int
    max_difference : int
    max_excess : int
    offset : (H, W) int32, written
    """

def sweep_bytes(
    backend: str,
    width: int,
    depth: int,
    /,
) -> tuple[int]:
    """Size of the state that a sweep over rows of such a level brings from one band of them to the next.

    backend : str
    width : int
    depth : int
    returned: bytes
    """

def sweep(
    backend: str,
    reference: NDArray[np.uint64],
    target: NDArray[np.uint64],
    base: NDArray[np.int32],
    surface: NDArray[np.int32],
    image: NDArray[np.uint8],
    depth: int,
    p1: int,
    p2: NDArray[np.uint8],
    max_slant: int,
    first: int,
    end: int,
    above: int,
    below: int,
    backward: bool,
    state: NDArray[np.uint8],
    /,
) -> None:
    """The state of a sweep moves over the rows from first to before end, which have so many above and below.

    backend : str
    reference : (H, W) uint64
    target : (H, TARGET_W) uint64
    base : (H, W) int32
    surface : (H, W) int32
    image : (H, W) uint8
    depth : int
    p1 : int
    p2 : (256) uint8
    max_slant : int
    first : int
    end : int
    above : int
    below : int
    backward : bool
    state : (BYTES) uint8, written
    """

def match(
    backend: str,
    reference: NDArray[np.uint64],
    target: NDArray[np.uint64],
    columns: NDArray[np.int32],
    source_width: int,
    base: NDArray[np.int32],
    surface: NDArray[np.int32],
    image: NDArray[np.uint8],
    p1: int,
    p2: NDArray[np.uint8],
    max_slant: int,
    max_difference: int,
    max_excess: int,
    first: int,
    above: int,
    below: int,
    forward: NDArray[np.uint8],
    backward: NDArray[np.uint8],
    scratch: NDArray[np.uint8],
    offset: NDArray[np.int32],
    /,
) -> None:
    """Matching cost, aggregation and selection of rows from first on, with so many above and below; states move.

    backend : str
    reference : (H, W) uint64
    target : (H, TARGET_W) uint64
    columns : (H, TARGET_W) int32
    source_width : int
    base : (H, W) int32
    surface : (H, W) int32
    image : (H, W) uint8
    p1 : int
    p2 : (256) uint8
    max_slant : int
    max_difference : int
    max_excess : int
    first : int
    above : int
    below : int
    forward : (BYTES) uint8, written
    backward : (BYTES) uint8, written
    scratch : (2, BAND, D) uint8, written
    offset : (ROWS, W) int32, written
    """

def fit_offsets(
    backend: str,
    offset: NDArray[np.int32],
    reference: NDArray[np.uint64],
    target: NDArray[np.uint64],
    fitted: NDArray[np.int32],
    /,
) -> None:
    """Offsets fitted to the raw costs of a window around each pixel, in 1/256 pixel.

    backend : str
    offset : (H, W) int32
    reference : (H, W) uint64
    target : (H, TARGET_W) uint64
    fitted : (H, W) int32, written
    """

def warp(
    source: NDArray[np.float32],
    valid: NDArray[np.uint8],
    prediction: NDArray[np.int32],
    margin: int,
    warped: NDArray[np.float32],
    warped_valid: NDArray[np.uint8],
    columns: NDArray[np.int32],
    /,
) -> None:
    """An image as another one is expected to see it, by predicted offsets in 1/256 pixel, and its columns.

    source : (H, SOURCE_W) float32
    valid : (H, SOURCE_W) uint8
    prediction : (H, W) int32
    margin : int
    warped : (H, TARGET_W) float32, written
    warped_valid : (H, TARGET_W) uint8, written
    columns : (H, MAP_W) int32, written
    """

def unwarp_offsets(
    offset: NDArray[np.int32],
    prediction: NDArray[np.int32],
    margin: int,
    unwarped: NDArray[np.int32],
    /,
) -> None:
    """Offsets in a warped image, 1/256 pixel, to those in the image that it was warped from.

    offset : (H, W) int32
    prediction : (H, W) int32
    margin : int
    unwarped : (H, W) int32, written
    """

def mean_offsets(
    backend: str,
    offset: NDArray[np.int32],
    radius: int,
    max_step: int,
    mean: NDArray[np.int32],
    /,
) -> None:
    """Of every offset the mean of those near it that differ from it by no more than `max_step`.

    backend : str
    offset : (H, W) int32
    radius : int
    max_step : int
    mean : (H, W) int32, written
    """

def upsample_offsets(
    backend: str,
    offset: NDArray[np.int32],
    max_step: int,
    fine: NDArray[np.int32],
    /,
) -> None:
    """A level's offsets at the pixels of the next finer one, interpolated on surfaces, repeated at steps.

    backend : str
    offset : (H, W) int32
    max_step : int
    fine : (FINE_H, FINE_W) int32, written
    """

def search_windows(
    least: NDArray[np.float32],
    most: NDArray[np.float32],
    predicted: NDArray[np.int32],
    depth: int,
    clearance: int,
    own_clearance: int,
    base: NDArray[np.int32],
    /,
) -> None:
    """First residuals to search about predicted offsets, by the least and most of the level above around them.

    least : (H, W) float32
    most : (H, W) float32
    predicted : (FINE_H, FINE_W) int32
    depth : int
    clearance : int
    own_clearance : int
    base : (FINE_H, FINE_W) int32, written
    """

def to_disparity(
    offset: NDArray[np.int32],
    shifts: NDArray[np.float32],
    disparity: NDArray[np.float32],
    /,
) -> None:
    """Disparities, pixels, of offsets, less the shift of their fraction; NaN where there is no offset.

    offset : (H, W) int32
    shifts : (256) float32
    disparity : (H, W) float32, written
    """

def transfer_disparity(
    left: NDArray[np.float32],
    max_step: float,
    right: NDArray[np.float32],
    /,
) -> None:
    """Carry a disparity map from the left image's columns to the right image's (NaN = none).

    left : (H, W) float32
    max_step : float
    right : (H, TARGET_W) float32, written
    """

def depth_candidates(
    backend: str,
    disparity: NDArray[np.float32],
    rectified_from_pixel: NDArray[np.floating[Any]],
    scales: tuple[float, float],
    origins: tuple[float, float],
    disparity_origin: float,
    baseline: float,
    disparity_sigma: float,
    max_disparity_step: float,
    spherical: bool,
    flatness: float,
    is_left: bool,
    first_row: int,
    depth: NDArray[np.float32],
    sigma: NDArray[np.float32],
    /,
) -> None:
    """z-depth and its standard deviation (0 = none) from a pair's disparities, for rows of a view from
    `first_row` on; `scales` and `origins` are of columns and rows of the disparity map.

    backend : str
    disparity : (MAP_H, MAP_W) float32
    rectified_from_pixel : (3, 3) float64
    scales : tuple[float, float]
    origins : tuple[float, float]
    disparity_origin : float
    baseline : float
    disparity_sigma : float
    max_disparity_step : float
    spherical : bool
    flatness : float
    is_left : bool
    first_row : int
    depth : (H, W) float32, written
    sigma : (H, W) float32, written
    """

def vote_depth(
    backend: str,
    depths: NDArray[np.float32],
    sigmas: NDArray[np.float32],
    stations: NDArray[np.int32],
    tolerance: float,
    depth: NDArray[np.float32],
    sigma: NDArray[np.float32],
    support: NDArray[np.uint8],
    /,
) -> None:
    """The largest consistent cluster of candidates per pixel: its weighted mean, deviation and size in stations.

    backend : str
    depths : (PAIRS, H, W) float32
    sigmas : (PAIRS, H, W) float32
    stations : (PAIRS) int32
    tolerance : float
    depth : (H, W) float32, written
    sigma : (H, W) float32, written
    support : (H, W) uint8, written
    """

def compare_depths(
    backend: str,
    depth: NDArray[np.float32],
    sigma: NDArray[np.float32],
    partner_depth: NDArray[np.float32],
    partner_sigma: NDArray[np.float32],
    partner_support: NDArray[np.uint8],
    partner_from_reference: NDArray[np.floating[Any]],
    reference_from_partner: NDArray[np.floating[Any]],
    max_reprojection_error: float,
    tolerance: float,
    min_support: int,
    silence_counts: bool,
    observing: NDArray[np.uint8],
    agreeing: NDArray[np.uint8],
    contradicting: NDArray[np.uint8],
    weighted_shift: NDArray[np.float32],
    weight: NDArray[np.float32],
    /,
) -> None:
    """Add what a partner's depth map says of a view's to the sums over all partners.

    backend : str
    depth : (H, W) float32
    sigma : (H, W) float32
    partner_depth : (PARTNER_H, PARTNER_W) float32
    partner_sigma : (PARTNER_H, PARTNER_W) float32
    partner_support : (PARTNER_H, PARTNER_W) uint8
    partner_from_reference : (3, 4) float64
    reference_from_partner : (3, 4) float64
    max_reprojection_error : float
    tolerance : float
    min_support : int
    silence_counts : bool
    observing : (H, W) uint8, written
    agreeing : (H, W) uint8, written
    contradicting : (H, W) uint8, written
    weighted_shift : (H, W) float32, written
    weight : (H, W) float32, written
    """

def confirm_depth(
    depth: NDArray[np.float32],
    sigma: NDArray[np.float32],
    min_consistent: int,
    may_miss: int,
    max_contradiction: float,
    min_surface: float,
    steepest: float,
    observing: NDArray[np.uint8],
    agreeing: NDArray[np.uint8],
    contradicting: NDArray[np.uint8],
    weighted_shift: NDArray[np.float32],
    weight: NDArray[np.float32],
    /,
) -> None:
    """Turn the sums of compare_depths into the geometric map: `weighted_shift` becomes depth, `weight` its
    deviation, `agreeing` its support; `contradicting` is spoilt.

    depth : (H, W) float32
    sigma : (H, W) float32
    min_consistent : int
    may_miss : int
    max_contradiction : float
    min_surface : float
    steepest : float
    observing : (H, W) uint8
    agreeing : (H, W) uint8, written
    contradicting : (H, W) uint8, written
    weighted_shift : (H, W) float32, written
    weight : (H, W) float32, written
    """

def fit_planes(
    backend: str,
    inverse_depth: NDArray[np.float32],
    inverse_sigma: NDArray[np.float32],
    support: NDArray[np.uint8],
    K: NDArray[np.floating[Any]],
    radius: int,
    tolerance: float,
    max_shift: float,
    shift_sigma: float,
    min_cosine: float,
    supported: int,
    normals: NDArray[np.float32],
    fitted_depth: NDArray[np.float32],
    /,
) -> None:
    """Normals and depths of planes fitted to each pixel's neighbours; zeros where none fits.

    backend : str
    inverse_depth : (H, W) float32
    inverse_sigma : (H, W) float32
    support : (H, W) uint8
    K : (3, 3) float64
    radius : int
    tolerance : float
    max_shift : float
    shift_sigma : float
    min_cosine : float
    supported : int
    normals : (H, W, 3) float32, written
    fitted_depth : (H, W) float32, written
    """

def add_relief(
    depth: NDArray[np.float32],
    sigma: NDArray[np.float32],
    fitted_depth: NDArray[np.float32],
    /,
) -> None:
    """Put back what fitted planes cut off where they bend: move them towards the depths they were fitted to.

    depth : (H, W) float32
    sigma : (H, W) float32
    fitted_depth : (H, W) float32, written
    """

def add_patch_equations(
    backend: str,
    image: NDArray[np.uint8],
    sources: tuple[NDArray[np.uint16], ...],
    sources_from_reference: NDArray[np.floating[Any]],
    used: NDArray[np.uint32],
    planes: NDArray[np.float32],
    first_row: int,
    row_step: int,
    contrast: float,
    min_score: float,
    equations: NDArray[np.float32],
    /,
) -> None:
    """Add the normal equations of matching planes of every `row_step`-th row in sources, where every pixel
    (the lower byte) has the one below it beside it. Each tile of 32 columns uses the sources whose bits
    are set.

    backend : str
    image : (H, W) uint8
    sources : tuple of SOURCES images, uint16
    sources_from_reference : (SOURCES, 3, 4) float64
    used : (TILES) uint32
    planes : (3, ROWS, W) float32
    first_row : int
    row_step : int
    contrast : float
    min_score : float
    equations : (12, ROWS, W) float32, written
    """

def planes_of_maps(
    normals: NDArray[np.float32],
    depth: NDArray[np.float32],
    inverse_K: NDArray[np.floating[Any]],
    first_row: int,
    row_step: int,
    planes: NDArray[np.float32],
    /,
) -> None:
    """Inverse depth and its change per column and row on every `row_step`-th row of maps; 0 where there is none.

    normals : (H, W, 3) float32
    depth : (H, W) float32
    inverse_K : (3, 3) float64
    first_row : int
    row_step : int
    planes : (3, ROWS, W) float32, written
    """

def maps_of_planes(
    planes: NDArray[np.float32],
    K: NDArray[np.floating[Any]],
    first_row: int,
    normals: NDArray[np.float32],
    depth: NDArray[np.float32],
    /,
) -> None:
    """The inverse of planes_of_maps, into the maps' rows from `first_row` on.

    planes : (3, ROWS, W) float32
    K : (3, 3) float64
    first_row : int
    normals : (H, W, 3) float32, written
    depth : (H, W) float32, written
    """

def refine_planes(
    equations: NDArray[np.float32],
    sigma: NDArray[np.float32],
    slope_sigma: float,
    planes: NDArray[np.float32],
    /,
) -> None:
    """Move planes by the solution of their equations.

    equations : (12, H, W) float32
    sigma : (H, W) float32
    slope_sigma : float
    planes : (3, H, W) float32, written
    """

def fuse_partner(
    depth: NDArray[np.float32],
    normals: NDArray[np.float32],
    ray_from_pixel: NDArray[np.floating[Any]],
    partner_depth: NDArray[np.float32],
    partner_normals: NDArray[np.float32],
    partner_ray_from_pixel: NDArray[np.floating[Any]],
    partner_image: NDArray[np.uint8],
    partner_from_reference: NDArray[np.floating[Any]],
    normal_from_partner: NDArray[np.floating[Any]],
    max_reprojection_error: float,
    max_depth_error: float,
    min_normal_cosine: float,
    partner_wins: bool,
    bit: int,
    first_row: int,
    end_row: int,
    covered: NDArray[np.uint8],
    agreeing: NDArray[np.uint8],
    colour: NDArray[np.uint16],
    /,
) -> None:
    """Add a partner's verdict on the pixels of a view's rows: covered by a finer pixel, or seen by it, too.

    depth : (H, W) float32
    normals : (3, H, W) float32
    ray_from_pixel : (3, 3) float64
    partner_depth : (PARTNER_H, PARTNER_W) float32
    partner_normals : (3, PARTNER_H, PARTNER_W) float32
    partner_ray_from_pixel : (3, 3) float64
    partner_image : (PARTNER_H, PARTNER_W, 3) uint8
    partner_from_reference : (3, 4) float64
    normal_from_partner : (3, 3) float64
    max_reprojection_error : float
    max_depth_error : float
    min_normal_cosine : float
    partner_wins : bool
    bit : int
    first_row : int
    end_row : int
    covered : (H, W) uint8, written
    agreeing : (BYTES, H, W) uint8, written
    colour : (H, W, 3) uint16, written
    """

def find_gates(
    depth: NDArray[np.float32],
    normals: NDArray[np.float32],
    partner_depth: NDArray[np.float32],
    partner_normals: NDArray[np.float32],
    partner_from_reference: NDArray[np.floating[Any]],
    normal_from_partner: NDArray[np.floating[Any]],
    max_depth_error: float,
    min_normal_cosine: float,
    rows: NDArray[np.int32],
    columns: NDArray[np.int32],
    gate: NDArray[np.uint8],
    distance: NDArray[np.float32],
    /,
) -> None:
    """What keeps a partner from agreeing with pixels: 0 unseen, 1 depth, 2 normal, 3 nothing; and the distance of
    their projections from the centre of the partner's pixel.

    depth : (H, W) float32
    normals : (3, H, W) float32
    partner_depth : (PARTNER_H, PARTNER_W) float32
    partner_normals : (3, PARTNER_H, PARTNER_W) float32
    partner_from_reference : (3, 4) float64
    normal_from_partner : (3, 3) float64
    max_depth_error : float
    min_normal_cosine : float
    rows : (POINTS) int32
    columns : (POINTS) int32
    gate : (POINTS) uint8, written
    distance : (POINTS) float32, written
    """

def pack_normals(
    normals: NDArray[np.float32],
    pair: NDArray[np.float32],
    codes: NDArray[np.uint8],
    /,
) -> None:
    """Two components of each unit vector, and a code from which the largest follows to the bit; code 3: it does
    not.

    normals : (3, H, W) float32
    pair : (2, H, W) float32, written
    codes : (H, W) uint8, written
    """

def unpack_normals(
    pair: NDArray[np.float32],
    codes: NDArray[np.uint8],
    normals: NDArray[np.float32],
    /,
) -> None:
    """What was packed.

    pair : (2, H, W) float32
    codes : (H, W) uint8
    normals : (3, H, W) float32, written
    """

def count_points(
    depth: NDArray[np.float32],
    normals: NDArray[np.float32],
    covered: NDArray[np.uint8],
    agreeing: NDArray[np.uint8],
    colour: NDArray[np.uint16],
    min_stations: int,
    stations: NDArray[np.uint64],
    first_row: int,
    end_row: int,
    /,
) -> tuple[int, int]:
    """Points that the rows of a view become, and words that name the views which see them.

    depth : (H, W) float32
    normals : (3, H, W) float32
    covered : (H, W) uint8
    agreeing : (BYTES, H, W) uint8
    colour : (H, W, 3) uint16
    min_stations : int
    stations : (2) uint64
    first_row : int
    end_row : int
    returned: points
    returned: words
    """

def write_points(
    depth: NDArray[np.float32],
    normals: NDArray[np.float32],
    covered: NDArray[np.uint8],
    agreeing: NDArray[np.uint8],
    colour: NDArray[np.uint16],
    min_stations: int,
    stations: NDArray[np.uint64],
    first_row: int,
    end_row: int,
    world_from_pixel: NDArray[np.floating[Any]],
    world_from_camera: NDArray[np.floating[Any]],
    centre: NDArray[np.floating[Any]],
    indices: NDArray[np.uint32],
    points: NDArray[np.uint8],
    visibility: NDArray[np.uint32],
    /,
) -> None:
    """Points as in a PLY file: position and normal as float32, red, green, blue; and for each the number of
    views that see it, and their indices. POINTS and WORDS are what count_points returns.

    depth : (H, W) float32
    normals : (3, H, W) float32
    covered : (H, W) uint8
    agreeing : (BYTES, H, W) uint8
    colour : (H, W, 3) uint16
    min_stations : int
    stations : (2) uint64
    first_row : int
    end_row : int
    world_from_pixel : (3, 3) float64
    world_from_camera : (3, 3) float64
    centre : (3) float64
    indices : (65) uint32
    points : (POINTS, 27) uint8, written
    visibility : (WORDS) uint32, written
    """

def draw_heights(
    depth: NDArray[np.float32],
    normals: NDArray[np.float32],
    ray_from_pixel: NDArray[np.floating[Any]],
    cells_from_camera: NDArray[np.floating[Any]],
    shift: NDArray[np.floating[Any]],
    half: float,
    max_ratio: float,
    raster: NDArray[np.float32],
    /,
) -> None:
    """Draw every pixel with a depth as a patch of its plane, so many pixels to each side, into a raster, whose
    cells keep the greatest height at their centres.

    depth : (MAP_H, MAP_W) float32
    normals : (3, MAP_H, MAP_W) float32
    ray_from_pixel : (3, 3) float64
    cells_from_camera : (3, 3) float64
    shift : (3) float64
    half : float
    max_ratio : float
    raster : (H, W) float32, written
    """

def fit_surfaces(
    disparity: NDArray[np.float32],
    places: NDArray[np.floating[Any]],
    least_found: float,
    planes: NDArray[np.float64],
    roughness: NDArray[np.float32],
    /,
) -> None:
    """Planes through the disparities around places, and how far these are from them; infinite where too few.

    disparity : (H, W) float32
    places : (POINTS, 2) float64
    least_found : float
    planes : (POINTS, 3) float64, written
    roughness : (POINTS) float32, written
    """

def place_windows(
    backend: str,
    places: NDArray[np.floating[Any]],
    slopes: NDArray[np.floating[Any]],
    pixel_from_ray: NDArray[np.floating[Any]],
    origins: tuple[float, float],
    scales: tuple[float, float],
    spherical: bool,
    flatness: float,
    columns: NDArray[np.float32],
    rows: NDArray[np.float32],
    /,
) -> None:
    """Where an image shows the pixels of sloping windows around places of a rectified pair.

    backend : str
    places : (POINTS, 2) float64
    slopes : (POINTS, 2) float64
    pixel_from_ray : (3, 3) float64
    origins : tuple[float, float]
    scales : tuple[float, float]
    spherical : bool
    flatness : float
    columns : (POINTS, H, W) float32, written
    rows : (POINTS, H, W) float32, written
    """

def make_templates(
    windows: NDArray[np.float32],
    least_contrast: float,
    values: NDArray[np.float32],
    jacobian: NDArray[np.float32],
    normal: NDArray[np.float32],
    /,
) -> None:
    """Windows with mean 0 and variance 1, how they change when they move and slope, and the normal matrices.

    windows : (POINTS, H + 2, W + 2) float32
    least_contrast : float
    values : (POINTS, PIXELS) float32, written
    jacobian : (POINTS, 4, PIXELS) float32, written
    normal : (POINTS, 4, 4) float32, written
    """

def step_windows(
    values: NDArray[np.float32],
    jacobian: NDArray[np.float32],
    inverse: NDArray[np.float32],
    windows: NDArray[np.float32],
    least_contrast: float,
    move: NDArray[np.float32],
    correlation: NDArray[np.float32],
    variance: NDArray[np.float32],
    /,
) -> None:
    """One step of the least squares of windows towards templates, their correlation and mean square difference.

    values : (POINTS, PIXELS) float32
    jacobian : (POINTS, 4, PIXELS) float32
    inverse : (POINTS, 4, 4) float32
    windows : (POINTS, PIXELS) float32
    least_contrast : float
    move : (POINTS, 4) float32, written
    correlation : (POINTS) float32, written
    variance : (POINTS) float32, written
    """

def keep_between(
    offset: NDArray[np.int32],
    first: int,
    last: int,
    /,
) -> None:
    """Invalidate, in place, what does not lie between two offsets.

    offset : (H, W) int32, written
    first : int
    last : int
    """

def remove_small_segments(
    offset: NDArray[np.int32],
    min_segment: int,
    /,
) -> None:
    """Invalidate, in place, connected regions of fewer pixels, whose neighbours differ by about a pixel at most.

    offset : (H, W) int32, written
    min_segment : int
    """

def count_fractions(
    offset: NDArray[np.int32],
    counts: NDArray[np.uint32],
    /,
) -> None:
    """How many offsets have each fraction of a pixel, in 1/256.

    offset : (H, W) int32
    counts : (256) uint32, written
    """

def unwarp_torn(
    offset: NDArray[np.int32],
    torn: NDArray[np.uint8],
    as_it_is: int,
    unwarped: NDArray[np.int32],
    /,
) -> None:
    """Offsets of torn pixels to the source, which the target has as it is from column `as_it_is` on.

    offset : (H, W) int32
    torn : (H, W) uint8
    as_it_is : int
    unwarped : (H, W) int32, written
    """

def first_offsets(
    predicted: NDArray[np.int32],
    base: NDArray[np.int32],
    torn: NDArray[np.uint8],
    first: NDArray[np.int32],
    /,
) -> None:
    """First offsets to search, pixels: the predicted one + base, of torn pixels the base alone.

    predicted : (H, W) int32
    base : (H, W) int32
    torn : (H, W) uint8
    first : (H, W) int32, written
    """

def target_bases(
    base: NDArray[np.int32],
    torn: NDArray[np.uint8],
    margin: int,
    as_it_is: int,
    gap: int,
    target_base: NDArray[np.int32],
    /,
) -> None:
    """First columns of the target to search, less the pixel's own; torn pixels search the source as it is.

    base : (H, W) int32
    torn : (H, W) uint8
    margin : int
    as_it_is : int
    gap : int
    target_base : (H, W) int32, written
    """

def join_targets(
    warped_width: int,
    source_width: int,
    census: NDArray[np.uint64],
    columns: NDArray[np.int32],
    /,
) -> None:
    """In rows of a warped image, a gap and the source as it is: no content in the gap; the source's own columns.

    warped_width : int
    source_width : int
    census : (H, TARGET_W) uint64, written
    columns : (H, TARGET_W) int32, written
    """

def bases_about(
    offset: NDArray[np.int32],
    depth: int,
    first: int,
    last: int,
    /,
) -> None:
    """Make offsets, in place, the first of `depth` whole ones about them, between `first` and `last`.

    offset : (H, W) int32, written
    depth : int
    first : int
    last : int
    """

def mark_steps(
    offset: NDArray[np.int32],
    max_step: int,
    marks: NDArray[np.uint8],
    /,
) -> None:
    """Mark the pixels on both sides of steps larger than `max_step`.

    offset : (H, W) int32
    max_step : int
    marks : (H, W) uint8, written
    """

def count_slopes(
    offset: NDArray[np.int32],
    edge: int,
    slope: int,
    /,
) -> tuple[int, int]:
    """Of every second pixel of every second row, those without an edge, and of these those on a steep slope.

    offset : (H, W) int32
    edge : int
    slope : int
    returned: surface
    returned: steep
    """

def disparity_range(
    disparity: NDArray[np.float32],
    ends: NDArray[np.float32],
    /,
) -> None:
    """Least and most of the finite disparities; 0 where there is none.

    disparity : (H, W) float32
    ends : (2) float32, written
    """

def code_disparity(
    disparity: NDArray[np.float32],
    least: float,
    step: float,
    codes: NDArray[np.uint16],
    /,
) -> None:
    """Codes of disparities: 1 + the whole steps from the least one; 0 where there is none.

    disparity : (H, W) float32
    least : float
    step : float
    codes : (H, W) uint16, written
    """

def decode_disparity(
    codes: NDArray[np.uint16],
    least: float,
    step: float,
    disparity: NDArray[np.float32],
    /,
) -> None:
    """Disparities of codes; NaN where there is none.

    codes : (H, W) uint16
    least : float
    step : float
    disparity : (H, W) float32, written
    """

def seed_planes(
    columns: NDArray[np.floating[Any]],
    rows: NDArray[np.floating[Any]],
    values: NDArray[np.floating[Any]],
    neighbours: int,
    alike: float,
    stiffness: float,
    unknown_stiffness: float,
    cell: int,
    planes: NDArray[np.float32],
    /,
) -> None:
    """Values, at the centres of cells of so many pixels, of planes through the seeds around them.

    columns : (POINTS) float64
    rows : (POINTS) float64
    values : (POINTS) float64
    neighbours : int
    alike : float
    stiffness : float
    unknown_stiffness : float
    cell : int
    planes : (H, W) float32, written
    """

def source_pixels(
    backend: str,
    ray_rows: NDArray[np.float32],
    ray_columns: NDArray[np.float32],
    weights: NDArray[np.float32],
    source_width: int,
    source_height: int,
    columns: NDArray[np.float32],
    rows: NDArray[np.float32],
    inside: NDArray[np.uint8],
    /,
) -> None:
    """Where rectified pixels, of rays ray_rows * weights + ray_columns, lie in an image, and 255 inside of it.

    backend : str
    ray_rows : (3, H) float32
    ray_columns : (3, W) float32
    weights : (W) float32
    source_width : int
    source_height : int
    columns : (H, W) float32, written
    rows : (H, W) float32, written
    inside : (H, W) uint8, written
    """

def resample(
    backend: str,
    ray_rows: NDArray[np.float32],
    ray_columns: NDArray[np.float32],
    weights: NDArray[np.float32],
    image: NDArray[np.float32],
    mask: NDArray[np.uint8],
    grey: NDArray[np.float32],
    valid: NDArray[np.uint8],
    /,
) -> None:
    """Grey values of rectified pixels, linear between an image's, and 255 where all of them count.

    backend : str
    ray_rows : (3, H) float32
    ray_columns : (3, W) float32
    weights : (W) float32
    image : (SOURCE_H, SOURCE_W) float32
    mask : (MASK_H, SOURCE_W) uint8
    grey : (H, W) float32, written
    valid : (H, W) uint8, written
    """

def half_image(
    image: NDArray[np.float32],
    half: NDArray[np.float32],
    /,
) -> None:
    """The mean of 2 x 2 pixels each.

    image : (FINE_H, FINE_W) float32
    half : (H, W) float32, written
    """

def half_mask(
    mask: NDArray[np.uint8],
    half: NDArray[np.uint8],
    /,
) -> None:
    """255 where at least half of 2 x 2 pixels are, else 0.

    mask : (FINE_H, FINE_W) uint8
    half : (H, W) uint8, written
    """

def sharpen(
    backend: str,
    image: NDArray[np.float32],
    sharpening: float,
    padded: NDArray[np.int16],
    /,
) -> None:
    """An image plus so many times what it differs by from its mean nearby, in 1/64 grey value, with a border.

    backend : str
    image : (H, W) float32
    sharpening : float
    padded : (H + 6, W + 8) int16, written
    """
