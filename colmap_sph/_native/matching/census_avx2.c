#include <immintrin.h>

#include "matching/census_blocks.h"

enum { LANES = 32 };

/* Bytes b[k][i] (comparison byte k of 32 pixels) become words b[0][i] | b[1][i] << 8 | ..., each at its pixel:
 * packing 16-bit numbers has put pixels 8 to 15 behind 16 to 23. */
static void store_words(const __m256i bytes[8], uint64_t *words) {
    for (int high = 0; high < 2; high++) {
        __m256i pair[4], quad[4];
        for (int k = 0; k < 4; k++) {
            pair[k] = high ? _mm256_unpackhi_epi8(bytes[2 * k], bytes[2 * k + 1])
                           : _mm256_unpacklo_epi8(bytes[2 * k], bytes[2 * k + 1]);
        }
        quad[0] = _mm256_unpacklo_epi16(pair[0], pair[1]);
        quad[1] = _mm256_unpackhi_epi16(pair[0], pair[1]);
        quad[2] = _mm256_unpacklo_epi16(pair[2], pair[3]);
        quad[3] = _mm256_unpackhi_epi16(pair[2], pair[3]);
        for (int k = 0; k < 2; k++) {
            const __m256i first = _mm256_unpacklo_epi32(quad[k], quad[k + 2]);
            const __m256i second = _mm256_unpackhi_epi32(quad[k], quad[k + 2]);
            uint64_t *low = words + 16 * high + 4 * k;
            _mm_storeu_si128((__m128i *)low, _mm256_castsi256_si128(first));
            _mm_storeu_si128((__m128i *)(low + 2), _mm256_castsi256_si128(second));
            _mm_storeu_si128((__m128i *)(low + 8), _mm256_extracti128_si256(first, 1));
            _mm_storeu_si128((__m128i *)(low + 10), _mm256_extracti128_si256(second, 1));
        }
    }
}

static inline void census_32_pixels(const int16_t *window, ptrdiff_t stride, uint64_t *words) {
    const int16_t *middle = window + CENSUS_RADIUS_Y * stride + CENSUS_RADIUS_X;
    const __m256i margin = _mm256_set1_epi16(CENSUS_MARGIN);
    /* Nothing is darker than the number at which this saturates. */
    const __m256i limit = _mm256_subs_epi16(_mm256_loadu_si256((const __m256i *)middle), margin),
                  next_limit = _mm256_subs_epi16(_mm256_loadu_si256((const __m256i *)(middle + 16)), margin);
    __m256i bytes[8];
    int bit = 0;
    for (int k = 0; k < 8; k++) {
        bytes[k] = _mm256_setzero_si256();
    }
    /* Unrolled, as gcc keeps `bytes` in memory else. */
#pragma GCC unroll 7
    for (int dy = 0; dy <= 2 * CENSUS_RADIUS_Y; dy++) {
#pragma GCC unroll 9
        for (int dx = 0; dx <= 2 * CENSUS_RADIUS_X; dx++) {
            if (dy == CENSUS_RADIUS_Y && dx == CENSUS_RADIUS_X) {
                continue;
            }
            const int16_t *neighbour = window + dy * stride + dx;
            const __m256i darker = _mm256_packs_epi16(
                _mm256_cmpgt_epi16(limit, _mm256_loadu_si256((const __m256i *)neighbour)),
                _mm256_cmpgt_epi16(next_limit, _mm256_loadu_si256((const __m256i *)(neighbour + 16))));
            const __m256i flag = _mm256_set1_epi8((char)(1 << (bit & 7)));
            bytes[bit >> 3] = _mm256_or_si256(bytes[bit >> 3], _mm256_and_si256(darker, flag));
            bit++;
        }
    }
    store_words(bytes, words);
}

void census_avx2(census_image image, ptrdiff_t stride, uint64_t *census) {
    census_in_blocks(census_32_pixels, LANES, image, stride, census);
}
