/* The second pass of the vectorised selection over a row, see selection_vector.c: eight winners at once are
 * checked and fitted. */
#include <immintrin.h>

#include "matching/rows.h"

/* subpixel_offset of eight pixels. Quotients are at most 128, with divisors of 8 bits: 32-bit floats round none
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

/* Bytes from memory, where bit mask `there` is set. Four are read at once. */
ALWAYS_INLINE __m256i gather_bytes(const uint8_t *bytes, __m256i place, __m256i there) {
    const int *fours = (const int *)(const void *)bytes;
    const __m256i four =
        _mm256_mask_i32gather_epi32(_mm256_setzero_si256(), fours, _mm256_srli_epi32(place, 2), there, 4);
    const __m256i bits = _mm256_slli_epi32(_mm256_and_si256(place, _mm256_set1_epi32(3)), 3);
    return _mm256_and_si256(_mm256_srlv_epi32(four, bits), _mm256_set1_epi32(UINT8_MAX));
}

/* Where bit mask `there` is set: the target pixels whose sums those of r are checked against, and these sums. */
ALWAYS_INLINE __m256i rivals_of(__m256i r, __m256i there, match_size size, const selection_buffers *buffers,
                                __m256i *sum) {
    const __m256i minus_one = _mm256_set1_epi32(-1), own = _mm256_add_epi32(r, _mm256_set1_epi32((int)size.depth));
    if (!buffers->columns) {
        *sum = gather_bytes(buffers->best_sum, own, there);
        return r;
    }
    const __m256i width = _mm256_set1_epi32((int)size.source_width), none = _mm256_set1_epi32(UINT8_MAX);
    const __m256i column = _mm256_mask_i32gather_epi32(minus_one, buffers->columns, r, there, 4);
    const __m256i inside =
        _mm256_and_si256(_mm256_cmpgt_epi32(column, minus_one), _mm256_cmpgt_epi32(width, column));
    const int *words = (const int *)(const void *)buffers->best;
    const __m256i best = _mm256_mask_i32gather_epi32(minus_one, words, column, inside, 4);
    const __m256i column_sum = _mm256_srli_epi32(best, 24), lacks = _mm256_cmpeq_epi32(column_sum, none);
    *sum = column_sum;
    const __m256i asked = _mm256_and_si256(there, lacks);
    if (!_mm256_testz_si256(asked, asked)) {
        *sum = _mm256_blendv_epi8(column_sum, gather_bytes(buffers->best_sum, own, asked), lacks);
    }
    return _mm256_blendv_epi8(_mm256_and_si256(best, _mm256_set1_epi32(0xffffff)), r, lacks);
}

/* Row entries from `first` on, which may lie before or behind the row where bit mask `there` is not set. */
ALWAYS_INLINE __m256i load_there(const int32_t *row, ptrdiff_t first, __m256i there) {
    return _mm256_maskload_epi32((const int *)((uintptr_t)row + (uintptr_t)first * sizeof *row), there);
}

/* Of the pixels `asked`, which lie from `column` on in the row: those of which the pixel `step` beside them has
 * target pixel r for `best_sum`. */
static inline __m256i agrees(const uint8_t *sums, const int32_t *base, match_size size, const int32_t *winner,
                             __m256i column, int32_t step, __m256i r, __m256i best_sum, __m256i asked) {
    const __m256i minus_one = _mm256_set1_epi32(-1), depth = _mm256_set1_epi32((int)size.depth);
    const __m256i width = _mm256_set1_epi32((int)size.width);
    const __m256i near = _mm256_add_epi32(column, _mm256_set1_epi32(step));
    const __m256i inside = _mm256_and_si256(_mm256_cmpgt_epi32(near, minus_one), _mm256_cmpgt_epi32(width, near));
    const ptrdiff_t first = _mm256_cvtsi256_si32(near);
    const __m256i content = _mm256_cmpgt_epi32(load_there(winner, first, inside), minus_one);
    /* Beyond 32 bits this wraps round, to what is no slot, too. */
    const __m256i slot = _mm256_sub_epi32(_mm256_sub_epi32(r, near), load_there(base, first, inside));
    const __m256i is_slot = _mm256_and_si256(_mm256_cmpgt_epi32(slot, minus_one), _mm256_cmpgt_epi32(depth, slot));
    const __m256i there = _mm256_and_si256(_mm256_and_si256(asked, inside), _mm256_and_si256(content, is_slot));
    const __m256i sum = gather_bytes(sums, _mm256_add_epi32(_mm256_mullo_epi32(near, depth), slot), there);
    return _mm256_and_si256(there, _mm256_cmpeq_epi32(sum, best_sum));
}

/* Pixels x to x + 7 of the row, those that `there` says. */
static inline void check_eight(const uint8_t *sums, const int32_t *base, const uint64_t *target, match_size size,
                               left_right_check check, const selection_buffers *buffers, int32_t x, __m256i there,
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
    if (_mm256_testz_si256(found, found)) {
        _mm256_maskstore_epi32(offset + x, there, _mm256_set1_epi32(OFFSET_INVALID));
        return;
    }

    /* The winner's sum between those beside it, with one byte more behind them or, at the row's end, before them.
     */
    const __m256i from = _mm256_add_epi32(_mm256_mullo_epi32(column, depth), _mm256_add_epi32(best, minus_one));
    const __m256i place = _mm256_min_epi32(from, _mm256_set1_epi32((int)(size.width * size.depth) - 4));
    const __m256i four = _mm256_mask_i32gather_epi32(zero, (const int *)(const void *)sums, place, found, 1);
    const __m256i three = _mm256_srlv_epi32(four, _mm256_slli_epi32(_mm256_sub_epi32(from, place), 3));
    const __m256i byte = _mm256_set1_epi32(UINT8_MAX), before = _mm256_and_si256(three, byte);
    const __m256i sum = _mm256_and_si256(_mm256_srli_epi32(three, 8), byte);
    const __m256i after = _mm256_and_si256(_mm256_srli_epi32(three, 16), byte);

    __m256i best_sum;
    const __m256i rival = rivals_of(r, found, size, buffers, &best_sum);
    const __m256i excess = _mm256_sub_epi32(sum, best_sum);
    __m256i mutual = _mm256_andnot_si256(_mm256_cmpgt_epi32(excess, _mm256_set1_epi32(check.max_excess)), found);
    for (int32_t step = 1; step <= check.max_difference && step < (int32_t)size.width; step++) {
        const __m256i left = _mm256_andnot_si256(mutual, found);
        if (_mm256_testz_si256(left, left)) {
            break;
        }
        mutual = _mm256_or_si256(mutual,
                                 agrees(sums, base, size, buffers->winner, column, -step, rival, best_sum, left));
        mutual = _mm256_or_si256(mutual,
                                 agrees(sums, base, size, buffers->winner, column, step, rival, best_sum, left));
    }
    found = mutual;

    const __m256i subpixel = subpixel_offsets(before, sum, after);
    const __m256i result = _mm256_blendv_epi8(_mm256_set1_epi32(OFFSET_INVALID),
                                              _mm256_add_epi32(_mm256_slli_epi32(position, 8), subpixel), found);
    _mm256_maskstore_epi32(offset + x, there, result);
}

void check_winners_avx2(const uint8_t *sums, const int32_t *base, const uint64_t *target, match_size size,
                        left_right_check check, const selection_buffers *buffers, int32_t *offset) {
    for (int32_t x = 0; x < (int32_t)size.width; x += 8) {
        const __m256i left = _mm256_set1_epi32((int)size.width - x);
        const __m256i there = _mm256_cmpgt_epi32(left, _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
        check_eight(sums, base, target, size, check, buffers, x, there, offset);
    }
}
