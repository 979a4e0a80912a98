#include <stdlib.h>

#include "kernels.h"

/* Equiangular ("V") fit through three costs, 1/256 pixel, within [-128, 128]. Where every path matches to the bit
 * the images differ by whole pixels: without motion the offset is exactly zero. */
int32_t subpixel_offset(uint16_t before, uint16_t best, uint16_t after) {
    const int32_t rise = (before > after ? before : after) - best;
    if (rise <= 0 || best == 0) {
        return 0;
    }
    return ((int32_t)before - after) * 128 / rise;
}

/* Best reference column of every target pixel in one row: the other direction of the left-right check,
 * read off the same volume along x + base + i = constant. The leftmost of equals wins. */
static void match_target_row(const uint16_t *aggregated, const int32_t *base, const uint64_t *reference,
                             match_size size, uint16_t *least, int32_t *best_column) {
    for (ptrdiff_t r = 0; r < size.target_width; r++) {
        least[r] = UINT16_MAX;
    }
    for (ptrdiff_t x = 0; x < size.width; x++) {
        if (reference[x] & CENSUS_INVALID) {
            continue;
        }
        for (ptrdiff_t i = 0; i < size.depth; i++) {
            const ptrdiff_t r = x + base[x] + i;
            const uint16_t sum = aggregated[x * size.depth + i];
            if (r >= 0 && r < size.target_width && sum < least[r]) {
                least[r] = sum;
                best_column[r] = (int32_t)x;
            }
        }
    }
}

static int32_t select_pixel(const uint16_t *sums, ptrdiff_t x, int32_t base, const uint64_t *target,
                            match_size size, const uint16_t *least, const int32_t *best_column,
                            int32_t max_difference) {
    ptrdiff_t best = 0;
    for (ptrdiff_t i = 1; i < size.depth; i++) {
        if (sums[i] < sums[best]) {
            best = i;
        }
    }
    const ptrdiff_t r = x + base + best;
    /* At the end of the range the true minimum may lie beyond it. */
    if (best == 0 || best == size.depth - 1 || r < 0 || r >= size.target_width || (target[r] & CENSUS_INVALID) ||
        least[r] == UINT16_MAX || llabs(best_column[r] - x) > max_difference) {
        return OFFSET_INVALID;
    }
    return (int32_t)(base + best) * 256 + subpixel_offset(sums[best - 1], sums[best], sums[best + 1]);
}

int selection_scalar(const uint16_t *aggregated, const int32_t *base, const uint64_t *reference,
                     const uint64_t *target, match_size size, int32_t max_left_right_difference, int32_t *offset) {
    uint16_t *least = malloc((size_t)size.target_width * sizeof *least);
    int32_t *best_column = malloc((size_t)size.target_width * sizeof *best_column);
    const int failed = !least || !best_column;
    for (ptrdiff_t y = 0; y < size.height && !failed; y++) {
        const uint16_t *row = aggregated + y * size.width * size.depth;
        const int32_t *row_base = base + y * size.width;
        const uint64_t *row_reference = reference + y * size.width;
        match_target_row(row, row_base, row_reference, size, least, best_column);
        for (ptrdiff_t x = 0; x < size.width; x++) {
            offset[y * size.width + x] =
                row_reference[x] & CENSUS_INVALID
                    ? OFFSET_INVALID
                    : select_pixel(row + x * size.depth, x, row_base[x], target + y * size.target_width, size,
                                   least, best_column, max_left_right_difference);
        }
    }
    free(least);
    free(best_column);
    return failed ? -1 : 0;
}
