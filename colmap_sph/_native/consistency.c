#include <math.h>

#include "geometry.h"
#include "kernels.h"

static inline void count(uint8_t *counter) { *counter += *counter < UINT8_MAX; }

/* Depth map value at (u, v) inside the map: bilinear in inverse depth where the four neighbours are one surface,
 * else nearest. 0 = none. */
static float sample_depth(const float *depth, ptrdiff_t height, ptrdiff_t width, double u, double v,
                          float max_relative_step) {
    const float nearest = depth[(ptrdiff_t)(v + 0.5) * width + (ptrdiff_t)(u + 0.5)];
    const ptrdiff_t x = (ptrdiff_t)u, y = (ptrdiff_t)v;
    if (x + 1 >= width || y + 1 >= height || !(nearest > 0)) {
        return nearest;
    }
    const float *corner = depth + y * width + x;
    const float values[4] = {corner[0], corner[1], corner[width], corner[width + 1]};
    for (int k = 0; k < 4; k++) {
        if (!(fabsf(values[k] - nearest) <= max_relative_step * nearest)) {
            return nearest;
        }
    }
    const float fx = (float)(u - (double)x), fy = (float)(v - (double)y);
    const float upper = (1 - fx) / values[0] + fx / values[1], lower = (1 - fx) / values[2] + fx / values[3];
    return 1 / ((1 - fy) * upper + fy * lower);
}

void check_consistency(const float *depth, const float *sigma, ptrdiff_t height, ptrdiff_t width,
                       const float *partner_depth, const float *partner_sigma, ptrdiff_t partner_height,
                       ptrdiff_t partner_width, const view_transfer *transfer, float max_reprojection_error,
                       float tolerance, uint8_t *observing, uint8_t *agreeing, uint8_t *contradicting,
                       float *weighted_depth, float *weight) {
    const double max_error_squared = (double)max_reprojection_error * max_reprojection_error;
    for (ptrdiff_t row = 0; row < height; row++) {
        for (ptrdiff_t column = 0; column < width; column++) {
            const ptrdiff_t p = row * width + column;
            if (!(depth[p] > 0)) {
                continue;
            }
            const vector seen = transform(transfer->pixel_from_reference, transfer->translation, (double)column,
                                          (double)row, depth[p]);
            if (!(seen.z > 0)) {
                continue;
            }
            const double u = seen.x / seen.z, v = seen.y / seen.z;
            if (!(u >= 0 && v >= 0 && u <= (double)(partner_width - 1) && v <= (double)(partner_height - 1))) {
                continue;
            }
            const float partner = sample_depth(partner_depth, partner_height, partner_width, u, v, 0.02f);
            if (!(partner > 0)) {
                count(&observing[p]);
                continue;
            }
            const float partner_spread =
                partner_sigma[(ptrdiff_t)(v + 0.5) * partner_width + (ptrdiff_t)(u + 0.5)];
            const vector back =
                transform(transfer->reference_from_pixel, transfer->back_translation, u, v, partner);
            const double du = back.x / back.z - (double)column, dv = back.y / back.z - (double)row;
            const float difference = partner - (float)seen.z;
            const float gate = tolerance * __builtin_sqrtf(partner_spread * partner_spread + sigma[p] * sigma[p]);
            if (back.z > 0 && du * du + dv * dv <= max_error_squared && fabsf(difference) <= gate) {
                const float w = 1 / (partner_spread * partner_spread);
                weighted_depth[p] += w * ((float)back.z - depth[p]);
                weight[p] += w;
                count(&agreeing[p]);
                count(&observing[p]);
            } else if (difference >= -2 * gate) { /* else it sees something nearer, which hides the point */
                count(&observing[p]);
                /* Or it looks through this point at something behind it. */
                contradicting[p] += difference > 2 * gate && contradicting[p] < UINT8_MAX;
            }
        }
    }
}

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
