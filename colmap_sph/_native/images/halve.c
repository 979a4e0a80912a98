/* Images and masks at half their size, the levels of a pyramid. */
#include "images/images.h"

/* Of the last row or column where their number is odd, the pixels beyond are the same. */
void half_image(const float *image, ptrdiff_t height, ptrdiff_t width, float *restrict half) {
    for (ptrdiff_t y = 0; y < height; y += 2, half += (width + 1) / 2) {
        const float *above = image + y * width, *below = y + 1 < height ? above + width : above;
        for (ptrdiff_t x = 0; x < width / 2; x++) {
            half[x] = ((above[2 * x] + above[2 * x + 1]) + (below[2 * x] + below[2 * x + 1])) * 0.25f;
        }
        if (width % 2) {
            half[width / 2] = (2 * above[width - 1] + 2 * below[width - 1]) * 0.25f;
        }
    }
}

ALWAYS_INLINE uint8_t content_of(int sum) { return sum >= 2 * UINT8_MAX ? UINT8_MAX : 0; }

/* Beyond the last row or column there is no content. */
void half_mask(const uint8_t *mask, ptrdiff_t height, ptrdiff_t width, uint8_t *restrict half) {
    for (ptrdiff_t y = 0; y < height; y += 2, half += (width + 1) / 2) {
        const uint8_t *above = mask + y * width, *below = y + 1 < height ? above + width : above;
        const int counts_below = y + 1 < height;
        for (ptrdiff_t x = 0; x < width / 2; x++) {
            const int upper = above[2 * x] + above[2 * x + 1], lower = below[2 * x] + below[2 * x + 1];
            half[x] = content_of(upper + (counts_below ? lower : 0));
        }
        if (width % 2) {
            half[width / 2] = content_of(above[width - 1] + (counts_below ? below[width - 1] : 0));
        }
    }
}
