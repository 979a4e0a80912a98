#include <immintrin.h>
#include <stdlib.h>

#include "rows.h"

/* One reference pixel's sums against the best so far of the target pixels they point at; of equals the leftmost
 * wins. Columns are kept in 16 bits (module.c limits the width). */
static inline void match_target_pixels(const uint16_t *sums, ptrdiff_t first, ptrdiff_t x, match_size size,
                                       selection_buffers *buffers) {
    if (first >= 0 && first + size.depth <= size.target_width) {
        const __m256i column = _mm256_set1_epi16((short)x);
        for (ptrdiff_t i = 0; i < size.depth; i += 16) {
            __m256i *best = (__m256i *)(buffers->least + first + i);
            __m256i *where = (__m256i *)(buffers->best_column + first + i);
            const __m256i sum = _mm256_loadu_si256((const __m256i *)(sums + i));
            const __m256i old = _mm256_loadu_si256(best), old_column = _mm256_loadu_si256(where);
            const __m256i not_less = _mm256_cmpeq_epi16(_mm256_max_epu16(sum, old), sum);
            const __m256i not_left = _mm256_cmpeq_epi16(_mm256_max_epu16(column, old_column), column);
            const __m256i keep =
                _mm256_andnot_si256(_mm256_andnot_si256(not_left, _mm256_cmpeq_epi16(sum, old)), not_less);
            _mm256_storeu_si256(best, _mm256_min_epu16(sum, old));
            _mm256_storeu_si256(where, _mm256_blendv_epi8(column, old_column, keep));
        }
        return;
    }
    for (ptrdiff_t i = 0; i < size.depth; i++) {
        const ptrdiff_t r = first + i;
        if (r >= 0 && r < size.target_width &&
            (sums[i] < buffers->least[r] || (sums[i] == buffers->least[r] && x < buffers->best_column[r]))) {
            buffers->least[r] = sums[i];
            buffers->best_column[r] = (uint16_t)x;
        }
    }
}

static inline ptrdiff_t first_minimum(const uint16_t *sums, ptrdiff_t depth) {
    __m256i minimum = _mm256_loadu_si256((const __m256i *)sums);
    for (ptrdiff_t i = 16; i < depth; i += 16) {
        minimum = _mm256_min_epu16(minimum, _mm256_loadu_si256((const __m256i *)(sums + i)));
    }
    const __m128i half = _mm_min_epu16(_mm256_castsi256_si128(minimum), _mm256_extracti128_si256(minimum, 1));
    const __m256i least = _mm256_broadcastw_epi16(_mm_minpos_epu16(half));
    for (ptrdiff_t i = 0; i < depth; i += 16) {
        const __m256i equal = _mm256_cmpeq_epi16(least, _mm256_loadu_si256((const __m256i *)(sums + i)));
        const unsigned mask = (unsigned)_mm256_movemask_epi8(equal);
        if (mask) {
            return i + __builtin_ctz(mask) / 2;
        }
    }
    return 0;
}

static inline int32_t select_pixel(const uint16_t *sums, ptrdiff_t x, int32_t base, const uint64_t *target,
                                   match_size size, const selection_buffers *buffers, int32_t max_difference) {
    const ptrdiff_t best = first_minimum(sums, size.depth);
    const ptrdiff_t r = x + base + best;
    /* At the end of the range the true minimum may lie beyond it. */
    if (best == 0 || best == size.depth - 1 || r < 0 || r >= size.target_width || (target[r] & CENSUS_INVALID) ||
        buffers->least[r] == UINT16_MAX || llabs((int32_t)buffers->best_column[r] - x) > max_difference) {
        return OFFSET_INVALID;
    }
    return (int32_t)(base + best) * 256 + subpixel_offset(sums[best - 1], sums[best], sums[best + 1]);
}

void selection_row_avx2(const uint16_t *sums, const int32_t *base, const uint64_t *reference,
                        const uint64_t *target, match_size size, int32_t max_left_right_difference,
                        selection_buffers *buffers, int32_t *offset) {
    for (ptrdiff_t r = 0; r < size.target_width; r++) {
        buffers->least[r] = UINT16_MAX;
        buffers->best_column[r] = 0; /* so that a sum of 65535 never wins */
    }
    /* Neighbours point at almost the same target pixels, and would wait for each other's results to reach the
     * cache: pixels from all over the row take turns. */
    enum { TURNS = 4 };
    const ptrdiff_t part = (size.width + TURNS - 1) / TURNS;
    for (ptrdiff_t k = 0; k < part; k++) {
        for (ptrdiff_t x = k; x < size.width; x += part) {
            if (!(reference[x] & CENSUS_INVALID)) {
                match_target_pixels(sums + x * size.depth, x + base[x], x, size, buffers);
            }
        }
    }
    for (ptrdiff_t x = 0; x < size.width; x++) {
        offset[x] = reference[x] & CENSUS_INVALID ? OFFSET_INVALID
                                                  : select_pixel(sums + x * size.depth, x, base[x], target, size,
                                                                 buffers, max_left_right_difference);
    }
}
