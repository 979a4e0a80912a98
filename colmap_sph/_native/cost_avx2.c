#include <immintrin.h>
#include <string.h>

#include "rows.h"

/* Hamming distances of one census word to 4 others, one per 64-bit lane. */
static inline __m256i hamming_4(__m256i reference, const uint64_t *target) {
    const __m256i nibble = _mm256_set1_epi8(15);
    const __m256i counts = _mm256_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4, 0, 1, 1, 2, 1, 2, 2, 3,
                                            1, 2, 2, 3, 2, 3, 3, 4);
    const __m256i zero = _mm256_setzero_si256();
    const __m256i word = _mm256_loadu_si256((const __m256i *)target);
    const __m256i difference = _mm256_xor_si256(reference, word);
    const __m256i low = _mm256_shuffle_epi8(counts, _mm256_and_si256(difference, nibble));
    const __m256i high = _mm256_shuffle_epi8(counts, _mm256_and_si256(_mm256_srli_epi16(difference, 4), nibble));
    const __m256i distance = _mm256_sad_epu8(_mm256_add_epi8(low, high), zero);
    const __m256i unseen = _mm256_cmpgt_epi64(zero, word);
    return _mm256_blendv_epi8(distance, _mm256_set1_epi64x(COST_UNSEEN), unseen);
}

static inline __m256i hamming_32(__m256i reference, const uint64_t *target) {
    /* Byte k of 64-bit lane j is slot 4 k + j; two shuffles put the bytes in order. */
    __m256i bytes = hamming_4(reference, target);
#define ADD_FOUR(k) \
    bytes = _mm256_or_si256(bytes, _mm256_slli_epi64(hamming_4(reference, target + 4 * (k)), 8 * (k)))
    ADD_FOUR(1);
    ADD_FOUR(2);
    ADD_FOUR(3);
    ADD_FOUR(4);
    ADD_FOUR(5);
    ADD_FOUR(6);
    ADD_FOUR(7);
#undef ADD_FOUR
    const __m256i interleave = _mm256_setr_epi8(0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15, 0, 8, 1, 9,
                                                2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15);
    bytes = _mm256_shuffle_epi8(bytes, interleave);
    const __m128i low = _mm256_castsi256_si128(bytes), high = _mm256_extracti128_si256(bytes, 1);
    return _mm256_set_m128i(_mm_unpackhi_epi16(low, high), _mm_unpacklo_epi16(low, high));
}

void cost_row_avx2(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                   uint64_t *buffer, uint8_t *cost) {
    uint64_t *row = buffer + size.depth;
    memcpy(row, target, (size_t)size.target_width * sizeof *row);
    for (ptrdiff_t x = 0; x < size.width; x++) {
        uint8_t *slots = cost + x * size.depth;
        if (reference[x] & CENSUS_INVALID) {
            memset(slots, 0, (size_t)size.depth);
            continue;
        }
        const __m256i word = _mm256_set1_epi64x((long long)reference[x]);
        ptrdiff_t first = x + base[x];
        first = first < -size.depth ? -size.depth : first > size.target_width ? size.target_width : first;
        for (ptrdiff_t i = 0; i < size.depth; i += DEPTH_STEP) {
            _mm256_storeu_si256((__m256i *)(slots + i), hamming_32(word, row + first + i));
        }
    }
}
