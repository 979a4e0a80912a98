/* What aggregation_vector.c does with a register of slots: 32 of them with AVX2, 64 with AVX-512, 16 with NEON. */
#ifndef COLMAP_SPH_AGGREGATION_VECTOR_H
#define COLMAP_SPH_AGGREGATION_VECTOR_H

#ifdef __aarch64__
#include <arm_neon.h>
#else
#include <immintrin.h>
#endif

#include "common.h"

#ifdef __aarch64__

#define BYTES 16

typedef uint8x16_t vector;

ALWAYS_INLINE vector load(const uint8_t *p) { return vld1q_u8(p); }
ALWAYS_INLINE void store(uint8_t *p, vector v) { vst1q_u8(p, v); }
ALWAYS_INLINE vector repeat_byte(int byte) { return vdupq_n_u8((uint8_t)byte); }
ALWAYS_INLINE vector repeat_word(uint32_t word) { return vreinterpretq_u8_u32(vdupq_n_u32(word)); }
ALWAYS_INLINE vector lesser(vector a, vector b) { return vminq_u8(a, b); }
ALWAYS_INLINE vector add(vector a, vector b) { return vaddq_u8(a, b); }
ALWAYS_INLINE vector add_saturated(vector a, vector b) { return vqaddq_u8(a, b); }
ALWAYS_INLINE vector average(vector a, vector b) { return vrhaddq_u8(a, b); }
ALWAYS_INLINE vector subtract(vector a, vector b) { return vsubq_u8(a, b); }

/* The last byte of `before` and all but the last of `v`. */
ALWAYS_INLINE vector one_up(vector before, vector v) { return vextq_u8(before, v, 15); }

/* All but the first byte of `v` and the first of `after`. */
ALWAYS_INLINE vector one_down(vector v, vector after) { return vextq_u8(v, after, 1); }

/* The least byte of each of four vectors, in all of its bytes. */
ALWAYS_INLINE void spread_minima(vector v[4]) {
    for (int k = 0; k < 4; k++) {
        v[k] = vdupq_n_u8(vminvq_u8(v[k]));
    }
}

#else

#define SWAP_WORDS _mm_setr_epi8(2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13)
#define SWAP_BYTES _mm_setr_epi8(1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14)

#ifndef __AVX512F__ /* the same, with AVX2 */

#define BYTES 32

typedef __m256i vector;

ALWAYS_INLINE vector load(const uint8_t *p) { return _mm256_loadu_si256((const vector *)(const void *)p); }
ALWAYS_INLINE void store(uint8_t *p, vector v) { _mm256_storeu_si256((vector *)(void *)p, v); }
ALWAYS_INLINE vector repeat_byte(int byte) { return _mm256_set1_epi8((char)byte); }
ALWAYS_INLINE vector repeat_word(uint32_t word) { return _mm256_set1_epi32((int)word); }
ALWAYS_INLINE vector lesser(vector a, vector b) { return _mm256_min_epu8(a, b); }
ALWAYS_INLINE vector add(vector a, vector b) { return _mm256_add_epi8(a, b); }
ALWAYS_INLINE vector add_saturated(vector a, vector b) { return _mm256_adds_epu8(a, b); }
ALWAYS_INLINE vector average(vector a, vector b) { return _mm256_avg_epu8(a, b); }
ALWAYS_INLINE vector subtract(vector a, vector b) { return _mm256_sub_epi8(a, b); }

ALWAYS_INLINE vector one_up(vector before, vector v) {
    return _mm256_alignr_epi8(v, _mm256_permute2x128_si256(before, v, 0x21), 15);
}

ALWAYS_INLINE vector one_down(vector v, vector after) {
    return _mm256_alignr_epi8(_mm256_permute2x128_si256(v, after, 0x21), v, 1);
}

ALWAYS_INLINE void spread_minima(vector v[4]) {
    /* Halves of two vectors each, then quarters of all four; these swap what they have found until all have it.
     * Shuffles, since the units for shifts are busy with minima. */
    const vector a =
        lesser(_mm256_permute2x128_si256(v[0], v[1], 0x20), _mm256_permute2x128_si256(v[0], v[1], 0x31));
    const vector b =
        lesser(_mm256_permute2x128_si256(v[2], v[3], 0x20), _mm256_permute2x128_si256(v[2], v[3], 0x31));
    vector m = lesser(_mm256_unpacklo_epi64(a, b), _mm256_unpackhi_epi64(a, b));
    m = lesser(m, _mm256_shuffle_epi32(m, 0xb1));
    m = lesser(m, _mm256_shuffle_epi8(m, _mm256_broadcastsi128_si256(SWAP_WORDS)));
    m = lesser(m, _mm256_shuffle_epi8(m, _mm256_broadcastsi128_si256(SWAP_BYTES)));
    v[0] = _mm256_permute4x64_epi64(m, 0x00);
    v[1] = _mm256_permute4x64_epi64(m, 0xaa);
    v[2] = _mm256_permute4x64_epi64(m, 0x55);
    v[3] = _mm256_permute4x64_epi64(m, 0xff);
}

#else /* the same, with AVX-512 */

#define BYTES 64

typedef __m512i vector;

ALWAYS_INLINE vector load(const uint8_t *p) { return _mm512_loadu_si512(p); }
ALWAYS_INLINE void store(uint8_t *p, vector v) { _mm512_storeu_si512(p, v); }
ALWAYS_INLINE vector repeat_byte(int byte) { return _mm512_set1_epi8((char)byte); }
ALWAYS_INLINE vector repeat_word(uint32_t word) { return _mm512_set1_epi32((int)word); }
ALWAYS_INLINE vector lesser(vector a, vector b) { return _mm512_min_epu8(a, b); }
ALWAYS_INLINE vector add(vector a, vector b) { return _mm512_add_epi8(a, b); }
ALWAYS_INLINE vector add_saturated(vector a, vector b) { return _mm512_adds_epu8(a, b); }
ALWAYS_INLINE vector average(vector a, vector b) { return _mm512_avg_epu8(a, b); }
ALWAYS_INLINE vector subtract(vector a, vector b) { return _mm512_sub_epi8(a, b); }

ALWAYS_INLINE vector one_up(vector before, vector v) {
    return _mm512_alignr_epi8(v, _mm512_alignr_epi32(v, before, 12), 15);
}

ALWAYS_INLINE vector one_down(vector v, vector after) {
    return _mm512_alignr_epi8(_mm512_alignr_epi32(after, v, 4), v, 1);
}

ALWAYS_INLINE void spread_minima(vector v[4]) {
    const vector a = lesser(_mm512_shuffle_i64x2(v[0], v[1], 0x44), _mm512_shuffle_i64x2(v[0], v[1], 0xee));
    const vector b = lesser(_mm512_shuffle_i64x2(v[2], v[3], 0x44), _mm512_shuffle_i64x2(v[2], v[3], 0xee));
    vector m = lesser(_mm512_shuffle_i64x2(a, b, 0x88), _mm512_shuffle_i64x2(a, b, 0xdd));
    m = lesser(m, _mm512_shuffle_epi32(m, 0x4e));
    m = lesser(m, _mm512_shuffle_epi32(m, 0xb1));
    m = lesser(m, _mm512_shuffle_epi8(m, _mm512_broadcast_i32x4(SWAP_WORDS)));
    m = lesser(m, _mm512_shuffle_epi8(m, _mm512_broadcast_i32x4(SWAP_BYTES)));
    v[0] = _mm512_shuffle_i64x2(m, m, 0x00);
    v[1] = _mm512_shuffle_i64x2(m, m, 0x55);
    v[2] = _mm512_shuffle_i64x2(m, m, 0xaa);
    v[3] = _mm512_shuffle_i64x2(m, m, 0xff);
}

#endif

#endif

#endif
