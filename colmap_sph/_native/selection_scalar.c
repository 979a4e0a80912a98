#include <stdlib.h>

#include "rows.h"

/* Equiangular ("V") fit through three costs, 1/256 pixel, within [-128, 128]. Where every path matches to the bit
 * the images differ by whole pixels: without motion the offset is exactly zero. */
static int32_t subpixel_offset(uint16_t before, uint16_t best, uint16_t after) {
    const int32_t rise = (before > after ? before : after) - best;
    if (rise <= 0 || best == 0) {
        return 0;
    }
    return ((int32_t)before - after) * 128 / rise;
}

/* Best reference column of every target pixel of the row: the other direction of the left-right check, read off
 * the same volume along x + base + i = constant. */
static void match_target_row(const uint16_t *sums, const int32_t *base, const uint64_t *reference, match_size size,
                             uint32_t *keys) {
    for (ptrdiff_t r = 0; r < size.target_width; r++) {
        keys[r] = NO_KEY;
    }
    for (ptrdiff_t x = 0; x < size.width; x++) {
        if (reference[x] & CENSUS_INVALID) {
            continue;
        }
        for (ptrdiff_t i = 0; i < size.depth; i++) {
            const ptrdiff_t r = x + base[x] + i;
            const uint32_t key = (uint32_t)sums[x * size.depth + i] << 16 | (uint32_t)x;
            if (r >= 0 && r < size.target_width && key < keys[r]) {
                keys[r] = key;
            }
        }
    }
}

static int32_t select_pixel(const uint16_t *sums, ptrdiff_t x, int32_t base, const uint64_t *target,
                            match_size size, const uint32_t *keys, int32_t max_difference) {
    ptrdiff_t best = 0;
    for (ptrdiff_t i = 1; i < size.depth; i++) {
        if (sums[i] < sums[best]) {
            best = i;
        }
    }
    const ptrdiff_t r = x + base + best;
    /* At the end of the range the true minimum may lie beyond it. */
    if (best == 0 || best == size.depth - 1 || r < 0 || r >= size.target_width || (target[r] & CENSUS_INVALID) ||
        keys[r] >= NO_KEY || llabs((int64_t)(keys[r] & UINT16_MAX) - x) > max_difference) {
        return OFFSET_INVALID;
    }
    return (int32_t)(base + best) * 256 + subpixel_offset(sums[best - 1], sums[best], sums[best + 1]);
}

void selection_row_scalar(const uint16_t *sums, const int32_t *base, const uint64_t *reference,
                          const uint64_t *target, match_size size, int32_t max_left_right_difference,
                          selection_buffers *buffers, int32_t *offset) {
    match_target_row(sums, base, reference, size, buffers->keys);
    for (ptrdiff_t x = 0; x < size.width; x++) {
        offset[x] = reference[x] & CENSUS_INVALID ? OFFSET_INVALID
                                                  : select_pixel(sums + x * size.depth, x, base[x], target, size,
                                                                 buffers->keys, max_left_right_difference);
    }
}
