/* What is done with the offsets of matched pixels between the kernels of matching: in place, one pass each, plain
 * enough for compilers to work on many pixels at once, so that one version serves all processors. */
#ifndef COLMAP_SPH_OFFSETS_H
#define COLMAP_SPH_OFFSETS_H

#include "common.h"

/* 1/256 pixel: neighbours are of one segment whose offsets, in whole SEGMENT_UNITs, differ by no more than
 * MAX_SEGMENT_STEP. */
enum { SEGMENT_UNIT = 64, MAX_SEGMENT_STEP = 4 };

/* Invalidates what does not lie between two offsets. */
void keep_between(int32_t *offset, ptrdiff_t pixels, ptrdiff_t first, ptrdiff_t last);

/* Invalidates connected regions of fewer pixels than `min_segment`; -1 without memory. */
int remove_small_segments(int32_t *offset, ptrdiff_t height, ptrdiff_t width, ptrdiff_t min_segment);

/* How many offsets have each of the 256 fractions. */
void count_fractions(const int32_t *offset, ptrdiff_t pixels, uint32_t *counts);

/* Offsets to columns of the source where windows are torn, from those to the target that has the source as it is
 * from column `as_it_is` on. */
void unwarp_torn(const int32_t *offset, const uint8_t *torn, ptrdiff_t pixels, int as_it_is, int32_t *unwarped);

/* Where the first slot of pixels lies. */
typedef struct {
    const int32_t *predicted, *base;
    const uint8_t *torn;
    ptrdiff_t height, width;
} search_bases;

/* Among the columns of the source: the prediction's nearest whole pixel + base, of torn pixels the base alone. */
void first_offsets(search_bases bases, int32_t *first);

/* Among those of the target: base + `margin`, of torn pixels the base + `as_it_is`, but no more than `gap` columns
 * before the first column of the source. */
void target_bases(search_bases bases, int margin, int as_it_is, int gap, int32_t *target_base);

/* Rows of a target in which a warped image is followed, after a gap, by its source as it is. */
typedef struct {
    ptrdiff_t height, width, warped_width, source_width;
} joined_sizes;

/* The gap has no content, and the source's pixels show their own columns. */
void join_targets(joined_sizes sizes, uint64_t *census, int32_t *columns);

/* Offsets, 1/256 pixel, become the first of `depth` whole offsets about them, between `first` and `last`. */
void bases_about(int32_t *offset, ptrdiff_t pixels, int depth, int32_t first, int32_t last);

/* Marks the pixels on both sides of larger steps than `max_step`. */
void mark_steps(const int32_t *offset, ptrdiff_t height, ptrdiff_t width, int32_t max_step, uint8_t *marks);

/* Of every second pixel of every second row, how many have no larger step than `edge` to the next one along and
 * across, and how many of these a larger one than `steep`. */
typedef struct {
    ptrdiff_t surface, steep;
} slope_counts;

slope_counts count_slopes(const int32_t *offset, ptrdiff_t height, ptrdiff_t width, int32_t edge, int32_t steep);

/* Least and most of the finite disparities; 0, 0 where there is none. */
void disparity_range(const float *disparity, ptrdiff_t pixels, float ends[2]);

/* Disparities and their codes, 1 + the whole steps from the least one; 0 = none. */
void code_disparity(const float *disparity, ptrdiff_t pixels, float least, float step, uint16_t *codes);
void decode_disparity(const uint16_t *codes, ptrdiff_t pixels, float least, float step, float *disparity);

enum { MAX_SEEDS = 2048, MAX_NEIGHBOURS = 32 };

/* Sparse points of a pair: what is known (`values`) at some places of an image. */
typedef struct {
    const double *columns, *rows, *values;
    ptrdiff_t count;
} seed_list;

/* So many seeds around a place count, by 1 / (distance^2 + alike^2). Slopes are held back as if `stiffness` times
 * as many seeds at the distance `alike`, and `unknown_stiffness` times as many at that of the nearest one, told of
 * none. */
typedef struct {
    int neighbours;
    double alike, stiffness, unknown_stiffness;
} seed_weights;

/* Values, at the centres of cells of so many pixels, of planes through the seeds around them. */
void seed_planes(seed_list seeds, seed_weights weights, ptrdiff_t cell, ptrdiff_t height, ptrdiff_t width,
                 float *values);

#endif
