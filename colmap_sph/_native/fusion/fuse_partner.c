#include "fusion/meeting.h"

/* Area of the surface that a pixel covers: its solid angle cuts depth^2 / (fx fy) out of a plane parallel to the
 * image, and more out of a slanted one. */
static inline float surface_area(const double *m, double column, double row, float depth, direction normal) {
    const double x = m[0] * column + m[1] * row + m[2], y = m[3] * column + m[4] * row + m[5];
    const double facing = fabs(normal.x * x + normal.y * y + normal.z), least = 1e-3;
    return (float)(m[0] * m[4] * depth * depth / (facing > least ? facing : least));
}

/* Pixels that are sighted together, so that compilers work on several at once. */
enum { BLOCK = 64 };

typedef struct {
    ptrdiff_t count;
    int32_t column[BLOCK];
    double depth[BLOCK];
    sighting seen[BLOCK];
} block;

/* Those of a row's pixels from `first` on, before `end`, of which something is to be asked. */
static inline void sight_block(const float *depth, const uint8_t *covered, const fusion_transfer *transfer,
                               double row, ptrdiff_t first, ptrdiff_t end, block *k) {
    k->count = 0;
    for (ptrdiff_t column = first; column < end; column++) {
        k->column[k->count] = (int32_t)column;
        k->depth[k->count] = depth[column];
        k->count += (depth[column] > 0) & !covered[column];
    }
    for (ptrdiff_t i = 0; i < k->count; i++) {
        k->seen[i] = sight(transfer, k->column[i], row, k->depth[i]);
    }
}

void fuse_partner(const view_maps *reference, const view_maps *partner, const uint8_t *image,
                  const fusion_transfer *transfer, fusion_gates gates, int bit, const fusion_verdict *verdict) {
    const double max_error_squared = (double)gates.max_reprojection_error * gates.max_reprojection_error;
    const ptrdiff_t blocks = (reference->width + BLOCK - 1) / BLOCK;
    for (ptrdiff_t n = 0; n < reference->height * blocks; n++) {
        const ptrdiff_t row = n / blocks, first = n % blocks * BLOCK, left = reference->width - first;
        const ptrdiff_t start = row * reference->width;
        block k;
        sight_block(reference->depth + start, verdict->covered + start, transfer, (double)row, first,
                    first + (left < BLOCK ? left : BLOCK), &k);
        for (ptrdiff_t i = 0; i < k.count; i++) {
            const ptrdiff_t column = k.column[i], p = start + column;
            const meeting met = meet(reference, partner, transfer, gates, p, k.seen[i]);
            if (met.gate != GATE_NONE) {
                continue;
            }
            if (met.du * met.du + met.dv * met.dv <= max_error_squared) {
                const float area = surface_area(reference->ray_from_pixel, (double)column, (double)row,
                                                reference->depth[p], met.own);
                const float other_area =
                    surface_area(partner->ray_from_pixel, (double)met.x, (double)met.y, met.depth, met.other);
                if (other_area < area || (other_area == area && transfer->partner_wins)) {
                    verdict->covered[p] = 1;
                    continue;
                }
            }
            verdict->agreeing[p] |= UINT64_C(1) << bit;
            const uint8_t *colour = image + 3 * (met.y * partner->width + met.x);
            for (int c = 0; c < 3; c++) {
                verdict->colour[3 * p + c] = (uint16_t)(verdict->colour[3 * p + c] + colour[c]);
            }
        }
    }
}
