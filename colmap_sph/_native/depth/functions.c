/* The kernels of depth as Python's functions. */
#include "boundary.h"

#include <string.h>

#include "geometry.h"

_Static_assert(PATCH_EQUATIONS == 12 && (int)MAX_PATCH_SOURCES == (int)MAX_IMAGES, "tables below");

#define TRANSFER_DISPARITY(X) \
    X(IN, float32, left, H, W) \
    X(VALUE, float, max_step) \
    X(OUT, float32, right, H, TARGET_W)
ARGUMENTS(transfer_disparity, TRANSFER_DISPARITY);

static int run_transfer_disparity(void *arguments) {
    const transfer_disparity_arguments *a = arguments;
    transfer_disparity(a->left, a->size.H, a->size.W, a->size.TARGET_W, a->max_step, a->right);
    return 0;
}

FUNCTION(transfer_disparity, TRANSFER_DISPARITY, any,
         "Carry a disparity map from the left image's columns to the right image's (NaN = none).");

#define DEPTH_CANDIDATES(X) \
    X(VALUE, backend, backend) \
    X(IN, float32, disparity, MAP_H, MAP_W) \
    X(IN, float64, rectified_from_pixel, 3, 3) \
    X(VALUE, pair, scales) \
    X(VALUE, pair, origins) \
    X(VALUE, double, disparity_origin) \
    X(VALUE, double, baseline) \
    X(VALUE, double, disparity_sigma) \
    X(VALUE, double, max_disparity_step) \
    X(VALUE, flag, spherical) \
    X(VALUE, double, flatness) \
    X(VALUE, flag, is_left) \
    X(VALUE, ptrdiff, first_row) \
    X(OUT, float32, depth, H, W) \
    X(OUT, float32, sigma, H, W)
ARGUMENTS(depth_candidates, DEPTH_CANDIDATES);

static int check_maps(ptrdiff_t height, ptrdiff_t width) {
    return check(height <= INT32_MAX && width <= INT32_MAX, "maps are limited to 2^31 - 1 rows and columns");
}

static int check_depth_candidates(const void *arguments) {
    const depth_candidates_arguments *a = arguments;
    return check_maps(a->size.MAP_H, a->size.MAP_W);
}

static int run_depth_candidates(void *arguments) {
    const depth_candidates_arguments *a = arguments;
    pair_geometry geometry = {.columns_per_radian = a->scales.first,
                              .rows_per_radian = a->scales.second,
                              .column_origin = a->origins.first,
                              .row_origin = a->origins.second,
                              .disparity_origin = a->disparity_origin,
                              .baseline = a->baseline,
                              .disparity_sigma = a->disparity_sigma,
                              .max_disparity_step = a->max_disparity_step,
                              .spherical = a->spherical,
                              .flatness = a->flatness,
                              .is_left = a->is_left};
    memcpy(geometry.rectified_from_pixel, a->rectified_from_pixel, sizeof geometry.rectified_from_pixel);
    a->backend->depth_candidates(a->disparity, a->size.MAP_H, a->size.MAP_W, &geometry, a->first_row, a->size.H,
                                 a->size.W, a->depth, a->sigma);
    return 0;
}

FUNCTION(depth_candidates, DEPTH_CANDIDATES, check_depth_candidates,
         "z-depth and its standard deviation (0 = none) from a pair's disparities, for rows of a view from\n"
         "`first_row` on; `scales` and `origins` are of columns and rows of the disparity map.");

#define VOTE_DEPTH(X) \
    X(VALUE, backend, backend) \
    X(IN, float32, depths, PAIRS, H, W) \
    X(IN, float32, sigmas, PAIRS, H, W) \
    X(IN, int32, stations, PAIRS) \
    X(VALUE, float, tolerance) \
    X(OUT, float32, depth, H, W) \
    X(OUT, float32, sigma, H, W) \
    X(OUT, uint8, support, H, W)
ARGUMENTS(vote_depth, VOTE_DEPTH);

static int check_vote_depth(const void *arguments) {
    const vote_depth_arguments *a = arguments;
    int ascending = 1;
    for (ptrdiff_t k = 1; k < a->size.PAIRS; k++) {
        ascending &= a->stations[k - 1] <= a->stations[k];
    }
    return check(ascending, "the stations must ascend");
}

static int run_vote_depth(void *arguments) {
    const vote_depth_arguments *a = arguments;
    return a->backend->vote_depth(a->depths, a->sigmas, a->stations, a->size.PAIRS, a->size.H * a->size.W,
                                  a->tolerance, a->depth, a->sigma, a->support);
}

FUNCTION(
    vote_depth, VOTE_DEPTH, check_vote_depth,
    "The largest consistent cluster of candidates per pixel: its weighted mean, deviation and size in stations.");

#define COMPARE_DEPTHS(X) \
    X(VALUE, backend, backend) \
    X(IN, float32, depth, H, W) \
    X(IN, float32, sigma, H, W) \
    X(IN, float32, partner_depth, PARTNER_H, PARTNER_W) \
    X(IN, float32, partner_sigma, PARTNER_H, PARTNER_W) \
    X(IN, uint8, partner_support, PARTNER_H, PARTNER_W) \
    X(IN, float64, partner_from_reference, 3, 4) \
    X(IN, float64, reference_from_partner, 3, 4) \
    X(VALUE, float, max_reprojection_error) \
    X(VALUE, float, tolerance) \
    X(VALUE, int, min_support) \
    X(VALUE, flag, silence_counts) \
    X(OUT, uint8, observing, H, W) \
    X(OUT, uint8, agreeing, H, W) \
    X(OUT, uint8, contradicting, H, W) \
    X(OUT, float32, weighted_shift, H, W) \
    X(OUT, float32, weight, H, W)
ARGUMENTS(compare_depths, COMPARE_DEPTHS);

static int check_compare_depths(const void *arguments) {
    const compare_depths_arguments *a = arguments;
    return check_maps(a->size.H, a->size.W) && check_maps(a->size.PARTNER_H, a->size.PARTNER_W);
}

static int run_compare_depths(void *arguments) {
    const compare_depths_arguments *a = arguments;
    const depth_map reference = {a->depth, a->sigma, NULL, a->size.H, a->size.W};
    const depth_map partner = {a->partner_depth, a->partner_sigma, a->partner_support, a->size.PARTNER_H,
                               a->size.PARTNER_W};
    const consistency_gates gates = {a->max_reprojection_error, a->tolerance, a->min_support, a->silence_counts};
    const consistency_sums sums = {a->observing, a->agreeing, a->contradicting, a->weighted_shift, a->weight};
    view_transfer transfer;
    split_transfer(a->partner_from_reference, transfer.pixel_from_reference, transfer.translation);
    split_transfer(a->reference_from_partner, transfer.reference_from_pixel, transfer.back_translation);
    a->backend->compare_depths(&reference, &partner, &transfer, gates, &sums);
    return 0;
}

FUNCTION(compare_depths, COMPARE_DEPTHS, check_compare_depths,
         "Add what a partner's depth map says of a view's to the sums over all partners.");

#define CONFIRM_DEPTH(X) \
    X(IN, float32, depth, H, W) \
    X(IN, float32, sigma, H, W) \
    X(VALUE, int, min_consistent) \
    X(VALUE, int, may_miss) \
    X(VALUE, float, max_contradiction) \
    X(VALUE, float, min_surface) \
    X(VALUE, float, steepest) \
    X(IN, uint8, observing, H, W) \
    X(OUT, uint8, agreeing, H, W) \
    X(OUT, uint8, contradicting, H, W) \
    X(OUT, float32, weighted_shift, H, W) \
    X(OUT, float32, weight, H, W)
ARGUMENTS(confirm_depth, CONFIRM_DEPTH);

static int run_confirm_depth(void *arguments) {
    const confirm_depth_arguments *a = arguments;
    const confirmation options = {a->min_consistent, a->may_miss, a->max_contradiction, a->min_surface,
                                  a->steepest};
    confirm_depth(a->depth, a->sigma, a->size.H, a->size.W, &options, a->observing, a->agreeing, a->contradicting,
                  a->weighted_shift, a->weight);
    return 0;
}

FUNCTION(confirm_depth, CONFIRM_DEPTH, any,
         "Turn the sums of compare_depths into the geometric map: `weighted_shift` becomes depth, `weight` its\n"
         "deviation, `agreeing` its support; `contradicting` is spoilt.");

#define FIT_PLANES(X) \
    X(VALUE, backend, backend) \
    X(IN, float32, inverse_depth, H, W) \
    X(IN, float32, inverse_sigma, H, W) \
    X(IN, uint8, support, H, W) \
    X(IN, float64, K, 3, 3) \
    X(VALUE, int, radius) \
    X(VALUE, float, tolerance) \
    X(VALUE, float, max_shift) \
    X(VALUE, float, shift_sigma) \
    X(VALUE, float, min_cosine) \
    X(VALUE, int, supported) \
    X(OUT, float32, normals, H, W, 3) \
    X(OUT, float32, fitted_depth, H, W)
ARGUMENTS(fit_planes, FIT_PLANES);

static int check_fit_planes(const void *arguments) {
    const fit_planes_arguments *a = arguments;
    return check(a->radius >= 1 && a->radius <= MAX_FIT_RADIUS, "the window radius must lie in 1..16");
}

static int run_fit_planes(void *arguments) {
    const fit_planes_arguments *a = arguments;
    const plane_fit fit = {a->radius, a->tolerance, a->max_shift, a->shift_sigma, a->min_cosine, a->supported};
    return a->backend->fit_planes(a->inverse_depth, a->inverse_sigma, a->support, a->size.H, a->size.W, a->K, &fit,
                                  a->normals, a->fitted_depth);
}

FUNCTION(fit_planes, FIT_PLANES, check_fit_planes,
         "Normals and depths of planes fitted to each pixel's neighbours; zeros where none fits.");

#define ADD_RELIEF(X) \
    X(IN, float32, depth, H, W) \
    X(IN, float32, sigma, H, W) \
    X(OUT, float32, fitted_depth, H, W)
ARGUMENTS(add_relief, ADD_RELIEF);

static int run_add_relief(void *arguments) {
    const add_relief_arguments *a = arguments;
    return add_relief(a->depth, a->sigma, a->size.H, a->size.W, a->fitted_depth);
}

FUNCTION(add_relief, ADD_RELIEF, any,
         "Put back what fitted planes cut off where they bend: move them towards the depths they were fitted to.");

#define ADD_PATCH_EQUATIONS(X) \
    X(VALUE, backend, backend) \
    X(IN, uint8, image, H, W) \
    X(IMAGES, uint16, sources, SOURCES) \
    X(IN, float64, sources_from_reference, SOURCES, 3, 4) \
    X(IN, uint32, used, TILES) \
    X(IN, float32, planes, 3, ROWS, W) \
    X(VALUE, ptrdiff, first_row) \
    X(VALUE, ptrdiff, row_step) \
    X(VALUE, float, contrast) \
    X(VALUE, float, min_score) \
    X(OUT, float32, equations, 12, ROWS, W)
ARGUMENTS(add_patch_equations, ADD_PATCH_EQUATIONS);

/* Whether every `step`-th of so many rows are at least `count`. */
static int rows_fit(ptrdiff_t rows, ptrdiff_t step, ptrdiff_t count) {
    return count == 0 || (rows > 0 && count - 1 <= (rows - 1) / step);
}

static int check_rows(ptrdiff_t first, ptrdiff_t step, ptrdiff_t height, ptrdiff_t count) {
    return check(first >= 0 && step >= 1 && rows_fit(height - first, step, count),
                 "the rows must lie in the image");
}

static int check_add_patch_equations(const void *arguments) {
    const add_patch_equations_arguments *a = arguments;
    for (ptrdiff_t k = 0; k < a->size.SOURCES; k++) {
        const ptrdiff_t height = a->sources->image[k].height, width = a->sources->image[k].width;
        if (!check(width <= 65535, "rows are limited to 65535 columns") ||
            !check(height < 16384 || height * width < 1 << 30, "a source is limited to 2^30 pixels")) {
            return 0;
        }
    }
    return check(a->size.TILES == (a->size.W + PATCH_TILE - 1) / PATCH_TILE,
                 "used must have a size of one per 32 columns") &&
           check_rows(a->first_row, a->row_step, a->size.H, a->size.ROWS);
}

static int run_add_patch_equations(void *arguments) {
    const add_patch_equations_arguments *a = arguments;
    const grey_image reference = {a->image, a->size.H, a->size.W};
    const patch_rows rows = {a->first_row, a->row_step, a->size.ROWS};
    const patch_options options = {a->contrast, a->min_score};
    patch_source sources[MAX_PATCH_SOURCES];
    for (ptrdiff_t k = 0; k < a->size.SOURCES; k++) {
        sources[k].image =
            (paired_image){a->sources->image[k].values, a->sources->image[k].height, a->sources->image[k].width};
        split_transfer(a->sources_from_reference + 12 * k, sources[k].matrix, sources[k].translation);
    }
    a->backend->add_patch_equations(&reference, sources, a->size.SOURCES, a->used, a->planes, rows, options,
                                    a->equations);
    return 0;
}

FUNCTION(add_patch_equations, ADD_PATCH_EQUATIONS, check_add_patch_equations,
         "Add the normal equations of matching planes of every `row_step`-th row in sources, where every pixel\n"
         "(the lower byte) has the one below it beside it. Each tile of 32 columns uses the sources whose bits\n"
         "are set.");

#define PLANES_OF_MAPS(X) \
    X(IN, float32, normals, H, W, 3) \
    X(IN, float32, depth, H, W) \
    X(IN, float64, inverse_K, 3, 3) \
    X(VALUE, ptrdiff, first_row) \
    X(VALUE, ptrdiff, row_step) \
    X(OUT, float32, planes, 3, ROWS, W)
ARGUMENTS(planes_of_maps, PLANES_OF_MAPS);

static int check_planes_of_maps(const void *arguments) {
    const planes_of_maps_arguments *a = arguments;
    return check_rows(a->first_row, a->row_step, a->size.H, a->size.ROWS);
}

static int run_planes_of_maps(void *arguments) {
    const planes_of_maps_arguments *a = arguments;
    const patch_rows rows = {a->first_row, a->row_step, a->size.ROWS};
    planes_of_maps(a->normals, a->depth, a->size.W, a->inverse_K, rows, a->planes);
    return 0;
}

FUNCTION(
    planes_of_maps, PLANES_OF_MAPS, check_planes_of_maps,
    "Inverse depth and its change per column and row on every `row_step`-th row of maps; 0 where there is none.");

#define MAPS_OF_PLANES(X) \
    X(IN, float32, planes, 3, ROWS, W) \
    X(IN, float64, K, 3, 3) \
    X(VALUE, ptrdiff, first_row) \
    X(OUT, float32, normals, H, W, 3) \
    X(OUT, float32, depth, H, W)
ARGUMENTS(maps_of_planes, MAPS_OF_PLANES);

static int check_maps_of_planes(const void *arguments) {
    const maps_of_planes_arguments *a = arguments;
    return check_rows(a->first_row, 1, a->size.H, a->size.ROWS);
}

static int run_maps_of_planes(void *arguments) {
    const maps_of_planes_arguments *a = arguments;
    maps_of_planes(a->planes, a->size.ROWS, a->size.W, a->K, a->first_row, a->normals, a->depth);
    return 0;
}

FUNCTION(maps_of_planes, MAPS_OF_PLANES, check_maps_of_planes,
         "The inverse of planes_of_maps, into the maps' rows from `first_row` on.");

#define REFINE_PLANES(X) \
    X(IN, float32, equations, 12, H, W) \
    X(IN, float32, sigma, H, W) \
    X(VALUE, float, slope_sigma) \
    X(OUT, float32, planes, 3, H, W)
ARGUMENTS(refine_planes, REFINE_PLANES);

static int run_refine_planes(void *arguments) {
    const refine_planes_arguments *a = arguments;
    refine_planes(a->equations, a->sigma, a->size.H * a->size.W, a->slope_sigma, a->planes);
    return 0;
}

FUNCTION(refine_planes, REFINE_PLANES, any, "Move planes by the solution of their equations.");

native_function *const depth_functions[] = {
    &transfer_disparity_function, &depth_candidates_function,    &vote_depth_function,
    &compare_depths_function,     &confirm_depth_function,       &fit_planes_function,
    &add_relief_function,         &add_patch_equations_function, &planes_of_maps_function,
    &maps_of_planes_function,     &refine_planes_function,       NULL};
