/* Images warped by predicted offsets, row by row; see `warp` in matching.h. */
#include "matching/matching.h"

void warp(const float *source, const uint8_t *valid, const int32_t *prediction, ptrdiff_t margin, match_size size,
          float *warped, uint8_t *warped_valid, ptrdiff_t stride, int32_t *columns) {
    for (ptrdiff_t y = 0; y < size.height; y++) {
        const ptrdiff_t out = y * size.target_width;
        const float *row = source + y * size.source_width;
        const uint8_t *row_valid = valid + y * size.source_width;
        for (ptrdiff_t w = 0; w < size.target_width; w++) {
            const int64_t place =
                (int64_t)(w - margin) * 256 + prediction[y * size.width + within(w - margin, size.width)];
            const int64_t nearest = (place + 128) >> 8;
            const int inside = nearest >= 0 && nearest < size.source_width;
            columns[y * stride + w] = inside ? (int32_t)nearest : -1;
            if (size.source_width == 0) {
                warped[out + w] = 0;
                warped_valid[out + w] = 0;
                continue;
            }
            const int part = (int)(place & 255);
            const ptrdiff_t column = within((ptrdiff_t)(place >> 8), size.source_width);
            const ptrdiff_t next = within((ptrdiff_t)(place >> 8) + (part > 0), size.source_width);
            const uint8_t both = row_valid[column] < row_valid[next] ? row_valid[column] : row_valid[next];
            warped[out + w] = row[column] + (row[next] - row[column]) * ((float)part / 256);
            warped_valid[out + w] = inside ? both : 0;
        }
    }
}

void unwarp_offsets(const int32_t *offset, const int32_t *prediction, ptrdiff_t margin, match_size size,
                    int32_t *unwarped) {
    /* Neighbours whose predictions differ by more are of two surfaces, between which nothing is interpolated. */
    enum { MAX_STEP = 4 * 256 };
    for (ptrdiff_t y = 0; y < size.height; y++) {
        const int32_t *predicted = prediction + y * size.width;
        for (ptrdiff_t x = 0; x < size.width; x++) {
            const ptrdiff_t p = y * size.width + x;
            if (offset[p] == OFFSET_INVALID) {
                unwarped[p] = OFFSET_INVALID;
                continue;
            }
            const int64_t residual = (int64_t)offset[p] - 256 * (int64_t)margin;
            const int64_t place = 256 * (int64_t)x + residual;
            const int part = (int)(place & 255);
            const int64_t here = predicted[within((ptrdiff_t)(place >> 8), size.width)];
            const int64_t next = predicted[within((ptrdiff_t)(place >> 8) + 1, size.width)];
            const int64_t step = next - here;
            const int64_t between =
                step > MAX_STEP || step < -MAX_STEP ? (part < 128 ? 0 : step) : step * part >> 8;
            const int64_t sum = residual + here + between;
            unwarped[p] = sum > -MAX_OFFSET && sum < MAX_OFFSET ? (int32_t)sum : OFFSET_INVALID;
        }
    }
}
