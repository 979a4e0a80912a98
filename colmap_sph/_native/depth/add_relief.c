/* Planes cut off ridges and round off steps: where they bend, what the depths around stand off them by is put back
 * (twicing: a smoother is applied to its own residuals). */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "depth/depth.h"

/* Standard deviations that planes bend by where half is put back, and most that are told apart. */
static const float HALF_BEND = 4;
static const float MOST_BEND = 50;

/* Pixels between those that a bend is of; empty pixels beside each row; rows that are kept, a power of two. */
enum { STEP = 2, MARGIN = STEP, ROWS = 8 };

/* The last rows' inverse depths of planes, what depths stand off them by, how much planes bend, and 1 where there
 * is a plane, else all 0. */
typedef struct {
    float *plane, *residual, *bend, *there;
    ptrdiff_t stride;
} relief;

static inline float *row_of(const relief *r, float *rows, ptrdiff_t row) {
    return rows + (row & (ROWS - 1)) * r->stride + MARGIN;
}

/* What is read and what is written never overlap, so that compilers work on several pixels at once. */
static void find_residuals(const float *restrict depth, const float *restrict fitted, ptrdiff_t width,
                           float *restrict plane, float *restrict residual, float *restrict there) {
    for (ptrdiff_t x = 0; x < width; x++) {
        const int found = (depth[x] > 0) & (fitted[x] > 0);
        const float inverse = 1 / (found ? fitted[x] : 1), own = 1 / (found ? depth[x] : 1);
        plane[x] = found ? inverse : 0;
        residual[x] = found ? own - inverse : 0;
        there[x] = found ? 1 : 0;
    }
}

/* Along the row or the column, whichever bends more, in standard deviations. */
static void find_bends(const relief *r, ptrdiff_t row, const float *restrict depth, const float *restrict sigma,
                       ptrdiff_t width, float *restrict bends) {
    const float *plane = row_of(r, r->plane, row), *there = row_of(r, r->there, row);
    const float *above = row_of(r, r->plane, row - STEP), *there_above = row_of(r, r->there, row - STEP);
    const float *below = row_of(r, r->plane, row + STEP), *there_below = row_of(r, r->there, row + STEP);
    for (ptrdiff_t x = 0; x < width; x++) {
        const float twice = 2 * plane[x];
        const float across = there[x - STEP] * there[x + STEP] * fabsf(plane[x - STEP] + plane[x + STEP] - twice);
        const float along = there_above[x] * there_below[x] * fabsf(above[x] + below[x] - twice);
        const float bend = (across > along ? across : along) * depth[x] * depth[x] / sigma[x];
        const float bounded = bend < MOST_BEND ? bend : MOST_BEND; /* also for NaN */
        bends[x] = there[x] > 0 ? bounded : 0;
    }
}

/* Sums over each pixel and those before and after it in its row and the rows next to it. */
static void sum_around(const relief *r, float *rows, ptrdiff_t row, ptrdiff_t width, float *restrict sums) {
    const float *above = row_of(r, rows, row - 1), *at = row_of(r, rows, row), *below = row_of(r, rows, row + 1);
    for (ptrdiff_t x = 0; x < width; x++) {
        sums[x] = above[x - 1] + above[x] + above[x + 1] + at[x - 1] + at[x] + at[x + 1] + below[x - 1] +
                  below[x] + below[x + 1];
    }
}

/* `sums` has room for three rows. */
static void move_planes(const relief *r, ptrdiff_t row, ptrdiff_t width, float *sums, float *restrict fitted) {
    float *residuals = sums, *bends = sums + width, *counts = sums + 2 * width;
    sum_around(r, r->residual, row, width, residuals);
    sum_around(r, r->bend, row, width, bends);
    sum_around(r, r->there, row, width, counts);
    const float *plane = row_of(r, r->plane, row), *residual = row_of(r, r->residual, row);
    const float *there = row_of(r, r->there, row);
    for (ptrdiff_t x = 0; x < width; x++) {
        const float own = residual[x], mean = residuals[x] / counts[x], bend = bends[x] / counts[x];
        /* No farther than to the pixel's own depth. */
        const float least = own < 0 ? own : 0, most = own > 0 ? own : 0;
        const float raised = mean > least ? mean : least, move = raised < most ? raised : most;
        const float moved = plane[x] + move * (bend * bend / (bend * bend + HALF_BEND * HALF_BEND));
        fitted[x] = there[x] > 0 ? 1 / moved : fitted[x];
    }
}

int add_relief(const float *depth, const float *sigma, ptrdiff_t height, ptrdiff_t width, float *fitted) {
    const ptrdiff_t stride = width + 2 * MARGIN, size = ROWS * stride;
    float *room = calloc((size_t)(4 * size + 3 * width), sizeof *room);
    if (!room) {
        return -1;
    }
    const relief r = {room, room + size, room + 2 * size, room + 3 * size, stride};
    /* Bends need the planes of two more rows, and means the bends of one more; below the last row is nothing. */
    for (ptrdiff_t row = 0; row < height + STEP + 1; row++) {
        float *plane = row_of(&r, r.plane, row), *residual = row_of(&r, r.residual, row);
        float *there = row_of(&r, r.there, row);
        const ptrdiff_t bent = row - STEP, moved = bent - 1;
        if (row < height) {
            find_residuals(depth + row * width, fitted + row * width, width, plane, residual, there);
        } else {
            memset(plane, 0, (size_t)width * sizeof *plane);
            memset(residual, 0, (size_t)width * sizeof *residual);
            memset(there, 0, (size_t)width * sizeof *there);
        }
        if (bent >= 0 && bent < height) {
            find_bends(&r, bent, depth + bent * width, sigma + bent * width, width, row_of(&r, r.bend, bent));
        } else if (bent >= height) {
            memset(row_of(&r, r.bend, bent), 0, (size_t)width * sizeof *r.bend);
        }
        if (moved >= 0 && moved < height) {
            move_planes(&r, moved, width, room + 4 * size, fitted + moved * width);
        }
    }
    free(room);
    return 0;
}
