#include "matching/weighed_census.h"

void census_scalar(census_image image, int fine, ptrdiff_t stride, uint64_t *census) {
    const ptrdiff_t padded_stride = image.width + 2 * CENSUS_RADIUS_X;
    for (ptrdiff_t y = 0; y < image.height; y++) {
        for (ptrdiff_t x = 0; x < image.width; x++) {
            const int16_t *window = image.padded + y * padded_stride + x;
            const int limit = window[CENSUS_RADIUS_Y * padded_stride + CENSUS_RADIUS_X] - CENSUS_MARGIN;
            uint64_t word = 0;
            int bit = 0;
            for (int dy = 0; dy <= 2 * CENSUS_RADIUS_Y; dy++) {
                for (int dx = 0; dx <= 2 * CENSUS_RADIUS_X; dx++) {
                    if (dy == CENSUS_RADIUS_Y && dx == CENSUS_RADIUS_X) {
                        continue;
                    }
                    word |= (uint64_t)(window[dy * padded_stride + dx] < limit) << bit++;
                }
            }
            word = fine ? weighed_census(word) : word;
            census[y * stride + x] = image.valid[y * image.width + x] ? word : CENSUS_INVALID;
        }
    }
}
