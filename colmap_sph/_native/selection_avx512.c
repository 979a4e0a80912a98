/* selection_avx2.c with 32 sums and 16 keys per register; its second pass serves both. */
#include <immintrin.h>

#include "rows.h"

#define ALWAYS_INLINE static inline __attribute__((always_inline))

/* Sixteen times the lesser key. */
ALWAYS_INLINE void keep_lesser(uint32_t *keys, __m512i new_keys) {
    _mm512_storeu_si512(keys, _mm512_min_epu32(new_keys, _mm512_loadu_si512(keys)));
}

/* One pixel's sums against the best so far of the target pixels they point at: sums 0, 2, ... against `even` and
 * those between against `odd`. */
ALWAYS_INLINE void match_target_pixels(const uint16_t *sums, ptrdiff_t x, ptrdiff_t depth, uint32_t *even,
                                       uint32_t *odd) {
    const __m512i column = _mm512_set1_epi32((int)x);
    for (ptrdiff_t i = 0; i < depth; i += 32) {
        const __m512i sum = _mm512_loadu_si512(sums + i);
        keep_lesser(even + i / 2, _mm512_or_si512(_mm512_slli_epi32(sum, 16), column));
        keep_lesser(odd + i / 2, _mm512_mask_mov_epi16(sum, 0x55555555, column));
    }
}

/* Without branches: where the minimum lies is hard to predict. */
ALWAYS_INLINE int32_t first_minimum(const uint16_t *sums, ptrdiff_t depth) {
    __m512i minimum = _mm512_loadu_si512(sums);
    for (ptrdiff_t i = 32; i < depth; i += 32) {
        minimum = _mm512_min_epu16(minimum, _mm512_loadu_si512(sums + i));
    }
    const __m256i half = _mm256_min_epu16(_mm512_castsi512_si256(minimum), _mm512_extracti64x4_epi64(minimum, 1));
    const __m128i part = _mm_min_epu16(_mm256_castsi256_si128(half), _mm256_extracti128_si256(half, 1));
    const __m512i least = _mm512_broadcastw_epi16(_mm_minpos_epu16(part));
    int32_t first = 0;
    for (ptrdiff_t i = depth; i > 0;) {
        uint64_t equal = _mm512_cmpeq_epi16_mask(least, _mm512_loadu_si512(sums + (i -= 32)));
        if (depth % 64 == 0) {
            equal = equal << 32 | _mm512_cmpeq_epi16_mask(least, _mm512_loadu_si512(sums + (i -= 32)));
        }
        first = equal ? (int32_t)(i + __builtin_ctzll(equal)) : first;
    }
    return first;
}

#define SELECTION_ROW selection_row_avx512
#include "selection.inc"
