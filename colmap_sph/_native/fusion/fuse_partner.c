#include <math.h>

#include "fusion/pixels.h"
#include "geometry.h"

static inline float cosine_after(const double *m, direction from, direction to) {
    const double x = m[0] * from.x + m[1] * from.y + m[2] * from.z;
    const double y = m[3] * from.x + m[4] * from.y + m[5] * from.z;
    const double z = m[6] * from.x + m[7] * from.y + m[8] * from.z;
    return (float)(x * to.x + y * to.y + z * to.z);
}

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
    const double width = (double)partner->width, height = (double)partner->height;
    for (ptrdiff_t row = 0; row < reference->height; row++) {
        for (ptrdiff_t column = 0; column < reference->width; column++) {
            const ptrdiff_t p = row * reference->width + column;
            const float z = reference->depth[p];
            if (!(z > 0) || verdict->covered[p]) {
                continue;
            }
            const vector seen =
                transform(transfer->pixel_from_reference, transfer->translation, (double)column, (double)row, z);
            /* From the corner of the first pixel, so that whole numbers are pixels. */
            const double u = seen.x / seen.z + 0.5, v = seen.y / seen.z + 0.5;
            if (!(seen.z > 0 && u >= 0 && v >= 0 && u < width && v < height)) {
                continue;
            }
            const ptrdiff_t x = (ptrdiff_t)u, y = (ptrdiff_t)v;
            const ptrdiff_t q = y * partner->width + x;
            const float depth = partner->depth[q];
            if (!(depth > 0 && isfinite(depth) && fabsf(depth - (float)seen.z) <= gates.max_depth_error * depth)) {
                continue;
            }
            const direction own = normal_at(reference, p), other = normal_at(partner, q);
            if (!(cosine_after(transfer->reference_from_partner, other, own) >= gates.min_normal_cosine)) {
                continue;
            }
            const double du = u - 0.5 - (double)x, dv = v - 0.5 - (double)y;
            if (du * du + dv * dv <= max_error_squared) {
                const float area = surface_area(reference->ray_from_pixel, (double)column, (double)row, z, own);
                const float other_area = surface_area(partner->ray_from_pixel, (double)x, (double)y, depth, other);
                if (other_area < area || (other_area == area && transfer->partner_wins)) {
                    verdict->covered[p] = 1;
                    continue;
                }
            }
            verdict->agreeing[p] |= UINT64_C(1) << bit;
            for (int k = 0; k < 3; k++) {
                verdict->colour[3 * p + k] = (uint16_t)(verdict->colour[3 * p + k] + image[3 * q + k]);
            }
        }
    }
}
