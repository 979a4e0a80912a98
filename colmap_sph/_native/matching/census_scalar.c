#include "matching/weighed_census.h"

void make_grey_codes(int step, uint64_t *codes) {
    static const uint8_t places[GREY_BITS] = {0, 8, 9, 17, 18, 26, 27, 34, 35, 43, 44, 52, 53, 61};
    for (int i = 0; i < GREY_CODES; i++) {
        const int level = (GREY_CODE_STEP * i + GREY_CODE_STEP / 2) / step % (2 * GREY_BITS);
        codes[i] = 0;
        for (int k = 0; k < GREY_BITS; k++) {
            codes[i] |= (uint64_t)(level > k && level <= k + GREY_BITS) << places[k];
        }
    }
}

void census_scalar(census_image image, ptrdiff_t stride, uint64_t *census) {
    const ptrdiff_t padded_stride = image.width + 2 * CENSUS_RADIUS_X;
    for (ptrdiff_t y = 0; y < image.height; y++) {
        for (ptrdiff_t x = 0; x < image.width; x++) {
            const int16_t *window = image.padded + y * padded_stride + x;
            const int16_t centre = window[CENSUS_RADIUS_Y * padded_stride + CENSUS_RADIUS_X];
            const int limit = centre - CENSUS_MARGIN;
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
            word = weighed_census(word, centre, image.fine, image.grey);
            census[y * stride + x] = image.valid[y * image.width + x] ? word : CENSUS_INVALID;
        }
    }
}
