/* The AVX2 version of aggregation_scalar.c: 32 slots of 8 bits per register. */
#include <immintrin.h>

#include "rows.h"

#define ALWAYS_INLINE static inline __attribute__((always_inline))
#define BYTES 32

typedef __m256i vector;

ALWAYS_INLINE vector load(const uint8_t *p) { return _mm256_loadu_si256((const vector *)(const void *)p); }
ALWAYS_INLINE void store(uint8_t *p, vector v) { _mm256_storeu_si256((vector *)(void *)p, v); }
ALWAYS_INLINE vector repeat_byte(int byte) { return _mm256_set1_epi8((char)byte); }
ALWAYS_INLINE vector repeat_word(uint32_t word) { return _mm256_set1_epi32((int)word); }
ALWAYS_INLINE vector repeat_lowest(__m128i v) { return _mm256_broadcastb_epi8(v); }
ALWAYS_INLINE vector lesser(vector a, vector b) { return _mm256_min_epu8(a, b); }
ALWAYS_INLINE vector add(vector a, vector b) { return _mm256_add_epi8(a, b); }
ALWAYS_INLINE vector add_saturated(vector a, vector b) { return _mm256_adds_epu8(a, b); }
ALWAYS_INLINE vector subtract(vector a, vector b) { return _mm256_sub_epi8(a, b); }

/* The last byte of `before` and all but the last of `v`. */
ALWAYS_INLINE vector one_up(vector before, vector v) {
    return _mm256_alignr_epi8(v, _mm256_permute2x128_si256(before, v, 0x21), 15);
}

/* All but the first byte of `v` and the first of `after`. */
ALWAYS_INLINE vector one_down(vector v, vector after) {
    return _mm256_alignr_epi8(_mm256_permute2x128_si256(v, after, 0x21), v, 1);
}

/* The least byte, in the lowest byte. */
ALWAYS_INLINE __m128i horizontal_min(vector v) {
    const __m128i m = _mm_min_epu8(_mm256_castsi256_si128(v), _mm256_extracti128_si256(v, 1));
    /* The upper byte of each 16 bits becomes 0. */
    return _mm_minpos_epu16(_mm_min_epu8(m, _mm_srli_epi16(m, 8)));
}

/* out[0..31] = a + b + c + d (+ in[0..31]), 8 bits to 16. */
ALWAYS_INLINE void add_paths(int add_in, const uint16_t *in, uint16_t *out, vector a, vector b, vector c,
                             vector d) {
    const vector ones = _mm256_set1_epi8(1);
    const vector low = _mm256_add_epi16(_mm256_maddubs_epi16(_mm256_unpacklo_epi8(a, b), ones),
                                        _mm256_maddubs_epi16(_mm256_unpacklo_epi8(c, d), ones));
    const vector high = _mm256_add_epi16(_mm256_maddubs_epi16(_mm256_unpackhi_epi8(a, b), ones),
                                         _mm256_maddubs_epi16(_mm256_unpackhi_epi8(c, d), ones));
    vector first = _mm256_permute2x128_si256(low, high, 0x20);
    vector second = _mm256_permute2x128_si256(low, high, 0x31);
    if (add_in) {
        first = _mm256_add_epi16(first, _mm256_loadu_si256((const vector *)(const void *)in));
        second = _mm256_add_epi16(second, _mm256_loadu_si256((const vector *)(const void *)(in + 16)));
    }
    _mm256_storeu_si256((vector *)(void *)out, first);
    _mm256_storeu_si256((vector *)(void *)(out + 16), second);
}

#define SWEEP_BEGIN sweep_begin_avx2
#define SWEEP_ROWS sweep_rows_avx2
#include "aggregation.inc"
