#include <math.h>

#include "depth/depth.h"

enum { BLOCK = 64, MANY = 2 };

/* Where surfaces overlap in the right image, the nearer one (larger disparity) is what it sees. */
static void put(float *row, ptrdiff_t width, ptrdiff_t column, float disparity) {
    if (column >= 0 && column < width && !(row[column] >= disparity)) {
        row[column] = disparity;
    }
}

/* Between two neighbouring left pixels of one surface, the right image's columns get interpolated disparities. */
static void put_segment(float *row, ptrdiff_t width, ptrdiff_t x, float d0, float d1) {
    const float r0 = (float)x - d0, r1 = (float)(x + 1) - d1;
    if (!(r1 > r0 && r1 >= 0 && r0 < (float)width)) {
        return; /* outside, or seen from behind: the left image's order is reversed in the right one */
    }
    /* Cutting off the fraction rounds positive numbers down, without a call. */
    const ptrdiff_t before = r0 > 0 ? (ptrdiff_t)r0 : 0, first = before + (r0 > (float)before);
    const ptrdiff_t end = r1 < (float)width ? (ptrdiff_t)r1 + 1 : width;
    const float slope = (d1 - d0) / (r1 - r0);
    for (ptrdiff_t r = first; r < end; r++) {
        put(row, width, r, d0 + ((float)r - r0) * slope);
    }
}

/* What pixels of a row leave in the right image, as most of them do in one column or none. */
typedef struct {
    int32_t column[BLOCK];  /* the first of a segment to the next pixel */
    float disparity[BLOCK]; /* there */
    int32_t columns[BLOCK]; /* how many: 0, 1 or MANY; MANY also of the first and the last pixel of a surface */
} block;

/* Straight loops, so that the compiler vectorises them. */
static inline int has_any(const float *d) {
    int any = 0;
    for (int i = 0; i < BLOCK; i++) {
        any |= d[i] == d[i];
    }
    return any;
}

static inline void find_columns(const float *d, ptrdiff_t first, ptrdiff_t width, float max_step, block *k) {
    const float end = (float)width;
    for (int i = 0; i < BLOCK; i++) {
        const float d0 = d[i], d1 = d[i + 1], r0 = (float)(int32_t)(first + i) - d0,
                    r1 = (float)(int32_t)(first + i + 1) - d1;
        const float from = r0 > 0 ? r0 : 0, bounded = from < end ? from : end;
        const int32_t before = (int32_t)bounded, column = before + (r0 > (float)before);
        const float at = (float)column;
        /* False for NaN. */
        const int joined = fabsf(d1 - d0) <= max_step, joined_before = fabsf(d0 - d[i - 1]) <= max_step;
        const int some = (r1 > r0) & (r1 >= at) & (at < end), more = (r1 >= at + 1) & (at + 1 < end);
        k->column[i] = column;
        k->disparity[i] = d0 + (at - r0) * ((d1 - d0) / (r1 - r0));
        const int amid = joined & joined_before;
        k->columns[i] = amid ? (some ? (more ? MANY : 1) : 0) : d0 == d0 ? MANY : 0;
    }
}

/* What the pixels from `first` on leave in a row of the right image; `d` holds one more on either side, NaN beyond
 * the ends of the row. A surface ends half a pixel beyond the centre of its last, as in the left image: if the
 * column nearest to that centre lies beyond it, it gets the last pixel's disparity, at the surface's begin
 * likewise. */
static void put_block(const float *d, ptrdiff_t first, ptrdiff_t pixels, ptrdiff_t width, float max_step,
                      float *row) {
    if (!has_any(d)) {
        return;
    }
    block k;
    find_columns(d, first, width, max_step, &k);
    float nowhere;
    for (ptrdiff_t i = 0; i < pixels; i++) {
        if (k.columns[i] < MANY) { /* without a branch: which of them have a column is hard to predict */
            float *at = k.columns[i] ? row + k.column[i] : &nowhere;
            nowhere = 0;
            *at = *at >= k.disparity[i] ? *at : k.disparity[i];
            continue;
        }
        const int joined = fabsf(d[i + 1] - d[i]) <= max_step, joined_before = fabsf(d[i] - d[i - 1]) <= max_step;
        if (joined) {
            put_segment(row, width, first + i, d[i], d[i + 1]);
        }
        const float r = (float)(first + i) - d[i], nearest = rintf(r);
        const int is_inside = nearest >= 0 && nearest < (float)width; /* else it may be no whole number */
        if (is_inside && !(joined && nearest >= r) && !(joined_before && nearest <= r)) {
            put(row, width, (ptrdiff_t)nearest, d[i]);
        }
    }
}

void transfer_disparity(const float *left, ptrdiff_t height, ptrdiff_t left_width, ptrdiff_t right_width,
                        float max_step, float *right) {
    for (ptrdiff_t y = 0; y < height; y++) {
        const float *d = left + y * left_width;
        float *row = right + y * right_width;
        for (ptrdiff_t r = 0; r < right_width; r++) {
            row[r] = NAN;
        }
        for (ptrdiff_t first = 0; first < left_width; first += BLOCK) {
            const ptrdiff_t left_over = left_width - first, pixels = left_over < BLOCK ? left_over : BLOCK;
            float around[BLOCK + 2];
            const float *block_of_row = d + first;
            if (first == 0 || left_over <= BLOCK) {
                for (ptrdiff_t i = 0; i < BLOCK + 2; i++) {
                    const ptrdiff_t x = first + i - 1;
                    around[i] = x >= 0 && x < left_width ? d[x] : NAN;
                }
                block_of_row = around + 1;
            }
            put_block(block_of_row, first, pixels, right_width, max_step, row);
        }
    }
}
