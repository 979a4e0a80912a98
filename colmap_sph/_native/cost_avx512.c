#include <immintrin.h>

#include <string.h>

#include "rows.h"

/* Distances of a census word to 32 others; COST_UNSEEN where the bit in `seen` is not set. */
static inline __m256i hamming_32(__m512i reference, const uint64_t *target, uint32_t seen) {
#define HAMMING_8(k) _mm512_popcnt_epi64(_mm512_xor_si512(reference, _mm512_loadu_si512(target + 8 * (k))))
    const __m512i a = HAMMING_8(0), b = _mm512_slli_epi64(HAMMING_8(1), 8);
    const __m512i c = _mm512_slli_epi64(HAMMING_8(2), 16), d = _mm512_slli_epi64(HAMMING_8(3), 24);
#undef HAMMING_8
    const __m512i bytes = _mm512_or_si512(_mm512_ternarylogic_epi64(a, b, c, 0xfe), d);
    /* Byte k of 64 bits j is slot 8 k + j. */
    const __m512i order =
        _mm512_castsi256_si512(_mm256_setr_epi8(0, 8, 16, 24, 32, 40, 48, 56, 1, 9, 17, 25, 33, 41, 49, 57, 2, 10,
                                                18, 26, 34, 42, 50, 58, 3, 11, 19, 27, 35, 43, 51, 59));
    const __m256i slots = _mm512_castsi512_si256(_mm512_permutexvar_epi8(order, bytes));
    return _mm256_mask_mov_epi8(_mm256_set1_epi8(COST_UNSEEN), seen, slots);
}

/* The target row to `row`, and a bit for each pixel with content. */
static void copy_row(const uint64_t *target, ptrdiff_t width, uint64_t *row, uint8_t *seen) {
    for (ptrdiff_t r = 0; r < width; r += 8) {
        const __mmask8 there = width - r < 8 ? (__mmask8)((1 << (width - r)) - 1) : 255;
        const __m512i words = _mm512_maskz_loadu_epi64(there, target + r);
        _mm512_mask_storeu_epi64(row + r, there, words);
        seen[r / 8] = there & (uint8_t)~_mm512_movepi64_mask(words);
    }
}

void cost_row_avx512(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                     uint64_t *buffer, uint8_t *cost) {
    uint8_t *seen = (uint8_t *)(buffer + size.target_width + 2 * size.depth);
    copy_row(target, size.target_width, buffer + size.depth, seen + size.depth / 8);
    for (ptrdiff_t x = 0; x < size.width; x++) {
        uint8_t *slots = cost + x * size.depth;
        if (reference[x] & CENSUS_INVALID) {
            memset(slots, 0, (size_t)size.depth);
            continue;
        }
        const __m512i word = _mm512_set1_epi64((long long)reference[x]);
        ptrdiff_t first = x + base[x] + size.depth;
        first = first < 0 ? 0 : first > size.target_width + size.depth ? size.target_width + size.depth : first;
        for (ptrdiff_t i = 0; i < size.depth; i += DEPTH_STEP) {
            uint64_t bits;
            memcpy(&bits, seen + (first + i) / 8, sizeof bits);
            _mm256_storeu_si256((__m256i *)(void *)(slots + i),
                                hamming_32(word, buffer + first + i, (uint32_t)(bits >> first % 8)));
        }
    }
}
