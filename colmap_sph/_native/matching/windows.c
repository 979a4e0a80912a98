/* From the offsets of one level to what the next finer one searches; see matching.h. */
#include <math.h>

#include "matching/matching.h"

/* The 3 x 3 offsets around a pixel; beyond the sides, the outermost. */
typedef struct {
    int64_t at[3][3];
} neighbours;

static inline neighbours neighbours_of(const int32_t *offset, level_sizes size, ptrdiff_t y, ptrdiff_t x) {
    neighbours n;
    for (int j = 0; j < 3; j++) {
        const int32_t *row = offset + within(y + j - 1, size.height) * size.width;
        for (int i = 0; i < 3; i++) {
            n.at[j][i] = row[within(x + i - 1, size.width)];
        }
    }
    return n;
}

static inline int are_near(const neighbours *n, int max_step) {
    int64_t least = n->at[1][1], most = least;
    for (int j = 0; j < 3; j++) {
        for (int i = 0; i < 3; i++) {
            least = n->at[j][i] < least ? n->at[j][i] : least;
            most = n->at[j][i] > most ? n->at[j][i] : most;
        }
    }
    return most - least <= max_step;
}

void upsample_offsets(const int32_t *offset, level_sizes size, int max_step, int32_t *fine) {
    for (ptrdiff_t y = 0; y < size.height; y++) {
        for (ptrdiff_t x = 0; x < size.width; x++) {
            const neighbours n = neighbours_of(offset, size, y, x);
            const int interpolates = are_near(&n, max_step);
            for (int j = 0; j < 2 && 2 * y + j < size.fine_height; j++) {
                for (int i = 0; i < 2 && 2 * x + i < size.fine_width; i++) {
                    /* A quarter of a pixel from the middle, towards this side. */
                    const int64_t *own = n.at[1], *beside = n.at[2 * j];
                    const int64_t sum = 9 * own[1] + 3 * own[2 * i] + 3 * beside[1] + beside[2 * i];
                    const int64_t value = interpolates ? (sum + 8) >> 4 : own[1];
                    fine[(2 * y + j) * size.fine_width + 2 * x + i] = (int32_t)value;
                }
            }
        }
    }
}

/* An offset in pixels of the level above, in 1/256 pixel. */
static inline int64_t in_steps(float pixels) {
    const float steps = pixels * 512, most = 1 << 30;
    return steps > -most ? (int64_t)(steps < most ? steps : most) : -(int64_t)most;
}

void search_windows(const int32_t *predicted, const float *least, const float *most, level_sizes size,
                    search_limits limits, int32_t *base) {
    const int64_t room = 128 * (int64_t)limits.depth - 256 * (int64_t)limits.clearance;
    const int64_t farthest = 128 * (int64_t)limits.depth - 256 * (int64_t)limits.own_clearance;
    for (ptrdiff_t y = 0; y < size.fine_height; y++) {
        for (ptrdiff_t x = 0; x < size.fine_width; x++) {
            const ptrdiff_t p = y * size.fine_width + x, coarse = (y >> 1) * size.width + (x >> 1);
            const int64_t above = in_steps(most[coarse]) - predicted[p] - room;
            const int64_t below = predicted[p] - in_steps(least[coarse]) - room;
            int64_t shift = (above > 0 ? above : 0) - (below > 0 ? below : 0);
            shift = above > 0 && below > 0 ? shift / 2 : shift;
            shift = shift < -farthest ? -farthest : shift > farthest ? farthest : shift;
            base[p] = (int32_t)((shift + 128) >> 8) - limits.depth / 2;
        }
    }
}

void to_disparity(const int32_t *offset, ptrdiff_t pixels, const float *shifts, float *disparity) {
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const float value = (float)offset[p] * (-1.0f / 256) - shifts[offset[p] & 255];
        disparity[p] = offset[p] == OFFSET_INVALID ? NAN : value;
    }
}
