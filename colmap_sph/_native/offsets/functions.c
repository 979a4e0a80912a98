/* The kernels of offsets as Python's functions. */
#include "offsets/offsets.h"

#include "boundary.h"

static int check_step(int step) { return check(step >= 0, "steps must not be negative"); }

static int check_columns(const char *name, int columns) { return check(columns >= 0 && columns <= 1 << 20, name); }

#define KEEP_BETWEEN(X) \
    X(OUT, int32, offset, H, W) \
    X(VALUE, ptrdiff, first) \
    X(VALUE, ptrdiff, last)
ARGUMENTS(keep_between, KEEP_BETWEEN);

static int run_keep_between(void *arguments) {
    const keep_between_arguments *a = arguments;
    keep_between(a->offset, a->size.H * a->size.W, a->first, a->last);
    return 0;
}

FUNCTION(keep_between, KEEP_BETWEEN, any, "Invalidate, in place, what does not lie between two offsets.");

#define REMOVE_SMALL_SEGMENTS(X) \
    X(OUT, int32, offset, H, W) \
    X(VALUE, int, min_segment)
ARGUMENTS(remove_small_segments, REMOVE_SMALL_SEGMENTS);

static int check_remove_small_segments(const void *arguments) {
    const remove_small_segments_arguments *a = arguments;
    return check(a->size.W == 0 || a->size.H <= INT32_MAX / a->size.W, "maps are limited to 2^31 - 1 pixels");
}

static int run_remove_small_segments(void *arguments) {
    const remove_small_segments_arguments *a = arguments;
    return remove_small_segments(a->offset, a->size.H, a->size.W, a->min_segment);
}

FUNCTION(
    remove_small_segments, REMOVE_SMALL_SEGMENTS, check_remove_small_segments,
    "Invalidate, in place, connected regions of fewer pixels, whose neighbours differ by about a pixel at most.");

#define COUNT_FRACTIONS(X) \
    X(IN, int32, offset, H, W) \
    X(OUT, uint32, counts, 256)
ARGUMENTS(count_fractions, COUNT_FRACTIONS);

static int run_count_fractions(void *arguments) {
    const count_fractions_arguments *a = arguments;
    count_fractions(a->offset, a->size.H * a->size.W, a->counts);
    return 0;
}

FUNCTION(count_fractions, COUNT_FRACTIONS, any, "How many offsets have each fraction of a pixel, in 1/256.");

#define UNWARP_TORN(X) \
    X(IN, int32, offset, H, W) \
    X(IN, uint8, torn, H, W) \
    X(VALUE, int, as_it_is) \
    X(OUT, int32, unwarped, H, W)
ARGUMENTS(unwarp_torn, UNWARP_TORN);

static int check_unwarp_torn(const void *arguments) {
    const unwarp_torn_arguments *a = arguments;
    return check_columns("as_it_is must lie in 0..1048576", a->as_it_is);
}

static int run_unwarp_torn(void *arguments) {
    const unwarp_torn_arguments *a = arguments;
    unwarp_torn(a->offset, a->torn, a->size.H * a->size.W, a->as_it_is, a->unwarped);
    return 0;
}

FUNCTION(unwarp_torn, UNWARP_TORN, check_unwarp_torn,
         "Offsets of torn pixels to the source, which the target has as it is from column `as_it_is` on.");

#define FIRST_OFFSETS(X) \
    X(IN, int32, predicted, H, W) \
    X(IN, int32, base, H, W) \
    X(IN, uint8, torn, H, W) \
    X(OUT, int32, first, H, W)
ARGUMENTS(first_offsets, FIRST_OFFSETS);

static int run_first_offsets(void *arguments) {
    const first_offsets_arguments *a = arguments;
    first_offsets((search_bases){a->predicted, a->base, a->torn, a->size.H, a->size.W}, a->first);
    return 0;
}

FUNCTION(first_offsets, FIRST_OFFSETS, any,
         "First offsets to search, pixels: the predicted one + base, of torn pixels the base alone.");

#define TARGET_BASES(X) \
    X(IN, int32, base, H, W) \
    X(IN, uint8, torn, H, W) \
    X(VALUE, int, margin) \
    X(VALUE, int, as_it_is) \
    X(VALUE, int, gap) \
    X(OUT, int32, target_base, H, W)
ARGUMENTS(target_bases, TARGET_BASES);

static int check_target_bases(const void *arguments) {
    const target_bases_arguments *a = arguments;
    return check_columns("the margin must lie in 0..1048576", a->margin) &&
           check_columns("as_it_is must lie in 0..1048576", a->as_it_is) &&
           check_columns("the gap must lie in 0..1048576", a->gap) &&
           check(a->size.W <= 65535, "rows are limited to 65535 columns");
}

static int run_target_bases(void *arguments) {
    const target_bases_arguments *a = arguments;
    const search_bases bases = {NULL, a->base, a->torn, a->size.H, a->size.W};
    target_bases(bases, a->margin, a->as_it_is, a->gap, a->target_base);
    return 0;
}

FUNCTION(target_bases, TARGET_BASES, check_target_bases,
         "First columns of the target to search, less the pixel's own; torn pixels search the source as it is.");

#define JOIN_TARGETS(X) \
    X(VALUE, ptrdiff, warped_width) \
    X(VALUE, ptrdiff, source_width) \
    X(OUT, uint64, census, H, TARGET_W) \
    X(OUT, int32, columns, H, TARGET_W)
ARGUMENTS(join_targets, JOIN_TARGETS);

static int check_join_targets(const void *arguments) {
    const join_targets_arguments *a = arguments;
    return check(a->source_width >= 0 && a->source_width <= 65535, "rows are limited to 65535 columns") &&
           check(a->warped_width >= 0 && a->warped_width <= a->size.TARGET_W - a->source_width,
                 "both images must fit beside each other");
}

static int run_join_targets(void *arguments) {
    const join_targets_arguments *a = arguments;
    const joined_sizes joined = {a->size.H, a->size.TARGET_W, a->warped_width, a->source_width};
    join_targets(joined, a->census, a->columns);
    return 0;
}

FUNCTION(
    join_targets, JOIN_TARGETS, check_join_targets,
    "In rows of a warped image, a gap and the source as it is: no content in the gap; the source's own columns.");

#define BASES_ABOUT(X) \
    X(OUT, int32, offset, H, W) \
    X(VALUE, int, depth) \
    X(VALUE, int, first) \
    X(VALUE, int, last)
ARGUMENTS(bases_about, BASES_ABOUT);

static int check_bases_about(const void *arguments) {
    const bases_about_arguments *a = arguments;
    return check(a->depth > 0 && a->depth <= MAX_DEPTH, "the number of disparities must lie in 1..1024") &&
           check(a->first <= a->last, "the first must not exceed the last");
}

static int run_bases_about(void *arguments) {
    const bases_about_arguments *a = arguments;
    bases_about(a->offset, a->size.H * a->size.W, a->depth, a->first, a->last);
    return 0;
}

FUNCTION(bases_about, BASES_ABOUT, check_bases_about,
         "Make offsets, in place, the first of `depth` whole ones about them, between `first` and `last`.");

#define MARK_STEPS(X) \
    X(IN, int32, offset, H, W) \
    X(VALUE, int, max_step) \
    X(OUT, uint8, marks, H, W)
ARGUMENTS(mark_steps, MARK_STEPS);

static int check_mark_steps(const void *arguments) {
    const mark_steps_arguments *a = arguments;
    return check_step(a->max_step);
}

static int run_mark_steps(void *arguments) {
    const mark_steps_arguments *a = arguments;
    mark_steps(a->offset, a->size.H, a->size.W, a->max_step, a->marks);
    return 0;
}

FUNCTION(mark_steps, MARK_STEPS, check_mark_steps,
         "Mark the pixels on both sides of steps larger than `max_step`.");

#define COUNT_SLOPES(X) \
    X(IN, int32, offset, H, W) \
    X(VALUE, int, edge) \
    X(VALUE, int, slope) \
    X(RESULT, surface) \
    X(RESULT, steep)
ARGUMENTS(count_slopes, COUNT_SLOPES);

static int check_count_slopes(const void *arguments) {
    const count_slopes_arguments *a = arguments;
    return check_step(a->edge) && check_step(a->slope);
}

static int run_count_slopes(void *arguments) {
    count_slopes_arguments *a = arguments;
    const slope_counts counts = count_slopes(a->offset, a->size.H, a->size.W, a->edge, a->slope);
    a->surface = counts.surface;
    a->steep = counts.steep;
    return 0;
}

FUNCTION(count_slopes, COUNT_SLOPES, check_count_slopes,
         "Of every second pixel of every second row, those without an edge, and of these those on a steep slope.");

#define DISPARITY_RANGE(X) \
    X(IN, float32, disparity, H, W) \
    X(OUT, float32, ends, 2)
ARGUMENTS(disparity_range, DISPARITY_RANGE);

static int run_disparity_range(void *arguments) {
    const disparity_range_arguments *a = arguments;
    disparity_range(a->disparity, a->size.H * a->size.W, a->ends);
    return 0;
}

FUNCTION(disparity_range, DISPARITY_RANGE, any,
         "Least and most of the finite disparities; 0 where there is none.");

#define CODE_DISPARITY(X) \
    X(IN, float32, disparity, H, W) \
    X(VALUE, float, least) \
    X(VALUE, float, step) \
    X(OUT, uint16, codes, H, W)
ARGUMENTS(code_disparity, CODE_DISPARITY);

static int run_code_disparity(void *arguments) {
    const code_disparity_arguments *a = arguments;
    code_disparity(a->disparity, a->size.H * a->size.W, a->least, a->step, a->codes);
    return 0;
}

FUNCTION(code_disparity, CODE_DISPARITY, any,
         "Codes of disparities: 1 + the whole steps from the least one; 0 where there is none.");

#define DECODE_DISPARITY(X) \
    X(IN, uint16, codes, H, W) \
    X(VALUE, float, least) \
    X(VALUE, float, step) \
    X(OUT, float32, disparity, H, W)
ARGUMENTS(decode_disparity, DECODE_DISPARITY);

static int run_decode_disparity(void *arguments) {
    const decode_disparity_arguments *a = arguments;
    decode_disparity(a->codes, a->size.H * a->size.W, a->least, a->step, a->disparity);
    return 0;
}

FUNCTION(decode_disparity, DECODE_DISPARITY, any, "Disparities of codes; NaN where there is none.");

#define SEED_PLANES(X) \
    X(IN, float64, columns, POINTS) \
    X(IN, float64, rows, POINTS) \
    X(IN, float64, values, POINTS) \
    X(VALUE, int, neighbours) \
    X(VALUE, double, alike) \
    X(VALUE, double, stiffness) \
    X(VALUE, double, unknown_stiffness) \
    X(VALUE, int, cell) \
    X(OUT, float32, planes, H, W)
ARGUMENTS(seed_planes, SEED_PLANES);

static int check_seed_planes(const void *arguments) {
    const seed_planes_arguments *a = arguments;
    return check(a->size.POINTS > 0 && a->size.POINTS <= MAX_SEEDS, "there must be 1 to 2048 seeds") &&
           check(a->neighbours > 0 && a->neighbours <= MAX_NEIGHBOURS, "the neighbours must lie in 1..32") &&
           check(a->cell > 0, "a cell must have a pixel");
}

static int run_seed_planes(void *arguments) {
    const seed_planes_arguments *a = arguments;
    const seed_list seeds = {a->columns, a->rows, a->values, a->size.POINTS};
    const seed_weights weights = {a->neighbours, a->alike, a->stiffness, a->unknown_stiffness};
    seed_planes(seeds, weights, a->cell, a->size.H, a->size.W, a->planes);
    return 0;
}

FUNCTION(seed_planes, SEED_PLANES, check_seed_planes,
         "Values, at the centres of cells of so many pixels, of planes through the seeds around them.");

native_function *const offsets_functions[] = {
    &keep_between_function,     &remove_small_segments_function, &count_fractions_function,
    &unwarp_torn_function,      &first_offsets_function,         &target_bases_function,
    &join_targets_function,     &bases_about_function,           &mark_steps_function,
    &count_slopes_function,     &disparity_range_function,       &code_disparity_function,
    &decode_disparity_function, &seed_planes_function,           NULL};
