#include <immintrin.h>

#include <string.h>

#include "matching/rows.h"

enum { AHEAD = 2048 }; /* bytes fetched ahead */

/* Distances of a census word to 32 others in the bytes of the lower halves: byte k of 64 bits j is that to word
 * 8 k + j. One instruction shifts and adds. */
static inline __m512i hamming_32(__m512i reference, const uint64_t *target) {
#define HAMMING_8(k) _mm512_popcnt_epi64(_mm512_xor_si512(reference, _mm512_loadu_si512(target + 8 * (k))))
    const __m512i two = _mm512_madd52lo_epu64(HAMMING_8(0), HAMMING_8(1), _mm512_set1_epi64(1 << 8));
    const __m512i three = _mm512_madd52lo_epu64(two, HAMMING_8(2), _mm512_set1_epi64(1 << 16));
    return _mm512_madd52lo_epu64(three, HAMMING_8(3), _mm512_set1_epi64(1 << 24));
#undef HAMMING_8
}

/* Costs of 64 slots (or of 32: the lower half), COST_UNSEEN where the bit in `seen` is not set. */
static inline __m512i costs_of(__m512i reference, const uint64_t *target, uint64_t seen, int both) {
    const __m512i low = hamming_32(reference, target);
    const __m512i bytes =
        both ? _mm512_mask_shuffle_epi32(low, 0xaaaa, hamming_32(reference, target + 32), 0x80) : low;
    /* Slot 8 k + j is byte k of 64 bits j. */
#define ORDER(k) (0x3830282018100800 + 0x0101010101010101 * (k))
    const __m512i order =
        _mm512_setr_epi64(ORDER(0), ORDER(1), ORDER(2), ORDER(3), ORDER(4), ORDER(5), ORDER(6), ORDER(7));
#undef ORDER
    return _mm512_mask_mov_epi8(_mm512_set1_epi8(COST_UNSEEN), seen, _mm512_permutexvar_epi8(order, bytes));
}

/* The target row to `words`, and to `seen` a bit for each pixel with content; both with `depth` pixels without on
 * both sides. */
static void copy_row(const uint64_t *target, match_size size, uint64_t *words, uint8_t *seen) {
    const ptrdiff_t width = size.target_width;
    uint64_t *row = words + size.depth;
    uint8_t *row_seen = seen + size.depth / 8;
    memset(words, 0, (size_t)size.depth * sizeof *words);
    memset(row + width, 0, (size_t)size.depth * sizeof *row);
    memset(seen, 0, (size_t)(size.depth / 8));
    memset(row_seen + (width + 7) / 8, 0, (size_t)(size.depth / 8) + 9); /* bits are read 72 at a time */
    for (ptrdiff_t r = 0; r < width; r += 8) {
        const __mmask8 there = width - r < 8 ? (__mmask8)((1 << (width - r)) - 1) : 255;
        const __m512i eight = _mm512_maskz_loadu_epi64(there, target + r);
        _mm512_mask_storeu_epi64(row + r, there, eight);
        row_seen[r / 8] = there & (uint8_t)~_mm512_movepi64_mask(eight);
    }
}

/* 64 bits from bit `shift` of the first byte on. */
static inline uint64_t bits_from(const uint8_t *bytes, unsigned shift) {
    uint64_t bits;
    memcpy(&bits, bytes, sizeof bits);
    return bits >> shift | (uint64_t)bytes[8] << 1 << (63 - shift);
}

static inline __attribute__((always_inline)) void costs_of_row(const uint64_t *reference, const int32_t *base,
                                                               match_size size, row_span span,
                                                               const uint64_t *targets, const uint8_t *all_seen,
                                                               uint8_t *cost, const ptrdiff_t depth) {
    const ptrdiff_t last = size.target_width + depth;
    for (ptrdiff_t x = span.first; x < span.end; x++) {
        uint8_t *slots = cost + x * depth;
        if (reference[x] & CENSUS_INVALID) {
            memset(slots, 0, (size_t)depth);
            continue;
        }
        const __m512i word = _mm512_set1_epi64((long long)reference[x]);
        const ptrdiff_t near = x + base[x] + depth;
        const size_t first = near < 0 ? 0 : near > last ? (size_t)last : (size_t)near;
        const uint64_t *target = targets + first;
        const uint8_t *seen = all_seen + first / 8;
        const unsigned shift = first % 8;
        for (ptrdiff_t i = 0; i + 64 <= depth; i += 64) {
            prefetch(slots, i + AHEAD);
            _mm512_storeu_si512(slots + i, costs_of(word, target + i, bits_from(seen + i / 8, shift), 1));
        }
        if (depth % 64) {
            const ptrdiff_t i = depth - 32;
            const __m512i costs = costs_of(word, target + i, bits_from(seen + i / 8, shift), 0);
            _mm256_storeu_si256((__m256i *)(void *)(slots + i), _mm512_castsi512_si256(costs));
        }
    }
}

void cost_row_avx512(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                     row_span span, uint64_t *buffer, uint8_t *cost) {
    uint8_t *seen = (uint8_t *)(buffer + size.target_width + 2 * size.depth);
    copy_row(target, size, buffer, seen);
    /* The usual numbers of disparities as constants, for which the compiler unrolls loops. */
    switch (size.depth) {
    case 32:
        costs_of_row(reference, base, size, span, buffer, seen, cost, 32);
        break;
    case 64:
        costs_of_row(reference, base, size, span, buffer, seen, cost, 64);
        break;
    case 128:
        costs_of_row(reference, base, size, span, buffer, seen, cost, 128);
        break;
    default:
        costs_of_row(reference, base, size, span, buffer, seen, cost, size.depth);
    }
}
