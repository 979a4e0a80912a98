/* Selection of a row in two passes. The first one over the sums finds each pixel's winner and the target pixels'
 * least sums; the second one checks and fits the winners (check_winners_avx2.c, for AVX-512, too; NEON, which has
 * no loads from many places, shares the scalar one). */
#ifdef __aarch64__
#include <arm_neon.h>
#define check_winners check_winners_scalar
#else
#include <immintrin.h>
#define check_winners check_winners_avx2
#endif

#include <string.h>

#include "matching/rows.h"
#include "version.h"

/* The first of a pixel's least sums; and all of them against the least so far of the target pixels they point at.
 * Without branches: where the minimum lies is hard to predict. */
#ifdef __aarch64__
/* A bit for each of so many bytes, at most 64, where they are the least. */
ALWAYS_INLINE uint64_t find_least(const uint8_t *sums, uint8x16_t least, const int vectors) {
    const uint8x16_t flags = vreinterpretq_u8_u64(vdupq_n_u64(0x8040201008040201));
    uint8x16_t bits[4];
    for (int k = 0; k < 4; k++) {
        bits[k] = k < vectors ? vandq_u8(vceqq_u8(vld1q_u8(sums + 16 * k), least), flags) : vdupq_n_u8(0);
    }
    const uint8x16_t four = vpaddq_u8(vpaddq_u8(bits[0], bits[1]), vpaddq_u8(bits[2], bits[3]));
    return vgetq_lane_u64(vreinterpretq_u64_u8(vpaddq_u8(four, four)), 0);
}

ALWAYS_INLINE int32_t first_minimum(const uint8_t *sums, ptrdiff_t depth, uint8_t *best_sum) {
    uint8x16_t minimum = vdupq_n_u8(UINT8_MAX);
    for (ptrdiff_t i = 0; i < depth; i += 16) {
        const uint8x16_t sum = vld1q_u8(sums + i);
        vst1q_u8(best_sum + i, vminq_u8(sum, vld1q_u8(best_sum + i)));
        minimum = vminq_u8(minimum, sum);
    }
    const uint8x16_t least = vdupq_n_u8(vminvq_u8(minimum));
    const int32_t step = depth % 64 ? 32 : 64;
    int32_t first = 0;
    for (int32_t i = (int32_t)depth - step; i >= 0; i -= step) {
        const uint64_t equal = find_least(sums + i, least, step / 16);
        first = equal ? i + __builtin_ctzll(equal) : first;
    }
    return first;
}
#elif defined(__AVX512F__)
ALWAYS_INLINE int32_t first_minimum(const uint8_t *sums, ptrdiff_t depth, uint8_t *best_sum) {
    __m512i minimum = _mm512_set1_epi8(-1);
    for (ptrdiff_t i = 0; i < depth; i += 64) {
        const __m512i sum = _mm512_loadu_si512(sums + i);
        _mm512_storeu_si512(best_sum + i, _mm512_min_epu8(sum, _mm512_loadu_si512(best_sum + i)));
        minimum = _mm512_min_epu8(minimum, sum);
    }
    const __m256i half = _mm256_min_epu8(_mm512_castsi512_si256(minimum), _mm512_extracti64x4_epi64(minimum, 1));
    const __m128i part = _mm_min_epu8(_mm256_castsi256_si128(half), _mm256_extracti128_si256(half, 1));
    /* The upper byte of each 16 bits becomes 0. */
    const __m128i words = _mm_min_epu8(part, _mm_srli_epi16(part, 8));
    const __m512i least = _mm512_broadcastb_epi8(_mm_minpos_epu16(words));
    int32_t first = 0;
    for (ptrdiff_t i = depth; i > 0;) {
        const uint64_t equal = _mm512_cmpeq_epi8_mask(least, _mm512_loadu_si512(sums + (i -= 64)));
        first = equal ? (int32_t)(i + __builtin_ctzll(equal)) : first;
    }
    return first;
}
#else
ALWAYS_INLINE __m256i load(const uint8_t *p) { return _mm256_loadu_si256((const __m256i *)(const void *)p); }

ALWAYS_INLINE int32_t first_minimum(const uint8_t *sums, ptrdiff_t depth, uint8_t *best_sum) {
    __m256i minimum = _mm256_set1_epi8(-1);
    for (ptrdiff_t i = 0; i < depth; i += 32) {
        const __m256i sum = load(sums + i);
        _mm256_storeu_si256((__m256i *)(void *)(best_sum + i), _mm256_min_epu8(sum, load(best_sum + i)));
        minimum = _mm256_min_epu8(minimum, sum);
    }
    const __m128i half = _mm_min_epu8(_mm256_castsi256_si128(minimum), _mm256_extracti128_si256(minimum, 1));
    /* The upper byte of each 16 bits becomes 0. */
    const __m128i words = _mm_min_epu8(half, _mm_srli_epi16(half, 8));
    const __m256i least = _mm256_broadcastb_epi8(_mm_minpos_epu16(words));
    int32_t first = 0;
    for (ptrdiff_t i = depth; i > 0;) {
        uint64_t equal = (uint32_t)_mm256_movemask_epi8(_mm256_cmpeq_epi8(least, load(sums + (i -= 32))));
        if (depth % 64 == 0) {
            equal = equal << 32 | (uint32_t)_mm256_movemask_epi8(_mm256_cmpeq_epi8(least, load(sums + (i -= 32))));
        }
        first = equal ? (int32_t)(i + __builtin_ctzll(equal)) : first;
    }
    return first;
}
#endif

ALWAYS_INLINE void first_pass(const uint8_t *sums, const int32_t *base, const uint64_t *reference, match_size size,
                              const selection_buffers *buffers, const ptrdiff_t depth) {
    memset(buffers->best_sum, 255, (size_t)(size.target_width + 2 * depth));
    /* In place of a winner, where a pixel's sums begin among the target pixels. */
    int32_t *winner = buffers->winner;
    const int32_t far = 1 << 20, end = (int32_t)(size.target_width + depth);
    for (int32_t x = 0; x < (int32_t)size.width; x++) {
        const int32_t near = base[x] < -far ? -far : base[x] > far ? far : base[x];
        const int32_t first = near + x + (int32_t)depth;
        winner[x] = reference[x] & CENSUS_INVALID ? -1 : first < 0 ? 0 : first < end ? first : end;
    }
    /* Neighbours point at almost the same target pixels, and would wait for each other's sums to reach the cache:
     * pixels from all over the row take turns, which is too much for the processor's own prefetching. */
    enum { TURNS = 8, AHEAD = 512 };
    const ptrdiff_t part = (size.width + TURNS - 1) / TURNS;
    for (ptrdiff_t k = 0; k < part; k++) {
        for (ptrdiff_t x = k; x < size.width; x += part) {
            const int32_t first = winner[x];
            const uint8_t *pixel_sums = sums + x * depth;
            for (ptrdiff_t i = 0; i < depth; i += 64) {
                prefetch(pixel_sums, i + AHEAD);
            }
            if (first >= 0) {
                winner[x] = first_minimum(pixel_sums, depth, buffers->best_sum + first);
            }
        }
    }
}

void VERSION_OF(selection_row)(const uint8_t *sums, const int32_t *base, const uint64_t *reference,
                               const uint64_t *target, const int32_t *columns, match_size size,
                               left_right_check check, selection_buffers *buffers, int32_t *offset) {
#ifdef __AVX512F__
    if (size.depth % 64) { /* 32 slots fill half a register: nothing to gain */
        selection_row_avx2(sums, base, reference, target, columns, size, check, buffers, offset);
        return;
    }
#endif
    /* The usual numbers of disparities as constants, for which the compiler unrolls loops. */
    switch (size.depth) {
    case 32:
        first_pass(sums, base, reference, size, buffers, 32);
        break;
    case 64:
        first_pass(sums, base, reference, size, buffers, 64);
        break;
    case 128:
        first_pass(sums, base, reference, size, buffers, 128);
        break;
    default:
        first_pass(sums, base, reference, size, buffers, size.depth);
    }
    merge_columns(columns, size, buffers);
    check_winners(sums, base, target, size, check, buffers, offset);
}
