#include <math.h>

#include "depth/depth.h"

/* Share of the window around a pixel, cut off at the image's borders, that is kept and lies on the pixel's
 * surface. */
static float surface_share(const float *depth, const uint8_t *kept, ptrdiff_t height, ptrdiff_t width,
                           ptrdiff_t row, ptrdiff_t column, const confirmation *options) {
    const ptrdiff_t radius = SURFACE_RADIUS;
    const ptrdiff_t top = row > radius ? row - radius : 0, left = column > radius ? column - radius : 0;
    const ptrdiff_t bottom = row + radius < height ? row + radius : height - 1;
    const ptrdiff_t right = column + radius < width ? column + radius : width - 1;
    const float own = depth[row * width + column], step = own * options->steepest * SURFACE_RADIUS;
    int count = 0;
    for (ptrdiff_t y = top; y <= bottom; y++) {
        for (ptrdiff_t x = left; x <= right; x++) {
            count += kept[y * width + x] && fabsf(depth[y * width + x] - own) <= step;
        }
    }
    return (float)count / (float)((bottom - top + 1) * (right - left + 1));
}

void confirm_depth(const float *depth, const float *sigma, ptrdiff_t height, ptrdiff_t width,
                   const confirmation *options, const uint8_t *observing, uint8_t *agreeing,
                   uint8_t *contradicting, float *weighted_depth, float *weight) {
    uint8_t *kept = contradicting;
    for (ptrdiff_t p = 0; p < height * width; p++) {
        const int seen = observing[p] > 1 ? observing[p] : 1;
        const int enough = agreeing[p] >= (seen < options->min_consistent ? seen : options->min_consistent);
        const float most = options->max_contradiction * (float)agreeing[p];
        kept[p] = depth[p] > 0 && enough && (float)contradicting[p] <= most;
        const float own = 1 / (sigma[p] * sigma[p]);
        weighted_depth[p] = depth[p] + weighted_depth[p] / (weight[p] + own);
        weight[p] = 1 / __builtin_sqrtf(weight[p] + own);
    }
    for (ptrdiff_t row = 0; row < height; row++) {
        for (ptrdiff_t column = 0; column < width; column++) {
            const ptrdiff_t p = row * width + column;
            if (!kept[p] || (agreeing[p] < 2 && surface_share(depth, kept, height, width, row, column, options) <
                                                    options->min_surface)) {
                weighted_depth[p] = weight[p] = 0;
                agreeing[p] = 0;
            }
        }
    }
}
