#include "fusion/meeting.h"

/* Area of the surface that a pixel covers: its solid angle cuts depth^2 / (fx fy) out of a plane parallel to the
 * image, and more out of a slanted one. */
static inline float surface_area(const double *m, double column, double row, float depth, direction normal) {
    const double x = m[0] * column + m[1] * row + m[2], y = m[3] * column + m[4] * row + m[5];
    const double facing = fabs(normal.x * x + normal.y * y + normal.z);
    return (float)(m[0] * m[4] * depth * depth / fmax(facing, 1e-3));
}

void fuse_partner(const view_maps *reference, const view_maps *partner, const uint8_t *image,
                  const fusion_transfer *transfer, fusion_gates gates, int bit, const fusion_verdict *verdict) {
    const double max_error_squared = (double)gates.max_reprojection_error * gates.max_reprojection_error;
    for (ptrdiff_t row = 0; row < reference->height; row++) {
        for (ptrdiff_t column = 0; column < reference->width; column++) {
            const ptrdiff_t p = row * reference->width + column;
            const float z = reference->depth[p];
            if (!(z > 0) || verdict->covered[p]) {
                continue;
            }
            const meeting met = meet(reference, partner, transfer, gates, row, column);
            if (met.gate != GATE_NONE) {
                continue;
            }
            if (met.du * met.du + met.dv * met.dv <= max_error_squared) {
                const float area =
                    surface_area(reference->ray_from_pixel, (double)column, (double)row, z, met.own);
                const float other_area =
                    surface_area(partner->ray_from_pixel, (double)met.x, (double)met.y, met.depth, met.other);
                if (other_area < area || (other_area == area && transfer->partner_wins)) {
                    verdict->covered[p] = 1;
                    continue;
                }
            }
            verdict->agreeing[p] |= UINT64_C(1) << bit;
            const uint8_t *colour = image + 3 * (met.y * partner->width + met.x);
            for (int k = 0; k < 3; k++) {
                verdict->colour[3 * p + k] = (uint16_t)(verdict->colour[3 * p + k] + colour[k]);
            }
        }
    }
}
