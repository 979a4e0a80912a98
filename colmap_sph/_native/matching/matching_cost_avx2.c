/* The AVX2 version of matching_cost_scalar.c: the target row's words are taken apart into 16 planes of 4 bits, in
 * bytes. Then one shuffle looks up the distances of 4 bits of the reference's word to those of 32 target pixels.
 */
#include <immintrin.h>

#include <string.h>

#include "matching/rows.h"

enum { PLANES = 16, LOOKS_UP_ZERO = 128 };

#define HIGH_BITS UINT64_C(0xf0f0f0f0f0f0f0f0)

/* Number of bits in which two numbers differ. */
static const uint8_t DISTANCES[16][16] = {
    {0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4}, {1, 0, 2, 1, 2, 1, 3, 2, 2, 1, 3, 2, 3, 2, 4, 3},
    {1, 2, 0, 1, 2, 3, 1, 2, 2, 3, 1, 2, 3, 4, 2, 3}, {2, 1, 1, 0, 3, 2, 2, 1, 3, 2, 2, 1, 4, 3, 3, 2},
    {1, 2, 2, 3, 0, 1, 1, 2, 2, 3, 3, 4, 1, 2, 2, 3}, {2, 1, 3, 2, 1, 0, 2, 1, 3, 2, 4, 3, 2, 1, 3, 2},
    {2, 3, 1, 2, 1, 2, 0, 1, 3, 4, 2, 3, 2, 3, 1, 2}, {3, 2, 2, 1, 2, 1, 1, 0, 4, 3, 3, 2, 3, 2, 2, 1},
    {1, 2, 2, 3, 2, 3, 3, 4, 0, 1, 1, 2, 1, 2, 2, 3}, {2, 1, 3, 2, 3, 2, 4, 3, 1, 0, 2, 1, 2, 1, 3, 2},
    {2, 3, 1, 2, 3, 4, 2, 3, 1, 2, 0, 1, 2, 3, 1, 2}, {3, 2, 2, 1, 4, 3, 3, 2, 2, 1, 1, 0, 3, 2, 2, 1},
    {2, 3, 3, 4, 1, 2, 2, 3, 1, 2, 2, 3, 0, 1, 1, 2}, {3, 2, 4, 3, 2, 1, 3, 2, 2, 1, 3, 2, 1, 0, 2, 1},
    {3, 4, 2, 3, 2, 3, 1, 2, 2, 3, 1, 2, 1, 2, 0, 1}, {4, 3, 3, 2, 3, 2, 2, 1, 3, 2, 2, 1, 2, 1, 1, 0}};

/* A plane's bytes: an odd number of lines of the cache, so that planes do not take each other's places in it. */
static ptrdiff_t plane_stride(match_size size) {
    return (((size.target_width + 2 * size.depth) / 64 + 1) | 1) * 64;
}

/* Eight of a row's words to the places of their pixels in the planes. */
ALWAYS_INLINE void take_apart(const uint64_t *words, ptrdiff_t stride, uint8_t *plane) {
    const __m128i by_two = _mm_setr_epi8(0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15);
    __m128i two[4];
    for (int k = 0; k < 4; k++) {
        two[k] = _mm_shuffle_epi8(_mm_loadu_si128((const __m128i *)(const void *)(words + 2 * k)), by_two);
    }
    /* Bytes 0 to 3 and 4 to 7 of the first four words and of the last four; then two bytes of all eight each. */
    const __m128i four[4] = {_mm_unpacklo_epi16(two[0], two[1]), _mm_unpackhi_epi16(two[0], two[1]),
                             _mm_unpacklo_epi16(two[2], two[3]), _mm_unpackhi_epi16(two[2], two[3])};
    const __m128i eight[4] = {_mm_unpacklo_epi32(four[0], four[2]), _mm_unpackhi_epi32(four[0], four[2]),
                              _mm_unpacklo_epi32(four[1], four[3]), _mm_unpackhi_epi32(four[1], four[3])};
    const __m128i nibble = _mm_set1_epi8(15);
    const __m128i unseen =
        _mm_and_si128(_mm_unpackhi_epi64(eight[3], eight[3]), _mm_set1_epi8((char)LOOKS_UP_ZERO));
    for (int k = 0; k < 4; k++, plane += 4 * stride) {
        const __m128i low = _mm_or_si128(_mm_and_si128(eight[k], nibble), unseen);
        const __m128i high = _mm_or_si128(_mm_and_si128(_mm_srli_epi16(eight[k], 4), nibble), unseen);
        _mm_storel_epi64((__m128i *)(void *)plane, low);
        _mm_storel_epi64((__m128i *)(void *)(plane + stride), high);
        _mm_storel_epi64((__m128i *)(void *)(plane + 2 * stride), _mm_unpackhi_epi64(low, low));
        _mm_storel_epi64((__m128i *)(void *)(plane + 3 * stride), _mm_unpackhi_epi64(high, high));
    }
    /* One shift makes COST_UNSEEN of LOOKS_UP_ZERO. */
    _mm_storel_epi64((__m128i *)(void *)plane, _mm_srli_epi16(unseen, 2));
}

/* The planes of the target row, and behind them one with the cost of unseen pixels, in whose planes nothing is
 * found. Each has `depth` unseen pixels on both sides. */
static void make_planes(const uint64_t *target, match_size size, uint8_t *planes) {
    const ptrdiff_t stride = plane_stride(size), width = size.target_width;
    for (ptrdiff_t r = 0; r < width; r += 8) {
        uint64_t rest[8] = {0};
        if (width - r < 8) {
            memcpy(rest, target + r, (size_t)(width - r) * sizeof *target);
        }
        take_apart(width - r < 8 ? rest : target + r, stride, planes + size.depth + r);
    }
    for (ptrdiff_t k = 0; k <= PLANES; k++) {
        uint8_t *plane = planes + k * stride;
        const int unseen = k < PLANES ? LOOKS_UP_ZERO : COST_UNSEEN;
        memset(plane, unseen, (size_t)size.depth);
        memset(plane + size.depth + width, unseen, (size_t)size.depth);
    }
}

/* Row place / 16 of the table, twice. */
ALWAYS_INLINE __m256i distances_at(uint64_t place) {
    const uint8_t *distances = (const uint8_t *)DISTANCES + place;
    return _mm256_broadcastsi128_si256(_mm_loadu_si128((const __m128i *)(const void *)distances));
}

/* Costs of the census word `reference` in 32 * vectors slots. */
ALWAYS_INLINE void look_up(uint64_t reference, const uint8_t *planes, ptrdiff_t stride, const ptrdiff_t vectors,
                           uint8_t *slots) {
    __m256i sums[4];
    for (ptrdiff_t v = 0; v < vectors; v++) {
        sums[v] = _mm256_loadu_si256((const __m256i *)(const void *)(planes + PLANES * stride + 32 * v));
    }
    /* Each 4 bits times 16, which is where their distances lie: no shift is left for each plane. */
    uint64_t even = reference << 4 & HIGH_BITS, odd = reference & HIGH_BITS;
#pragma GCC unroll 4
    for (int k = 0; k < PLANES; k += 2, planes += 2 * stride, even >>= 8, odd >>= 8) {
        const __m256i table[2] = {distances_at(even & 255), distances_at(odd & 255)};
        for (ptrdiff_t v = 0; v < vectors; v++) {
            const __m256i bits = _mm256_loadu_si256((const __m256i *)(const void *)(planes + 32 * v));
            const __m256i next = _mm256_loadu_si256((const __m256i *)(const void *)(planes + stride + 32 * v));
            sums[v] = _mm256_add_epi8(sums[v], _mm256_shuffle_epi8(table[0], bits));
            sums[v] = _mm256_add_epi8(sums[v], _mm256_shuffle_epi8(table[1], next));
        }
    }
    for (ptrdiff_t v = 0; v < vectors; v++) {
        _mm256_storeu_si256((__m256i *)(void *)(slots + 32 * v), sums[v]);
    }
}

/* `vectors` are looked up at once; they divide a pixel's. */
ALWAYS_INLINE void costs_of_row(const uint64_t *reference, const int32_t *base, match_size size, row_span span,
                                const uint8_t *planes, uint8_t *cost, const ptrdiff_t vectors) {
    const ptrdiff_t stride = plane_stride(size), last = size.target_width + size.depth;
    for (ptrdiff_t x = span.first; x < span.end; x++) {
        uint8_t *slots = cost + x * size.depth;
        if (reference[x] & CENSUS_INVALID) {
            memset(slots, 0, (size_t)size.depth);
            continue;
        }
        const ptrdiff_t near = x + base[x] + size.depth, first = near < 0 ? 0 : near > last ? last : near;
        for (ptrdiff_t i = 0; i < size.depth; i += 32 * vectors) {
            look_up(reference[x], planes + first + i, stride, vectors, slots + i);
        }
    }
}

void cost_row_avx2(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                   row_span span, uint64_t *buffer, uint8_t *cost) {
    uint8_t *planes = (uint8_t *)buffer;
    make_planes(target, size, planes);
    if (size.depth % 128 == 0) {
        costs_of_row(reference, base, size, span, planes, cost, 4);
    } else if (size.depth % 64 == 0) {
        costs_of_row(reference, base, size, span, planes, cost, 2);
    } else {
        costs_of_row(reference, base, size, span, planes, cost, 1);
    }
}
