#include "matching/matching.h"

void census_scalar(const int16_t *padded, const uint8_t *valid, ptrdiff_t height, ptrdiff_t width,
                   uint64_t *census) {
    const ptrdiff_t stride = width + 2 * CENSUS_RADIUS_X;
    for (ptrdiff_t y = 0; y < height; y++) {
        for (ptrdiff_t x = 0; x < width; x++) {
            const int16_t *window = padded + y * stride + x;
            const int limit = window[CENSUS_RADIUS_Y * stride + CENSUS_RADIUS_X] - CENSUS_MARGIN;
            uint64_t word = 0;
            int bit = 0;
            for (int dy = 0; dy <= 2 * CENSUS_RADIUS_Y; dy++) {
                for (int dx = 0; dx <= 2 * CENSUS_RADIUS_X; dx++) {
                    if (dy == CENSUS_RADIUS_Y && dx == CENSUS_RADIUS_X) {
                        continue;
                    }
                    word |= (uint64_t)(window[dy * stride + dx] < limit) << bit++;
                }
            }
            census[y * width + x] = valid[y * width + x] ? word : CENSUS_INVALID;
        }
    }
}
