/* The first pass of selection_avx2.c with 64 sums per register; its second pass serves both. */
#include <immintrin.h>

#include "rows.h"

#define ALWAYS_INLINE static inline __attribute__((always_inline))

/* Without branches: where the minimum lies is hard to predict. */
ALWAYS_INLINE int32_t first_minimum(const uint8_t *sums, ptrdiff_t depth, uint8_t *best_sum) {
    __m512i minimum = _mm512_set1_epi8(-1);
    for (ptrdiff_t i = 0; i < depth; i += 64) {
        const __m512i sum = _mm512_loadu_si512(sums + i);
        _mm512_storeu_si512(best_sum + i, _mm512_min_epu8(sum, _mm512_loadu_si512(best_sum + i)));
        minimum = _mm512_min_epu8(minimum, sum);
    }
    const __m256i half = _mm256_min_epu8(_mm512_castsi512_si256(minimum), _mm512_extracti64x4_epi64(minimum, 1));
    const __m128i part = _mm_min_epu8(_mm256_castsi256_si128(half), _mm256_extracti128_si256(half, 1));
    /* The upper byte of each 16 bits becomes 0. */
    const __m128i words = _mm_min_epu8(part, _mm_srli_epi16(part, 8));
    const __m512i least = _mm512_broadcastb_epi8(_mm_minpos_epu16(words));
    int32_t first = 0;
    for (ptrdiff_t i = depth; i > 0;) {
        const uint64_t equal = _mm512_cmpeq_epi8_mask(least, _mm512_loadu_si512(sums + (i -= 64)));
        first = equal ? (int32_t)(i + __builtin_ctzll(equal)) : first;
    }
    return first;
}

#define SELECTION_ROW selection_row_512
static selection_row_fn SELECTION_ROW;
#include "selection.inc"

/* 32 slots fill half a register: nothing to gain. */
void selection_row_avx512(const uint8_t *sums, const int32_t *base, const uint64_t *reference,
                          const uint64_t *target, match_size size, left_right_check check,
                          selection_buffers *buffers, int32_t *offset) {
    (size.depth % 64 ? selection_row_avx2 : selection_row_512)(sums, base, reference, target, size, check, buffers,
                                                               offset);
}
