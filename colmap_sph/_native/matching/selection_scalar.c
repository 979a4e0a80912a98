#include <stdlib.h>

#include "matching/rows.h"

/* Equiangular ("V") fit through three costs, 1/256 pixel, within [-128, 128]. Where every path matches to the bit
 * the images differ by whole pixels: without motion the offset is exactly zero. */
static int32_t subpixel_offset(uint8_t before, uint8_t best, uint8_t after) {
    const int32_t rise = (before > after ? before : after) - best;
    if (rise <= 0 || best == 0) {
        return 0;
    }
    return ((int32_t)before - after) * 128 / rise;
}

/* Least sum of every target pixel of the row: the other direction of the left-right check, read off the same
 * volume along x + base + i = constant. */
static void match_target_row(const uint8_t *sums, const int32_t *base, const uint64_t *reference, match_size size,
                             uint8_t *best_sum) {
    for (ptrdiff_t r = 0; r < size.target_width; r++) {
        best_sum[r] = UINT8_MAX;
    }
    for (ptrdiff_t x = 0; x < size.width; x++) {
        if (reference[x] & CENSUS_INVALID) {
            continue;
        }
        for (ptrdiff_t i = 0; i < size.depth; i++) {
            const ptrdiff_t r = x + base[x] + i;
            if (r >= 0 && r < size.target_width && sums[x * size.depth + i] < best_sum[r]) {
                best_sum[r] = sums[x * size.depth + i];
            }
        }
    }
}

/* Whether one of the best matches of target pixel r lies within `max_difference` columns of x. */
static int is_mutual(const uint8_t *sums, const int32_t *base, const int32_t *winner, match_size size,
                     uint8_t best_sum, ptrdiff_t x, ptrdiff_t r, int32_t max_difference) {
    const ptrdiff_t first = x < max_difference ? 0 : x - max_difference;
    for (ptrdiff_t near = first; near < size.width && near - x <= max_difference; near++) {
        const ptrdiff_t i = r - near - base[near];
        if (winner[near] >= 0 && i >= 0 && i < size.depth && sums[near * size.depth + i] == best_sum) {
            return 1;
        }
    }
    return 0;
}

static int32_t first_minimum(const uint8_t *sums, ptrdiff_t depth) {
    int32_t best = 0;
    for (int32_t i = 1; i < depth; i++) {
        if (sums[i] < sums[best]) {
            best = i;
        }
    }
    return best;
}

/* The target pixel whose sum that of r is checked against, and that sum. */
static ptrdiff_t rival_of(ptrdiff_t r, const uint8_t *best_sum, match_size size, const selection_buffers *buffers,
                          uint8_t *sum) {
    const ptrdiff_t c = buffers->columns ? buffers->columns[r] : -1;
    const uint32_t there = c >= 0 && c < size.source_width ? buffers->best[c] : UINT32_MAX;
    const int shown = there >> 24 < UINT8_MAX;
    *sum = shown ? (uint8_t)(there >> 24) : best_sum[r];
    return shown ? (ptrdiff_t)(there & 0xffffff) : r;
}

void check_winners_scalar(const uint8_t *sums, const int32_t *base, const uint64_t *target, match_size size,
                          left_right_check check, const selection_buffers *buffers, int32_t *offset) {
    const uint8_t *best_sum = buffers->best_sum + size.depth;
    for (ptrdiff_t x = 0; x < size.width; x++) {
        const uint8_t *own = sums + x * size.depth;
        const ptrdiff_t best = buffers->winner[x], r = x + base[x] + best;
        /* At the end of the range the true minimum may lie beyond it. */
        int found =
            best > 0 && best < size.depth - 1 && r >= 0 && r < size.target_width && !(target[r] & CENSUS_INVALID);
        if (found) {
            uint8_t sum;
            const ptrdiff_t rival = rival_of(r, best_sum, size, buffers, &sum);
            found = own[best] - sum <= check.max_excess ||
                    is_mutual(sums, base, buffers->winner, size, sum, x, rival, check.max_difference);
        }
        offset[x] =
            found ? (int32_t)(base[x] + best) * 256 + subpixel_offset(own[best - 1], own[best], own[best + 1])
                  : OFFSET_INVALID;
    }
}

void selection_row_scalar(const uint8_t *sums, const int32_t *base, const uint64_t *reference,
                          const uint64_t *target, const int32_t *columns, match_size size, left_right_check check,
                          selection_buffers *buffers, int32_t *offset) {
    for (ptrdiff_t x = 0; x < size.width; x++) {
        buffers->winner[x] = reference[x] & CENSUS_INVALID ? -1 : first_minimum(sums + x * size.depth, size.depth);
    }
    uint8_t *best_sum = buffers->best_sum + size.depth;
    match_target_row(sums, base, reference, size, best_sum);
    merge_columns(columns, size, buffers);
    check_winners_scalar(sums, base, target, size, check, buffers, offset);
}
