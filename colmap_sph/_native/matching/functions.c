/* The matching kernels as Python's functions. */
#include "boundary.h"

_Static_assert(CENSUS_RADIUS_Y == 3 && CENSUS_RADIUS_X == 4, "H + 6, W + 8 below");

/* ---- bounds ------------------------------------------------------------------------------------------------ */

static int check_width(ptrdiff_t width) { return check(width <= 65535, "rows are limited to 65535 columns"); }

static int check_widths(const sizes *size) { return check_width(size->W) && check_width(size->TARGET_W); }

static int check_depth(const sizes *size) {
    return check(size->D > 0 && size->D <= MAX_DEPTH && size->D % DEPTH_STEP == 0,
                 "the number of disparities must be a multiple of 32, at most 1024");
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

static match_size match_size_of(const sizes *size) {
    return (match_size){size->H, size->W, size->TARGET_W, size->D};
}

/* ---- functions --------------------------------------------------------------------------------------------- */

#define CENSUS(X) \
    X(VALUE, backend, backend) \
    X(IN, int16, padded, H + 6, W + 8) \
    X(IN, uint8, valid, H, W) \
    X(OUT, uint64, census, H, W)
ARGUMENTS(census, CENSUS);

static int run_census(void *arguments) {
    const census_arguments *a = arguments;
    a->backend->census(a->padded, a->valid, a->size.H, a->size.W, a->census);
    return 0;
}

FUNCTION(census, CENSUS, any,
         "Census words: a bit for each neighbour that is darker, bit 63 where a pixel is not valid.");

#define MATCHING_COST(X) \
    X(VALUE, backend, backend) \
    X(IN, uint64, reference, H, W) \
    X(IN, uint64, target, H, TARGET_W) \
    X(IN, int32, base, H, W) \
    X(OUT, uint8, cost, H, W, D)
ARGUMENTS(matching_cost, MATCHING_COST);

static int check_matching_cost(const void *arguments) {
    const matching_cost_arguments *a = arguments;
    return check_depth(&a->size) && check_widths(&a->size);
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
    return check_depth(&a->size) && check_widths(&a->size) && check_penalties(a->p1, a->p2, a->max_slant);
}

static int run_aggregation(void *arguments) {
    const aggregation_arguments *a = arguments;
    const match_size size = {a->size.H, a->size.W, 0, a->size.D};
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
    X(VALUE, int, max_difference) \
    X(VALUE, int, max_excess) \
    X(OUT, int32, offset, H, W)
ARGUMENTS(selection, SELECTION);

static int check_selection(const void *arguments) {
    const selection_arguments *a = arguments;
    return check_depth(&a->size) && check_widths(&a->size) && check_left_right(a->max_difference, a->max_excess);
}

static int run_selection(void *arguments) {
    const selection_arguments *a = arguments;
    const left_right_check limits = {a->max_difference, a->max_excess};
    return a->backend->selection(a->aggregated, a->base, a->reference, a->target, match_size_of(&a->size), limits,
                                 a->offset);
}

FUNCTION(selection, SELECTION, check_selection,
         "Offsets of the least sums in 1/256 pixel, -2^31 where the left-right check or content lacks.");

#define MATCH(X) \
    X(VALUE, backend, backend) \
    X(IN, uint64, reference, H, W) \
    X(IN, uint64, target, H, TARGET_W) \
    X(IN, int32, base, H, W) \
    X(IN, uint8, image, H, W) \
    X(VALUE, int, p1) \
    X(IN, uint8, p2, 256) \
    X(VALUE, int, max_slant) \
    X(VALUE, int, max_difference) \
    X(VALUE, int, max_excess) \
    X(OUT, uint8, scratch, 2, BAND, D) \
    X(OUT, int32, offset, H, W)
ARGUMENTS(match, MATCH);

static int check_match(const void *arguments) {
    const match_arguments *a = arguments;
    return check_depth(&a->size) && check_widths(&a->size) &&
           check(a->size.BAND > 0 && (a->size.W == 0 || a->size.BAND % a->size.W == 0),
                 "scratch must have the size (2, pixels of one row or more, disparities)") &&
           check_penalties(a->p1, a->p2, a->max_slant) && check_left_right(a->max_difference, a->max_excess);
}

static int run_match(void *arguments) {
    const match_arguments *a = arguments;
    const match_input input = {a->reference,
                               a->target,
                               a->base,
                               a->image,
                               match_size_of(&a->size),
                               {(uint8_t)a->p1, a->p2, a->max_slant},
                               {a->max_difference, a->max_excess}};
    const ptrdiff_t band_rows = a->size.W > 0 ? a->size.BAND / a->size.W : a->size.H + 1;
    return a->backend->match(&input, band_rows, a->scratch, a->offset);
}

FUNCTION(match, MATCH, check_match,
         "Matching cost, aggregation and selection in one, in bands of so many rows as BAND pixels are.");

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
    const match_size size = {a->size.H, a->size.W, a->size.TARGET_W, 0};
    return a->backend->fit_offsets(a->offset, a->reference, a->target, size, a->fitted);
}

FUNCTION(fit_offsets, FIT_OFFSETS, check_fit_offsets,
         "Offsets fitted to the raw costs of a window around each pixel, in 1/256 pixel.");

native_function *const matching_functions[] = {&census_function,
                                               &matching_cost_function,
                                               &aggregation_function,
                                               &selection_function,
                                               &match_function,
                                               &fit_offsets_function,
                                               NULL};
