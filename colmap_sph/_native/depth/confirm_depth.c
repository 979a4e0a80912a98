#include <math.h>

#include "depth/depth.h"

/* What becomes of a pixel's depth: it is dropped; or dropped, but part of its neighbours' surfaces; or kept. */
enum { DROPPED, OF_SURFACE, KEPT };

/* What so many views confirm needs no surface around it. */
enum { WELL_CONFIRMED = 3 };

/* Depths of one surface differ by so many standard deviations. */
static const float NOISE = 2;

/* Least share of the window around a pixel that must lie on its surface, by how many agree of the views wanted. */
static float least_surface(float min_surface, int agreeing, int wanted) {
    return agreeing < wanted ? (1 + min_surface) / 2 : agreeing < 2 ? min_surface : min_surface / 2;
}

/* Views that must agree: as many as observe the pixel's point, but one at least. */
static int wanted_views(const confirmation *options, int observing) {
    const int seen = observing > 1 ? observing : 1;
    const int most = options->min_consistent > 0 ? options->min_consistent : 0;
    return seen < most ? seen : most;
}

/* Share of the window around a pixel, cut off at the image's borders, that lies on the pixel's surface. */
static float surface_share(const float *depth, const float *sigma, const uint8_t *fates, ptrdiff_t height,
                           ptrdiff_t width, ptrdiff_t row, ptrdiff_t column, float steepest) {
    const ptrdiff_t radius = SURFACE_RADIUS, p = row * width + column;
    const ptrdiff_t top = row > radius ? row - radius : 0, left = column > radius ? column - radius : 0;
    const ptrdiff_t bottom = row + radius < height ? row + radius : height - 1;
    const ptrdiff_t right = column + radius < width ? column + radius : width - 1;
    const float step = depth[p] * steepest * SURFACE_RADIUS + NOISE * sigma[p];
    int count = 0;
    for (ptrdiff_t y = top; y <= bottom; y++) {
        for (ptrdiff_t x = left; x <= right; x++) {
            const ptrdiff_t q = y * width + x;
            count += fates[q] != DROPPED && fabsf(depth[q] - depth[p]) <= step;
        }
    }
    return (float)count / (float)((bottom - top + 1) * (right - left + 1));
}

void confirm_depth(const float *depth, const float *sigma, ptrdiff_t height, ptrdiff_t width,
                   const confirmation *options, const uint8_t *observing, uint8_t *agreeing,
                   uint8_t *contradicting, float *weighted_shift, float *weight) {
    const int least = options->min_consistent > 0, may_miss = options->min_surface > 0 ? options->may_miss : 0;
    uint8_t *fates = contradicting;
    for (ptrdiff_t p = 0; p < height * width; p++) {
        const int missing = wanted_views(options, observing[p]) - agreeing[p];
        const float most = options->max_contradiction * (float)agreeing[p];
        const int fits = depth[p] > 0 && agreeing[p] >= least && (float)contradicting[p] <= most;
        const int enough = missing <= (contradicting[p] > 0 ? 0 : may_miss);
        fates[p] = fits ? enough ? KEPT : OF_SURFACE : DROPPED;
        /* Divided before it is squared: the fourth power of a depth in tiny or huge units is no float. */
        const float precision = depth[p] * depth[p] / sigma[p], total = weight[p] + precision * precision;
        const float mean = 1 / (1 / depth[p] + weighted_shift[p] / total);
        weighted_shift[p] = mean;
        weight[p] = mean * mean / __builtin_sqrtf(total);
    }
    float *const confirmed = weighted_shift, *const deviation = weight;
    for (ptrdiff_t row = 0; row < height; row++) {
        for (ptrdiff_t column = 0; column < width; column++) {
            const ptrdiff_t p = row * width + column;
            if (fates[p] == KEPT && agreeing[p] < WELL_CONFIRMED) {
                const int wanted = wanted_views(options, observing[p]);
                const float share =
                    surface_share(confirmed, deviation, fates, height, width, row, column, options->steepest);
                /* Either way it stays part of its neighbours' surfaces. */
                fates[p] = share < least_surface(options->min_surface, agreeing[p], wanted) ? OF_SURFACE : KEPT;
            }
        }
    }
    for (ptrdiff_t p = 0; p < height * width; p++) {
        if (fates[p] != KEPT) {
            confirmed[p] = deviation[p] = 0;
            agreeing[p] = 0;
        }
    }
}
