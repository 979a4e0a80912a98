#include <immintrin.h>
#include <stdlib.h>

#include "kernels.h"

/* One reference pixel's sums against the best so far of the target pixels they point at. Columns are kept in
 * 16 bits (module.c limits the width); strictly less keeps the leftmost of equals, as x grows. */
static inline void match_target_pixels(const uint16_t *sums, ptrdiff_t first, ptrdiff_t x, match_size size,
                                       uint16_t *least, uint16_t *best_column) {
    if (first >= 0 && first + size.depth <= size.target_width) {
        const __m256i column = _mm256_set1_epi16((short)x);
        for (ptrdiff_t i = 0; i < size.depth; i += 16) {
            __m256i *best = (__m256i *)(least + first + i), *where = (__m256i *)(best_column + first + i);
            const __m256i sum = _mm256_loadu_si256((const __m256i *)(sums + i));
            const __m256i old = _mm256_loadu_si256(best);
            const __m256i not_less = _mm256_cmpeq_epi16(_mm256_max_epu16(sum, old), sum);
            _mm256_storeu_si256(best, _mm256_min_epu16(sum, old));
            _mm256_storeu_si256(where, _mm256_blendv_epi8(column, _mm256_loadu_si256(where), not_less));
        }
        return;
    }
    for (ptrdiff_t i = 0; i < size.depth; i++) {
        const ptrdiff_t r = first + i;
        if (r >= 0 && r < size.target_width && sums[i] < least[r]) {
            least[r] = sums[i];
            best_column[r] = (uint16_t)x;
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
                                   match_size size, const uint16_t *least, const uint16_t *best_column,
                                   int32_t max_difference) {
    const ptrdiff_t best = first_minimum(sums, size.depth);
    const ptrdiff_t r = x + base + best;
    if (best == 0 || best == size.depth - 1 || r < 0 || r >= size.target_width || (target[r] & CENSUS_INVALID) ||
        least[r] == UINT16_MAX || llabs((int32_t)best_column[r] - x) > max_difference) {
        return OFFSET_INVALID;
    }
    return (int32_t)(base + best) * 256 + subpixel_offset(sums[best - 1], sums[best], sums[best + 1]);
}

int selection_avx2(const uint16_t *aggregated, const int32_t *base, const uint64_t *reference,
                   const uint64_t *target, match_size size, int32_t max_left_right_difference, int32_t *offset) {
    uint16_t *least = malloc((size_t)size.target_width * sizeof *least);
    uint16_t *best_column = malloc((size_t)size.target_width * sizeof *best_column);
    const int failed = !least || !best_column;
    for (ptrdiff_t y = 0; y < size.height && !failed; y++) {
        const uint16_t *row = aggregated + y * size.width * size.depth;
        const int32_t *row_base = base + y * size.width;
        const uint64_t *row_reference = reference + y * size.width;
        for (ptrdiff_t r = 0; r < size.target_width; r++) {
            least[r] = UINT16_MAX;
        }
        for (ptrdiff_t x = 0; x < size.width; x++) {
            if (!(row_reference[x] & CENSUS_INVALID)) {
                match_target_pixels(row + x * size.depth, x + row_base[x], x, size, least, best_column);
            }
        }
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
