#include <math.h>

#include "depth/depth.h"

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

void transfer_disparity(const float *left, ptrdiff_t height, ptrdiff_t left_width, ptrdiff_t right_width,
                        float max_step, float *right) {
    for (ptrdiff_t y = 0; y < height; y++) {
        const float *d = left + y * left_width;
        float *row = right + y * right_width;
        for (ptrdiff_t r = 0; r < right_width; r++) {
            row[r] = NAN;
        }
        for (ptrdiff_t x = 0; x < left_width; x++) {
            if (isnan(d[x])) {
                continue;
            }
            const int joined = x + 1 < left_width && fabsf(d[x + 1] - d[x]) <= max_step;
            if (joined) {
                put_segment(row, right_width, x, d[x], d[x + 1]);
            } else {
                put(row, right_width, (ptrdiff_t)llrintf((float)x - d[x]), d[x]);
            }
        }
    }
}
