/* The AVX-512 version of aggregation_scalar.c: 64 slots of 8 bits per register. */
#include <immintrin.h>

#include "rows.h"

#define ALWAYS_INLINE static inline __attribute__((always_inline))
#define BYTES 64

typedef __m512i vector;

ALWAYS_INLINE vector load(const uint8_t *p) { return _mm512_loadu_si512(p); }
ALWAYS_INLINE void store(uint8_t *p, vector v) { _mm512_storeu_si512(p, v); }
ALWAYS_INLINE vector repeat_byte(int byte) { return _mm512_set1_epi8((char)byte); }
ALWAYS_INLINE vector repeat_word(uint32_t word) { return _mm512_set1_epi32((int)word); }
ALWAYS_INLINE vector repeat_lowest(__m128i v) { return _mm512_broadcastb_epi8(v); }
ALWAYS_INLINE vector lesser(vector a, vector b) { return _mm512_min_epu8(a, b); }
ALWAYS_INLINE vector add(vector a, vector b) { return _mm512_add_epi8(a, b); }
ALWAYS_INLINE vector add_saturated(vector a, vector b) { return _mm512_adds_epu8(a, b); }
ALWAYS_INLINE vector subtract(vector a, vector b) { return _mm512_sub_epi8(a, b); }

/* The last byte of `before` and all but the last of `v`. */
ALWAYS_INLINE vector one_up(vector before, vector v) {
    return _mm512_alignr_epi8(v, _mm512_alignr_epi32(v, before, 12), 15);
}

/* All but the first byte of `v` and the first of `after`. */
ALWAYS_INLINE vector one_down(vector v, vector after) {
    return _mm512_alignr_epi8(_mm512_alignr_epi32(after, v, 4), v, 1);
}

/* The least byte, in the lowest byte. */
ALWAYS_INLINE __m128i horizontal_min(vector v) {
    const __m256i half = _mm256_min_epu8(_mm512_castsi512_si256(v), _mm512_extracti64x4_epi64(v, 1));
    const __m128i m = _mm_min_epu8(_mm256_castsi256_si128(half), _mm256_extracti128_si256(half, 1));
    /* The upper byte of each 16 bits becomes 0. */
    return _mm_minpos_epu16(_mm_min_epu8(m, _mm_srli_epi16(m, 8)));
}

/* out[0..63] = a + b + c + d (+ in[0..63]), 8 bits to 16. */
ALWAYS_INLINE void add_paths(int add_in, const uint16_t *in, uint16_t *out, vector a, vector b, vector c,
                             vector d) {
    const vector ones = _mm512_set1_epi8(1);
    const vector low = _mm512_add_epi16(_mm512_maddubs_epi16(_mm512_unpacklo_epi8(a, b), ones),
                                        _mm512_maddubs_epi16(_mm512_unpacklo_epi8(c, d), ones));
    const vector high = _mm512_add_epi16(_mm512_maddubs_epi16(_mm512_unpackhi_epi8(a, b), ones),
                                         _mm512_maddubs_epi16(_mm512_unpackhi_epi8(c, d), ones));
    vector first = _mm512_permutex2var_epi64(low, _mm512_setr_epi64(0, 1, 8, 9, 2, 3, 10, 11), high);
    vector second = _mm512_permutex2var_epi64(low, _mm512_setr_epi64(4, 5, 12, 13, 6, 7, 14, 15), high);
    if (add_in) {
        first = _mm512_add_epi16(first, _mm512_loadu_si512(in));
        second = _mm512_add_epi16(second, _mm512_loadu_si512(in + 32));
    }
    _mm512_storeu_si512(out, first);
    _mm512_storeu_si512(out + 32, second);
}

#define SWEEP_BEGIN sweep_begin_512
#define SWEEP_ROWS sweep_rows_512
static sweep_begin_fn SWEEP_BEGIN;
static sweep_rows_fn SWEEP_ROWS;
#include "aggregation.inc"

int sweep_begin_avx512(sweep_state *state, const int32_t *base, const uint8_t *image, match_size size,
                       path_penalties penalties, int backward) {
    return (size.depth % BYTES ? sweep_begin_avx2 : sweep_begin_512)(state, base, image, size, penalties,
                                                                     backward);
}

/* 32 slots fill half a register: nothing to gain. */
void sweep_rows_avx512(sweep_state *s, ptrdiff_t y, ptrdiff_t rows, const uint8_t *cost, const uint16_t *sums_in,
                       uint16_t *sums_out) {
    (s->size.depth % BYTES ? sweep_rows_avx2 : sweep_rows_512)(s, y, rows, cost, sums_in, sums_out);
}
