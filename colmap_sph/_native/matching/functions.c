/* The matching kernels as Python's functions. */
#include "boundary.h"

_Static_assert(CENSUS_RADIUS_Y == 3 && CENSUS_RADIUS_X == 4, "H + 6, W + 8 below");

/* ---- bounds ------------------------------------------------------------------------------------------------ */

static int check_width(ptrdiff_t width) { return check(width <= 65535, "rows are limited to 65535 columns"); }

static int check_widths(const sizes *size) { return check_width(size->W) && check_width(size->TARGET_W); }

static int check_source_width(int width) {
    return check(width >= 0, "the width must not be negative") && check_width(width);
}

static int check_depth(ptrdiff_t depth) {
    return check(depth > 0 && depth <= MAX_DEPTH && depth % DEPTH_STEP == 0,
                 "the number of disparities must be a multiple of 32, at most 1024");
}

static int check_margin(int margin) {
    return check(margin >= 0 && margin <= 65535, "the margin must lie in 0..65535");
}

static int check_penalties(int p1, const uint8_t *p2, int max_slant) {
    for (int k = 0; k < 256; k++) {
        if (!check(p1 >= 0 && p1 <= MAX_P1 && p1 <= p2[k] && p2[k] <= MAX_P2,
                   "penalties must keep 0 <= P1 <= 63, P1 <= P2 <= 127")) {
            return 0;
        }
    }
    return check(max_slant >= 0, "the slant must not be negative");
}

static int check_left_right(int max_difference, int max_excess) {
    return check(max_difference >= 0, "the left-right difference must not be negative") &&
           check(max_excess >= 0, "the excess must not be negative");
}

/* The next finer level has twice as many rows and columns, or one less. */
static int check_finer(const sizes *size) {
    return check_width(size->FINE_W) &&
           check((size->FINE_H + 1) / 2 == size->H && (size->FINE_W + 1) / 2 == size->W,
                 "the finer level must have twice the size, or one less");
}

static level_sizes level_sizes_of(const sizes *size) {
    return (level_sizes){size->H, size->W, size->FINE_H, size->FINE_W};
}

static match_size match_size_of(const sizes *size) {
    return (match_size){size->H, size->W, size->TARGET_W, size->D, 0};
}

static match_size warped_size_of(const sizes *size, int source_width) {
    match_size warped = match_size_of(size);
    warped.source_width = source_width;
    return warped;
}

/* ---- functions --------------------------------------------------------------------------------------------- */

#define CENSUS(X) \
    X(VALUE, backend, backend) \
    X(IN, int16, padded, H + 6, W + 8) \
    X(IN, uint8, valid, H, W) \
    X(VALUE, flag, fine) \
    X(VALUE, int, grey_step) \
    X(VALUE, ptrdiff, first) \
    X(OUT, uint64, census, H, TARGET_W)
ARGUMENTS(census, CENSUS);

static int check_census(const void *arguments) {
    const census_arguments *a = arguments;
    return check(a->grey_step >= 0, "the step must not be negative") &&
           check(a->first >= 0 && a->first <= a->size.TARGET_W - a->size.W,
                 "the words must fit into the rows from the first column on");
}

static int run_census(void *arguments) {
    const census_arguments *a = arguments;
    uint64_t codes[GREY_CODES];
    if (a->grey_step > 0) {
        make_grey_codes(a->grey_step, codes);
    }
    const uint64_t *grey = a->grey_step > 0 ? codes : NULL;
    const census_image image = {a->padded, a->valid, a->size.H, a->size.W, a->fine, grey};
    a->backend->census(image, a->size.TARGET_W, a->census + a->first);
    return 0;
}

FUNCTION(
    census, CENSUS, check_census,
    "Census words from column `first` on, with grey values in steps if not 0; bit 63 where a pixel is not valid.");

#define MATCHING_COST(X) \
    X(VALUE, backend, backend) \
    X(IN, uint64, reference, H, W) \
    X(IN, uint64, target, H, TARGET_W) \
    X(IN, int32, base, H, W) \
    X(OUT, uint8, cost, H, W, D)
ARGUMENTS(matching_cost, MATCHING_COST);

static int check_matching_cost(const void *arguments) {
    const matching_cost_arguments *a = arguments;
    return check_depth(a->size.D) && check_widths(&a->size);
}

static int run_matching_cost(void *arguments) {
    const matching_cost_arguments *a = arguments;
    return a->backend->cost(a->reference, a->target, a->base, match_size_of(&a->size), a->cost);
}

FUNCTION(matching_cost, MATCHING_COST, check_matching_cost,
         "Bits in which census words differ from those of the target, `base` + 0 to D - 1 columns further.");

#define AGGREGATION(X) \
    X(VALUE, backend, backend) \
    X(IN, uint8, cost, H, W, D) \
    X(IN, int32, base, H, W) \
    X(IN, uint8, image, H, W) \
    X(VALUE, int, p1) \
    X(IN, uint8, p2, 256) \
    X(VALUE, int, max_slant) \
    X(OUT, uint8, detours, H, W, D) \
    X(OUT, uint8, aggregated, H, W, D)
ARGUMENTS(aggregation, AGGREGATION);

static int check_aggregation(const void *arguments) {
    const aggregation_arguments *a = arguments;
    return check_depth(a->size.D) && check_widths(&a->size) && check_penalties(a->p1, a->p2, a->max_slant);
}

static int run_aggregation(void *arguments) {
    const aggregation_arguments *a = arguments;
    const match_size size = {a->size.H, a->size.W, 0, a->size.D, 0};
    const path_penalties penalties = {(uint8_t)a->p1, a->p2, a->max_slant};
    return a->backend->aggregation(a->cost, a->base, a->image, size, penalties, a->detours, a->aggregated);
}

FUNCTION(aggregation, AGGREGATION, check_aggregation,
         "Half of the sums of costs over 8 paths, and on the way what the first four paths add to the costs.");

#define SELECTION(X) \
    X(VALUE, backend, backend) \
    X(IN, uint8, aggregated, H, W, D) \
    X(IN, int32, base, H, W) \
    X(IN, uint64, reference, H, W) \
    X(IN, uint64, target, H, TARGET_W) \
    X(IN, int32, columns, H, TARGET_W) \
    X(VALUE, int, source_width) \
    X(VALUE, int, max_difference) \
    X(VALUE, int, max_excess) \
    X(OUT, int32, offset, H, W)
ARGUMENTS(selection, SELECTION);

static int check_selection(const void *arguments) {
    const selection_arguments *a = arguments;
    return check_depth(a->size.D) && check_widths(&a->size) && check_source_width(a->source_width) &&
           check_left_right(a->max_difference, a->max_excess);
}

static int run_selection(void *arguments) {
    const selection_arguments *a = arguments;
    const left_right_check limits = {a->max_difference, a->max_excess};
    return a->backend->selection(a->aggregated, a->base, a->reference, a->target, a->columns,
                                 warped_size_of(&a->size, a->source_width), limits, a->offset);
}

FUNCTION(selection, SELECTION, check_selection,
         "Offsets of the least sums in 1/256 pixel, -2^31 where the left-right check or content lacks.");

#define SWEEP_BYTES(X) \
    X(VALUE, backend, backend) \
    X(VALUE, int, width) \
    X(VALUE, int, depth) \
    X(RESULT, bytes)
ARGUMENTS(sweep_bytes, SWEEP_BYTES);

static int check_sweep_bytes(const void *arguments) {
    const sweep_bytes_arguments *a = arguments;
    return check_source_width(a->width) && check_depth(a->depth);
}

static int run_sweep_bytes(void *arguments) {
    sweep_bytes_arguments *a = arguments;
    a->bytes = (ptrdiff_t)a->backend->sweep_bytes((match_size){0, a->width, 0, a->depth, 0});
    return 0;
}

FUNCTION(sweep_bytes, SWEEP_BYTES, check_sweep_bytes,
         "Size of the state that a sweep over rows of such a level brings from one band of them to the next.");

static int check_state(const kernel_table *kernels, const sizes *size, ptrdiff_t bytes) {
    return check(bytes == (ptrdiff_t)kernels->sweep_bytes(match_size_of(size)),
                 "the state must have the size that sweep_bytes tells");
}

static int check_band(const sizes *size, row_band band) {
    return check(band.above >= 0 && band.below >= 0, "the numbers of rows above and below must not be negative") &&
           check(band.first >= (band.above > 0) && band.first <= band.end &&
                     band.end <= size->H - (band.below > 0),
                 "the rows of the band, and those beside it, must be among those given");
}

#define SWEEP(X) \
    X(VALUE, backend, backend) \
    X(IN, uint64, reference, H, W) \
    X(IN, uint64, target, H, TARGET_W) \
    X(IN, int32, base, H, W) \
    X(IN, int32, surface, H, W) \
    X(IN, uint8, image, H, W) \
    X(VALUE, int, depth) \
    X(VALUE, int, p1) \
    X(IN, uint8, p2, 256) \
    X(VALUE, int, max_slant) \
    X(VALUE, ptrdiff, first) \
    X(VALUE, ptrdiff, end) \
    X(VALUE, ptrdiff, above) \
    X(VALUE, ptrdiff, below) \
    X(VALUE, flag, backward) \
    X(OUT, uint8, state, BYTES)
ARGUMENTS(sweep, SWEEP);

static int check_sweep(const void *arguments) {
    const sweep_arguments *a = arguments;
    sizes size = a->size;
    size.D = a->depth;
    return check_depth(a->depth) && check_widths(&size) && check_penalties(a->p1, a->p2, a->max_slant) &&
           check_band(&size, (row_band){a->first, a->end, a->above, a->below}) &&
           check_state(a->backend, &size, size.BYTES);
}

static int run_sweep(void *arguments) {
    const sweep_arguments *a = arguments;
    match_size size = match_size_of(&a->size);
    size.depth = a->depth;
    const match_input input = {.reference = a->reference,
                               .target = a->target,
                               .base = a->base,
                               .surface = a->surface,
                               .image = a->image,
                               .size = size,
                               .penalties = {(uint8_t)a->p1, a->p2, a->max_slant}};
    return a->backend->sweep(&input, (row_band){a->first, a->end, a->above, a->below}, a->backward, a->state);
}

FUNCTION(sweep, SWEEP, check_sweep,
         "The state of a sweep moves over the rows from first to before end, which have so many above and below.");

#define MATCH(X) \
    X(VALUE, backend, backend) \
    X(IN, uint64, reference, H, W) \
    X(IN, uint64, target, H, TARGET_W) \
    X(IN, int32, columns, H, TARGET_W) \
    X(VALUE, int, source_width) \
    X(IN, int32, base, H, W) \
    X(IN, int32, surface, H, W) \
    X(IN, uint8, image, H, W) \
    X(VALUE, int, p1) \
    X(IN, uint8, p2, 256) \
    X(VALUE, int, max_slant) \
    X(VALUE, int, max_difference) \
    X(VALUE, int, max_excess) \
    X(VALUE, ptrdiff, first) \
    X(VALUE, ptrdiff, above) \
    X(VALUE, ptrdiff, below) \
    X(OUT, uint8, forward, BYTES) \
    X(OUT, uint8, backward, BYTES) \
    X(OUT, uint8, scratch, 2, BAND, D) \
    X(OUT, int32, offset, ROWS, W)
ARGUMENTS(match, MATCH);

static row_band band_of_match(const match_arguments *a) {
    return (row_band){a->first, a->first + a->size.ROWS, a->above, a->below};
}

static int check_match(const void *arguments) {
    const match_arguments *a = arguments;
    return check_depth(a->size.D) && check_widths(&a->size) && check_source_width(a->source_width) &&
           check_penalties(a->p1, a->p2, a->max_slant) && check_left_right(a->max_difference, a->max_excess) &&
           check(a->size.BAND == a->size.ROWS * a->size.W,
                 "scratch must have the size (2, pixels of the band, disparities)") &&
           check(a->first <= a->size.H, "the first row must be among those given") &&
           check_band(&a->size, band_of_match(a)) && check_state(a->backend, &a->size, a->size.BYTES);
}

static int run_match(void *arguments) {
    const match_arguments *a = arguments;
    const match_input input = {a->reference,
                               a->target,
                               a->columns,
                               a->base,
                               a->surface,
                               a->image,
                               warped_size_of(&a->size, a->source_width),
                               {(uint8_t)a->p1, a->p2, a->max_slant},
                               {a->max_difference, a->max_excess}};
    return a->backend->match(&input, band_of_match(a), a->forward, a->backward, a->scratch, a->offset);
}

FUNCTION(
    match, MATCH, check_match,
    "Matching cost, aggregation and selection of rows from first on, with so many above and below; states move.");

#define FIT_OFFSETS(X) \
    X(VALUE, backend, backend) \
    X(IN, int32, offset, H, W) \
    X(IN, uint64, reference, H, W) \
    X(IN, uint64, target, H, TARGET_W) \
    X(OUT, int32, fitted, H, W)
ARGUMENTS(fit_offsets, FIT_OFFSETS);

static int check_fit_offsets(const void *arguments) {
    const fit_offsets_arguments *a = arguments;
    return check_widths(&a->size);
}

static int run_fit_offsets(void *arguments) {
    const fit_offsets_arguments *a = arguments;
    const match_size size = {a->size.H, a->size.W, a->size.TARGET_W, 0, 0};
    return a->backend->fit_offsets(a->offset, a->reference, a->target, size, a->fitted);
}

FUNCTION(fit_offsets, FIT_OFFSETS, check_fit_offsets,
         "Offsets fitted to the raw costs of a window around each pixel, in 1/256 pixel.");

#define WARP(X) \
    X(IN, float32, source, H, SOURCE_W) \
    X(IN, uint8, valid, H, SOURCE_W) \
    X(IN, int32, prediction, H, W) \
    X(VALUE, int, margin) \
    X(OUT, float32, warped, H, TARGET_W) \
    X(OUT, uint8, warped_valid, H, TARGET_W) \
    X(OUT, int32, columns, H, MAP_W)
ARGUMENTS(warp, WARP);

static int check_warp(const void *arguments) {
    const warp_arguments *a = arguments;
    return check_widths(&a->size) && check_width(a->size.SOURCE_W) && check_margin(a->margin) &&
           check(a->size.W > 0 || a->size.H == 0, "without a reference column nothing is predicted") &&
           check(a->size.MAP_W >= a->size.TARGET_W, "the columns must have room for those of the warped image");
}

static int run_warp(void *arguments) {
    const warp_arguments *a = arguments;
    const match_size size = {a->size.H, a->size.W, a->size.TARGET_W, 0, a->size.SOURCE_W};
    warp(a->source, a->valid, a->prediction, a->margin, size, a->warped, a->warped_valid, a->size.MAP_W,
         a->columns);
    return 0;
}

FUNCTION(warp, WARP, check_warp,
         "An image as another one is expected to see it, by predicted offsets in 1/256 pixel, and its columns.");

#define UNWARP_OFFSETS(X) \
    X(IN, int32, offset, H, W) \
    X(IN, int32, prediction, H, W) \
    X(VALUE, int, margin) \
    X(OUT, int32, unwarped, H, W)
ARGUMENTS(unwarp_offsets, UNWARP_OFFSETS);

static int check_unwarp_offsets(const void *arguments) {
    const unwarp_offsets_arguments *a = arguments;
    return check_width(a->size.W) && check_margin(a->margin);
}

static int run_unwarp_offsets(void *arguments) {
    const unwarp_offsets_arguments *a = arguments;
    const match_size size = {a->size.H, a->size.W, 0, 0, 0};
    unwarp_offsets(a->offset, a->prediction, a->margin, size, a->unwarped);
    return 0;
}

FUNCTION(unwarp_offsets, UNWARP_OFFSETS, check_unwarp_offsets,
         "Offsets in a warped image, 1/256 pixel, to those in the image that it was warped from.");

#define MEAN_OFFSETS(X) \
    X(VALUE, backend, backend) \
    X(IN, int32, offset, H, W) \
    X(VALUE, int, radius) \
    X(VALUE, int, max_step) \
    X(OUT, int32, mean, H, W)
ARGUMENTS(mean_offsets, MEAN_OFFSETS);

static int check_mean_offsets(const void *arguments) {
    const mean_offsets_arguments *a = arguments;
    return check_width(a->size.W) &&
           check(a->radius >= 0 && a->radius <= MAX_MEAN_RADIUS, "the radius must lie in 0..10") &&
           check(a->max_step >= 0 && a->max_step <= MAX_MEAN_STEP, "max_step must lie in 0..1048576");
}

static int run_mean_offsets(void *arguments) {
    const mean_offsets_arguments *a = arguments;
    a->backend->mean_offsets(a->offset, a->size.H, a->size.W, a->radius, a->max_step, a->mean);
    return 0;
}

FUNCTION(mean_offsets, MEAN_OFFSETS, check_mean_offsets,
         "Of every offset the mean of those near it that differ from it by no more than `max_step`.");

#define UPSAMPLE_OFFSETS(X) \
    X(VALUE, backend, backend) \
    X(IN, int32, offset, H, W) \
    X(VALUE, int, max_step) \
    X(OUT, int32, fine, FINE_H, FINE_W)
ARGUMENTS(upsample_offsets, UPSAMPLE_OFFSETS);

static int check_upsample_offsets(const void *arguments) {
    const upsample_offsets_arguments *a = arguments;
    return check_finer(&a->size) &&
           check(a->max_step >= 0 && a->max_step <= MAX_MEAN_STEP, "max_step must lie in 0..1048576");
}

static int run_upsample_offsets(void *arguments) {
    const upsample_offsets_arguments *a = arguments;
    a->backend->upsample_offsets(a->offset, level_sizes_of(&a->size), a->max_step, a->fine);
    return 0;
}

FUNCTION(upsample_offsets, UPSAMPLE_OFFSETS, check_upsample_offsets,
         "A level's offsets at the pixels of the next finer one, interpolated on surfaces, repeated at steps.");

#define SEARCH_WINDOWS(X) \
    X(IN, float32, least, H, W) \
    X(IN, float32, most, H, W) \
    X(IN, int32, predicted, FINE_H, FINE_W) \
    X(VALUE, int, depth) \
    X(VALUE, int, clearance) \
    X(VALUE, int, own_clearance) \
    X(OUT, int32, base, FINE_H, FINE_W)
ARGUMENTS(search_windows, SEARCH_WINDOWS);

static int check_search_windows(const void *arguments) {
    const search_windows_arguments *a = arguments;
    return check_finer(&a->size) && check_depth(a->depth) &&
           check(a->clearance >= 0 && a->clearance <= a->depth / 2 && a->own_clearance >= 0 &&
                     a->own_clearance <= a->depth / 2,
                 "a clearance must lie between 0 and half the number of disparities");
}

static int run_search_windows(void *arguments) {
    const search_windows_arguments *a = arguments;
    const search_limits limits = {a->depth, a->clearance, a->own_clearance};
    search_windows(a->predicted, a->least, a->most, level_sizes_of(&a->size), limits, a->base);
    return 0;
}

FUNCTION(
    search_windows, SEARCH_WINDOWS, check_search_windows,
    "First residuals to search about predicted offsets, by the least and most of the level above around them.");

#define TO_DISPARITY(X) \
    X(IN, int32, offset, H, W) \
    X(IN, float32, shifts, 256) \
    X(OUT, float32, disparity, H, W)
ARGUMENTS(to_disparity, TO_DISPARITY);

static int run_to_disparity(void *arguments) {
    const to_disparity_arguments *a = arguments;
    to_disparity(a->offset, a->size.H * a->size.W, a->shifts, a->disparity);
    return 0;
}

FUNCTION(to_disparity, TO_DISPARITY, any,
         "Disparities, pixels, of offsets, less the shift of their fraction; NaN where there is no offset.");

native_function *const matching_functions[] = {
    &census_function,         &matching_cost_function, &aggregation_function,
    &selection_function,      &sweep_bytes_function,   &sweep_function,
    &match_function,          &fit_offsets_function,   &warp_function,
    &unwarp_offsets_function, &mean_offsets_function,  &upsample_offsets_function,
    &search_windows_function, &to_disparity_function,  NULL};
