/* What a partner's depth map says of a view's. Blocks of fixed size in plain loops, so that the compiler
 * vectorises all but the reading of the partner's map. */
#include <math.h>
#include <string.h>

#include "depth/depth.h"
#include "geometry.h"
#include "version.h"

enum { BLOCK = 128 };

/* Largest relative difference of neighbouring depths of one surface. */
static const float MAX_STEP = 0.02f;

/* Pixels of one row of the reference. */
typedef struct {
    float depth[BLOCK], sigma[BLOCK]; /* the reference's own; no depth beyond the row's end */
    double u[BLOCK], v[BLOCK];        /* column and row in the partner's map; 0 where out of view */
    float expected[BLOCK];            /* depth of the point in the partner's view */
    int32_t inside[BLOCK];            /* 1 where it is in view */
    int32_t x[BLOCK], y[BLOCK];       /* the pixel before (u, v), and the nearest */
    int32_t nearest_x[BLOCK], nearest_y[BLOCK];
    int32_t surrounded[BLOCK];         /* 1 where there are pixels to the right and below */
    float corner[4][BLOCK];            /* the partner's depths around (u, v) ... */
    float found[BLOCK], spread[BLOCK]; /* ... and there, 0 = none, with its standard deviation ... */
    int32_t support[BLOCK];            /* ... and the pairs behind it */
    float carried[BLOCK];              /* that depth in the reference ... */
    int32_t near[BLOCK];               /* ... and whether the point is near the pixel it came from */
    int32_t observed[BLOCK], agreed[BLOCK], contradicted[BLOCK];
    float shift[BLOCK], weight[BLOCK];
} block;

/* Where the points lie in the partner's map; false where none does. */
static inline int project(const view_transfer *transfer, const depth_map *partner, double first_column, double row,
                          block *k) {
    const double *m = transfer->pixel_from_reference, *t = transfer->translation;
    const double last_u = (double)(partner->width - 1), last_v = (double)(partner->height - 1);
    for (int i = 0; i < BLOCK; i++) {
        const vector seen = transform(m, t, first_column + i, row, k->depth[i]);
        const double scale = 1 / seen.z, u = seen.x * scale, v = seen.y * scale;
        /* False for NaN. */
        const int inside = (k->depth[i] > 0) & (seen.z > 0) & (u >= 0) & (v >= 0) & (u <= last_u) & (v <= last_v);
        k->u[i] = inside ? u : 0;
        k->v[i] = inside ? v : 0;
        k->expected[i] = (float)seen.z;
        k->inside[i] = inside;
    }
    int any = 0;
    for (int i = 0; i < BLOCK; i++) {
        any |= k->inside[i];
    }
    return any;
}

/* Finds the pixels around every point in the partner's map, which is not empty, and reads them. */
static inline void read_partner(const depth_map *partner, block *k) {
    const int32_t last_x = (int32_t)(partner->width - 1), last_y = (int32_t)(partner->height - 1);
    for (int i = 0; i < BLOCK; i++) {
        k->x[i] = (int32_t)k->u[i];
        k->y[i] = (int32_t)k->v[i];
        k->nearest_x[i] = (int32_t)(k->u[i] + 0.5);
        k->nearest_y[i] = (int32_t)(k->v[i] + 0.5);
        k->surrounded[i] = (k->x[i] < last_x) & (k->y[i] < last_y);
    }
    for (int i = 0; i < BLOCK; i++) {
        const ptrdiff_t right = k->surrounded[i], below = right ? partner->width : 0;
        const ptrdiff_t nearest = k->nearest_y[i] * partner->width + k->nearest_x[i];
        const float *corner = partner->depth + k->y[i] * partner->width + k->x[i];
        k->corner[0][i] = corner[0];
        k->corner[1][i] = corner[right];
        k->corner[2][i] = corner[below];
        k->corner[3][i] = corner[below + right];
        k->found[i] = partner->depth[nearest];
        k->spread[i] = partner->sigma[nearest];
        k->support[i] = partner->support[nearest];
    }
}

/* The partner's depth: bilinear in inverse depth where the four pixels around are one surface, else the nearest.
 */
static inline void interpolate(block *k) {
    for (int i = 0; i < BLOCK; i++) {
        const float c0 = k->corner[0][i], c1 = k->corner[1][i], c2 = k->corner[2][i], c3 = k->corner[3][i];
        const float nearest = k->found[i], step = MAX_STEP * nearest;
        /* False for NaN. */
        const int surface = (k->surrounded[i] > 0) & (nearest > 0) & (fabsf(c0 - nearest) <= step) &
                            (fabsf(c1 - nearest) <= step) & (fabsf(c2 - nearest) <= step) &
                            (fabsf(c3 - nearest) <= step);
        const float fx = (float)(k->u[i] - k->x[i]), fy = (float)(k->v[i] - k->y[i]);
        const float upper = (1 - fx) / c0 + fx / c1, lower = (1 - fx) / c2 + fx / c3;
        const float between = 1 / ((1 - fy) * upper + fy * lower);
        k->found[i] = surface ? between : nearest;
    }
}

/* Carries the partner's depth back into the reference. */
static inline void carry_back(const view_transfer *transfer, float max_reprojection_error, double first_column,
                              double row, block *k) {
    const double *m = transfer->reference_from_pixel, *t = transfer->back_translation;
    const double max_error_squared = (double)max_reprojection_error * max_reprojection_error;
    for (int i = 0; i < BLOCK; i++) {
        const vector back = transform(m, t, k->u[i], k->v[i], k->found[i]);
        const double scale = 1 / back.z, du = back.x * scale - (first_column + i), dv = back.y * scale - row;
        k->near[i] = (back.z > 0) & (du * du + dv * dv <= max_error_squared);
        k->carried[i] = (float)back.z;
    }
}

static inline void judge(consistency_gates gates, block *k) {
    for (int i = 0; i < BLOCK; i++) {
        const float difference = k->found[i] - k->expected[i], own = k->sigma[i], spread = k->spread[i];
        const float gate = gates.tolerance * sqrtf(spread * spread + own * own);
        const int seen = k->found[i] > 0 ? k->inside[i] : 0;
        /* Where it sees something nearer, that hides the point. */
        const int hidden = difference >= -2 * gate ? 0 : seen;
        /* Where it sees something behind it, it looks through it; if it is sure of that. */
        const int sure = k->support[i] >= gates.min_support ? seen : 0;
        k->contradicted[i] = (difference > 2 * gate ? sure : 0) & ~hidden;
        k->observed[i] = (gates.silence_counts ? k->inside[i] : seen) & ~hidden;
        k->agreed[i] = fabsf(difference) <= gate ? seen & k->near[i] : 0;
        /* The standard deviation of a depth grows with its square: that found is brought to the one expected, or
         * what is too near would weigh more. In inverse depth of the reference. */
        const float depth = k->depth[i], ratio = k->expected[i] / k->found[i] / depth;
        const float inverse_spread = spread * ratio * ratio;
        const float weight = 1 / (inverse_spread * inverse_spread);
        k->weight[i] = weight;
        k->shift[i] = weight * (1 / k->carried[i] - 1 / depth);
    }
}

static inline void add_counts(const int32_t *counts, ptrdiff_t count, uint8_t *restrict sums) {
    for (ptrdiff_t i = 0; i < count; i++) {
        sums[i] = (uint8_t)(sums[i] + (sums[i] < UINT8_MAX ? counts[i] : 0));
    }
}

static inline void add_depths(const float *values, const int32_t *agreed, ptrdiff_t count, float *restrict sums) {
    for (ptrdiff_t i = 0; i < count; i++) {
        const float sum = sums[i] + values[i];
        sums[i] = agreed[i] ? sum : sums[i];
    }
}

void VERSION_OF(compare_depths)(const depth_map *reference, const depth_map *partner,
                                const view_transfer *transfer, consistency_gates gates,
                                const consistency_sums *sums) {
    block k;
    memset(&k, 0, sizeof k);
    for (ptrdiff_t row = 0; row < reference->height; row++) {
        for (ptrdiff_t column = 0; column < reference->width; column += BLOCK) {
            const ptrdiff_t left = reference->width - column, count = left < BLOCK ? left : BLOCK;
            const ptrdiff_t first = row * reference->width + column;
            memset(k.depth, 0, sizeof k.depth);
            memcpy(k.depth, reference->depth + first, (size_t)count * sizeof *k.depth);
            memcpy(k.sigma, reference->sigma + first, (size_t)count * sizeof *k.sigma);
            if (!project(transfer, partner, (double)column, (double)row, &k)) {
                continue;
            }
            read_partner(partner, &k);
            interpolate(&k);
            carry_back(transfer, gates.max_reprojection_error, (double)column, (double)row, &k);
            judge(gates, &k);
            add_counts(k.observed, count, sums->observing + first);
            add_counts(k.agreed, count, sums->agreeing + first);
            add_counts(k.contradicted, count, sums->contradicting + first);
            add_depths(k.shift, k.agreed, count, sums->weighted_shift + first);
            add_depths(k.weight, k.agreed, count, sums->weight + first);
        }
    }
}
