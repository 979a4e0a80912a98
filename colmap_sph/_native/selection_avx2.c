/* The AVX2 version of selection_scalar.c. A first pass over the sums finds each pixel's winner, and the keys of
 * the target pixels, those in even and in odd places apart: then one instruction makes eight keys of sixteen sums.
 * A second pass checks and refines eight winners at once. */
#include <immintrin.h>

#include "rows.h"

#define ALWAYS_INLINE static inline __attribute__((always_inline))

/* Eight times the lesser key. */
ALWAYS_INLINE void keep_lesser(uint32_t *keys, __m256i new_keys) {
    __m256i *place = (__m256i *)(void *)keys;
    _mm256_storeu_si256(place, _mm256_min_epu32(new_keys, _mm256_loadu_si256(place)));
}

/* One pixel's sums against the best so far of the target pixels they point at: sums 0, 2, ... against `even` and
 * those between against `odd`. */
ALWAYS_INLINE void match_target_pixels(const uint16_t *sums, ptrdiff_t x, ptrdiff_t depth, uint32_t *even,
                                       uint32_t *odd) {
    const __m256i column = _mm256_set1_epi32((int)x);
    for (ptrdiff_t i = 0; i < depth; i += 16) {
        const __m256i sum = _mm256_loadu_si256((const __m256i *)(sums + i));
        keep_lesser(even + i / 2, _mm256_or_si256(_mm256_slli_epi32(sum, 16), column));
        keep_lesser(odd + i / 2, _mm256_blend_epi16(sum, column, 0x55));
    }
}

/* A bit for each of 32 sums that equals `least`. */
ALWAYS_INLINE uint32_t equal_32(const uint16_t *sums, __m256i least) {
    const __m256i first = _mm256_cmpeq_epi16(least, _mm256_loadu_si256((const __m256i *)sums));
    const __m256i second = _mm256_cmpeq_epi16(least, _mm256_loadu_si256((const __m256i *)(sums + 16)));
    /* packs works on halves: their middle quarters must change places. */
    const __m256i bytes = _mm256_permute4x64_epi64(_mm256_packs_epi16(first, second), 0xd8);
    return (uint32_t)_mm256_movemask_epi8(bytes);
}

/* Without branches: where the minimum lies is hard to predict. */
ALWAYS_INLINE int32_t first_minimum(const uint16_t *sums, ptrdiff_t depth) {
    __m256i minimum = _mm256_loadu_si256((const __m256i *)sums);
    for (ptrdiff_t i = 16; i < depth; i += 16) {
        minimum = _mm256_min_epu16(minimum, _mm256_loadu_si256((const __m256i *)(sums + i)));
    }
    const __m128i half = _mm_min_epu16(_mm256_castsi256_si128(minimum), _mm256_extracti128_si256(minimum, 1));
    const __m256i least = _mm256_broadcastw_epi16(_mm_minpos_epu16(half));
    int32_t first = 0;
    for (ptrdiff_t i = depth; i > 0;) {
        uint64_t equal = equal_32(sums + (i -= 32), least);
        if (depth % 64 == 0) {
            equal = equal << 32 | equal_32(sums + (i -= 32), least);
        }
        first = equal ? (int32_t)(i + __builtin_ctzll(equal)) : first;
    }
    return first;
}

/* subpixel_offset of eight pixels. Quotients are at most 128, with divisors of 16 bits: 32-bit floats round none
 * of them up to the next whole number. */
ALWAYS_INLINE __m256i subpixel_offsets(__m256i before, __m256i best, __m256i after) {
    const __m256i rise = _mm256_sub_epi32(_mm256_max_epi32(before, after), best);
    const __m256i difference = _mm256_slli_epi32(_mm256_sub_epi32(before, after), 7);
    const __m256i offset =
        _mm256_cvttps_epi32(_mm256_div_ps(_mm256_cvtepi32_ps(difference), _mm256_cvtepi32_ps(rise)));
    const __m256i zero = _mm256_setzero_si256();
    return _mm256_and_si256(offset,
                            _mm256_and_si256(_mm256_cmpgt_epi32(rise, zero), _mm256_cmpgt_epi32(best, zero)));
}

/* Pixels x to x + 7 of the row, those that `there` says. */
static inline void check_eight(const uint16_t *sums, const int32_t *base, const uint64_t *target, match_size size,
                               int32_t max_difference, const selection_buffers *buffers, int32_t x, __m256i there,
                               int32_t *offset) {
    const __m256i zero = _mm256_setzero_si256(), minus_one = _mm256_set1_epi32(-1);
    const __m256i depth = _mm256_set1_epi32((int)size.depth), width = _mm256_set1_epi32((int)size.target_width);
    const __m256i column = _mm256_add_epi32(_mm256_set1_epi32(x), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
    const __m256i best = _mm256_maskload_epi32(buffers->winner + x, there);
    const __m256i position = _mm256_add_epi32(_mm256_maskload_epi32(base + x, there), best);
    /* Beyond 32 bits this wraps round, to what is outside the row, too. */
    const __m256i r = _mm256_add_epi32(column, position);
    /* At the end of the range the true minimum may lie beyond it. */
    __m256i found = _mm256_and_si256(_mm256_cmpgt_epi32(best, zero),
                                     _mm256_cmpgt_epi32(_mm256_add_epi32(depth, minus_one), best));
    found =
        _mm256_and_si256(found, _mm256_and_si256(_mm256_cmpgt_epi32(r, minus_one), _mm256_cmpgt_epi32(width, r)));
    const __m256i content =
        _mm256_mask_i32gather_epi32(minus_one, (const int *)(const void *)target + 1, r, found, 8);
    found = _mm256_andnot_si256(_mm256_cmpgt_epi32(zero, content), found);

    const __m256i key_place = _mm256_add_epi32(r, depth);
    const int half = (int)keys_per_parity(size);
    const __m256i odd = _mm256_and_si256(_mm256_sub_epi32(zero, _mm256_and_si256(key_place, _mm256_set1_epi32(1))),
                                         _mm256_set1_epi32(half));
    const __m256i keys = _mm256_mask_i32gather_epi32(
        zero, (const int *)buffers->keys, _mm256_add_epi32(_mm256_srli_epi32(key_place, 1), odd), found, 4);
    const __m256i apart =
        _mm256_abs_epi32(_mm256_sub_epi32(_mm256_and_si256(keys, _mm256_set1_epi32(UINT16_MAX)), column));
    const __m256i unmatched = _mm256_cmpeq_epi32(_mm256_max_epu32(keys, _mm256_set1_epi32((int)NO_KEY)), keys);
    const __m256i rejected =
        _mm256_or_si256(unmatched, _mm256_cmpgt_epi32(apart, _mm256_set1_epi32(max_difference)));
    found = _mm256_andnot_si256(rejected, found);

    const __m256i slot = _mm256_add_epi32(_mm256_mullo_epi32(column, depth), best);
    const int *pairs = (const int *)(const void *)sums;
    const __m256i upto = _mm256_mask_i32gather_epi32(zero, pairs, _mm256_add_epi32(slot, minus_one), found, 2);
    const __m256i from = _mm256_mask_i32gather_epi32(zero, pairs, slot, found, 2);
    const __m256i subpixel = subpixel_offsets(_mm256_and_si256(upto, _mm256_set1_epi32(UINT16_MAX)),
                                              _mm256_srli_epi32(upto, 16), _mm256_srli_epi32(from, 16));
    const __m256i result = _mm256_blendv_epi8(_mm256_set1_epi32(OFFSET_INVALID),
                                              _mm256_add_epi32(_mm256_slli_epi32(position, 8), subpixel), found);
    _mm256_maskstore_epi32(offset + x, there, result);
}

void check_winners_avx2(const uint16_t *sums, const int32_t *base, const uint64_t *target, match_size size,
                        int32_t max_left_right_difference, const selection_buffers *buffers, int32_t *offset) {
    for (int32_t x = 0; x < (int32_t)size.width; x += 8) {
        const __m256i left = _mm256_set1_epi32((int)size.width - x);
        const __m256i there = _mm256_cmpgt_epi32(left, _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
        check_eight(sums, base, target, size, max_left_right_difference, buffers, x, there, offset);
    }
}

#define SELECTION_ROW selection_row_avx2
#include "selection.inc"
