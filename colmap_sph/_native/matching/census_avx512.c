#include <immintrin.h>

#include "matching/census_blocks.h"
#include "version.h"

enum { LANES = 32, PARTS = 4 };

/* 16-bit parts of 32 words, the lowest first, become words. */
static inline void store_words(const __m512i parts[PARTS], uint64_t *words) {
    const __m512i low[2] = {_mm512_unpacklo_epi16(parts[0], parts[1]), _mm512_unpacklo_epi16(parts[2], parts[3])};
    const __m512i high[2] = {_mm512_unpackhi_epi16(parts[0], parts[1]), _mm512_unpackhi_epi16(parts[2], parts[3])};
    /* Two words of each eight, side by side. */
    const __m512i two[4] = {_mm512_unpacklo_epi32(low[0], low[1]), _mm512_unpackhi_epi32(low[0], low[1]),
                            _mm512_unpacklo_epi32(high[0], high[1]), _mm512_unpackhi_epi32(high[0], high[1])};
    for (int k = 0; k < 4; k++, words += 2) {
        _mm_storeu_si128((__m128i *)(void *)words, _mm512_castsi512_si128(two[k]));
        _mm_storeu_si128((__m128i *)(void *)(words + 8), _mm512_extracti32x4_epi32(two[k], 1));
        _mm_storeu_si128((__m128i *)(void *)(words + 16), _mm512_extracti32x4_epi32(two[k], 2));
        _mm_storeu_si128((__m128i *)(void *)(words + 24), _mm512_extracti32x4_epi32(two[k], 3));
    }
}

static inline void census_32_pixels(const int16_t *window, ptrdiff_t stride, uint64_t *words) {
    const int16_t *middle = window + CENSUS_RADIUS_Y * stride + CENSUS_RADIUS_X;
    /* Nothing is darker than the number at which this saturates. */
    const __m512i limit = _mm512_subs_epi16(_mm512_loadu_si512(middle), _mm512_set1_epi16(CENSUS_MARGIN));
    __m512i parts[PARTS];
    for (int k = 0; k < PARTS; k++) {
        parts[k] = _mm512_setzero_si512();
    }
    int bit = 0;
#pragma GCC unroll 7
    for (int dy = 0; dy <= 2 * CENSUS_RADIUS_Y; dy++) {
#pragma GCC unroll 9
        for (int dx = 0; dx <= 2 * CENSUS_RADIUS_X; dx++) {
            if (dy == CENSUS_RADIUS_Y && dx == CENSUS_RADIUS_X) {
                continue;
            }
            const __mmask32 darker = _mm512_cmpgt_epi16_mask(limit, _mm512_loadu_si512(window + dy * stride + dx));
            __m512i *part = &parts[bit / 16];
            *part = _mm512_mask_add_epi16(*part, darker, *part, _mm512_set1_epi16((short)(1 << bit % 16)));
            bit++;
        }
    }
    store_words(parts, words);
}

void VERSION_OF(census)(census_image image, ptrdiff_t stride, uint64_t *census) {
    census_in_blocks(census_32_pixels, LANES, image, stride, census);
}
