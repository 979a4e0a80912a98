#include <arm_neon.h>

#include "matching/census_blocks.h"

enum { LANES = 8, MIDDLE = CENSUS_BITS / 2 };

/* Comparisons fill 16 bits of each pixel, the lowest first: one is shifted to its place, over all that is above
 * the bits there are. Four such parts of eight pixels are stored interleaved, as words. */
static inline void census_8_pixels(const int16_t *window, ptrdiff_t stride, uint64_t *words) {
    const int16x8_t middle = vld1q_s16(window + CENSUS_RADIUS_Y * stride + CENSUS_RADIUS_X);
    /* Nothing is darker than the number at which this saturates. */
    const int16x8_t limit = vqsubq_s16(middle, vdupq_n_s16(CENSUS_MARGIN));
    const uint16x8_t none = vdupq_n_u16(0);
    uint16x8x4_t parts = {{none, none, none, none}};
#define BIT(dy, dx) (9 * (dy) + (dx) - (9 * (dy) + (dx) > MIDDLE))
#define COMPARE(dy, dx) \
    parts.val[BIT(dy, dx) / 16] = \
        vsliq_n_u16(parts.val[BIT(dy, dx) / 16], vcgtq_s16(limit, vld1q_s16(window + (dy) * stride + (dx))), \
                    BIT(dy, dx) % 16);
#define COMPARE_LEFT(dy) COMPARE(dy, 0) COMPARE(dy, 1) COMPARE(dy, 2) COMPARE(dy, 3)
#define COMPARE_RIGHT(dy) COMPARE(dy, 5) COMPARE(dy, 6) COMPARE(dy, 7) COMPARE(dy, 8)
#define COMPARE_ROW(dy) COMPARE_LEFT(dy) COMPARE(dy, 4) COMPARE_RIGHT(dy)
    COMPARE_ROW(0)
    COMPARE_ROW(1)
    COMPARE_ROW(2)
    COMPARE_LEFT(3)
    COMPARE_RIGHT(3)
    COMPARE_ROW(4)
    COMPARE_ROW(5)
    COMPARE_ROW(6)
    /* The last comparison went to the bits above its own, too. */
    parts.val[3] = vandq_u16(parts.val[3], vdupq_n_u16((1 << CENSUS_BITS % 16) - 1));
    vst4q_u16((uint16_t *)(void *)words, parts);
}

void census_neon(census_image image, ptrdiff_t stride, uint64_t *census) {
    census_in_blocks(census_8_pixels, LANES, image, stride, census);
}
