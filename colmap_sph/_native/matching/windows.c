/* From the offsets of one level to what the next finer one searches; see matching.h. */
#include <math.h>

#include "matching/matching.h"

enum { FARTHEST = 1 << 29 };

/* An offset in pixels of the level above, in 1/256 pixel. */
ALWAYS_INLINE int32_t in_steps(float pixels) {
    const float steps = pixels * 512, most = FARTHEST;
    return steps > -most ? (int32_t)(steps < most ? steps : most) : -FARTHEST;
}

/* Whole number of slots by which a pixel's window moves. */
ALWAYS_INLINE int32_t shift_of(int32_t least, int32_t most, int32_t predicted, int32_t room, int32_t farthest) {
    const int32_t bounded = predicted < -FARTHEST ? -FARTHEST : predicted;
    const int32_t near = bounded > FARTHEST ? FARTHEST : bounded;
    const int32_t above = most - near - room, below = near - least - room;
    int32_t shift = (above > 0 ? above : 0) - (below > 0 ? below : 0);
    shift = above > 0 && below > 0 ? shift / 2 : shift;
    shift = shift < -farthest ? -farthest : shift > farthest ? farthest : shift;
    return (shift + 128) >> 8;
}

/* First residuals of a finer row's pixels, whose row above in the pyramid has `width`, and they twice as many. */
static void search_row(const int32_t *restrict predicted, const float *restrict least, const float *restrict most,
                       ptrdiff_t width, search_limits limits, int32_t *restrict base) {
    const int32_t room = 128 * limits.depth - 256 * limits.clearance, half = limits.depth / 2;
    const int32_t farthest = 128 * limits.depth - 256 * limits.own_clearance;
    for (ptrdiff_t x = 0; x < width; x++) {
        const int32_t low = in_steps(least[x]), high = in_steps(most[x]);
        base[2 * x] = shift_of(low, high, predicted[2 * x], room, farthest) - half;
        base[2 * x + 1] = shift_of(low, high, predicted[2 * x + 1], room, farthest) - half;
    }
}

void search_windows(const int32_t *predicted, const float *least, const float *most, level_sizes size,
                    search_limits limits, int32_t *base) {
    for (ptrdiff_t y = 0; y < size.fine_height; y++) {
        const ptrdiff_t coarse = (y >> 1) * size.width, fine = y * size.fine_width, pairs = size.fine_width / 2;
        search_row(predicted + fine, least + coarse, most + coarse, pairs, limits, base + fine);
        if (size.fine_width % 2) { /* the last pixel has none beside it */
            const int32_t last[2] = {predicted[fine + 2 * pairs], 0};
            int32_t bases[2];
            search_row(last, least + coarse + pairs, most + coarse + pairs, 1, limits, bases);
            base[fine + 2 * pairs] = bases[0];
        }
    }
}

void to_disparity(const int32_t *offset, ptrdiff_t pixels, const float *shifts, float *disparity) {
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const float value = (float)offset[p] * (-1.0f / 256) - shifts[offset[p] & 255];
        disparity[p] = offset[p] == OFFSET_INVALID ? NAN : value;
    }
}
