#include <stdlib.h>

#include "images/images.h"
#include "matching/matching.h"
#include "version.h"

/* Weights of the pixel, and of the sum of 3 x 3 pixels that weigh 1 2 1, 2 4 2, 1 2 1. */
typedef struct {
    float own, around;
} weights;

ALWAYS_INLINE int16_t sharpened(weights w, float own, float before, float at, float after) {
    const float value = w.own * own - w.around * (before + 2 * at + after);
    return (int16_t)(int32_t)(value > INT16_MIN ? (value < INT16_MAX ? value : INT16_MAX) : INT16_MIN);
}

/* A row of the padded image; `sums` weigh three rows 1 2 1. */
static void sharpen_row(weights w, const float *own, const float *sums, ptrdiff_t width,
                        int16_t *restrict padded) {
    int16_t *restrict out = padded + CENSUS_RADIUS_X;
    for (ptrdiff_t x = 1; x < width - 1; x++) {
        out[x] = sharpened(w, own[x], sums[x - 1], sums[x], sums[x + 1]);
    }
    for (ptrdiff_t i = 0; i <= CENSUS_RADIUS_X; i++) {
        const ptrdiff_t left = -i, right = width - 1 + i;
        out[left] = sharpened(w, own[0], sums[0], sums[0], sums[within(left + 1, width)]);
        out[right] =
            sharpened(w, own[width - 1], sums[within(right - 1, width)], sums[width - 1], sums[width - 1]);
    }
}

int VERSION_OF(sharpen)(const float *image, ptrdiff_t height, ptrdiff_t width, float sharpening, int16_t *padded) {
    const weights w = {CENSUS_STEPS * (1 + sharpening), CENSUS_STEPS * sharpening / 16};
    if (height == 0 || width == 0) {
        return 0;
    }
    float *sums = malloc((size_t)width * sizeof *sums);
    if (!sums) {
        return -1;
    }
    for (ptrdiff_t y = -CENSUS_RADIUS_Y; y < height + CENSUS_RADIUS_Y; y++) {
        const float *above = image + within(y - 1, height) * width, *own = image + within(y, height) * width;
        const float *below = image + within(y + 1, height) * width;
        for (ptrdiff_t x = 0; x < width; x++) {
            sums[x] = above[x] + 2 * own[x] + below[x];
        }
        sharpen_row(w, own, sums, width, padded + (y + CENSUS_RADIUS_Y) * (width + 2 * CENSUS_RADIUS_X));
    }
    free(sums);
    return 0;
}
