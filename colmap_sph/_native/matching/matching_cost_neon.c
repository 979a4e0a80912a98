#include <arm_neon.h>

#include <string.h>

#include "matching/rows.h"

/* Distances of a census word, twice in `reference`, to 16 others: bits are counted in bytes, and these added in
 * pairs until one byte is left of each word. */
ALWAYS_INLINE uint8x16_t distances_to_16(uint64x2_t reference, const uint64_t *target) {
    uint8x16_t counts[8];
    for (int k = 0; k < 8; k++) {
        counts[k] = vcntq_u8(vreinterpretq_u8_u64(veorq_u64(reference, vld1q_u64(target + 2 * k))));
    }
    for (int number = 4; number > 0; number /= 2) {
        for (int k = 0; k < number; k++) {
            counts[k] = vpaddq_u8(counts[2 * k], counts[2 * k + 1]);
        }
    }
    return counts[0];
}

/* The target row to `words`, and to `seen` a byte for each pixel, 255 where it has content; both with `depth`
 * pixels without on both sides. */
static void copy_row(const uint64_t *target, match_size size, uint64_t *words, uint8_t *seen) {
    const ptrdiff_t width = size.target_width;
    memset(words, 0, (size_t)size.depth * sizeof *words);
    memcpy(words + size.depth, target, (size_t)width * sizeof *words);
    memset(words + size.depth + width, 0, (size_t)size.depth * sizeof *words);
    memset(seen, 0, (size_t)(width + 2 * size.depth));
    for (ptrdiff_t r = 0; r < width; r++) {
        seen[size.depth + r] = target[r] & CENSUS_INVALID ? 0 : UINT8_MAX;
    }
}

ALWAYS_INLINE void costs_of_row(const uint64_t *reference, const int32_t *base, match_size size, row_span span,
                                const uint64_t *words, const uint8_t *all_seen, uint8_t *cost,
                                const ptrdiff_t depth) {
    const ptrdiff_t last = size.target_width + depth;
    const uint8x16_t unseen = vdupq_n_u8(COST_UNSEEN);
    for (ptrdiff_t x = span.first; x < span.end; x++) {
        uint8_t *slots = cost + x * depth;
        if (reference[x] & CENSUS_INVALID) {
            memset(slots, 0, (size_t)depth);
            continue;
        }
        const uint64x2_t word = vdupq_n_u64(reference[x]);
        const ptrdiff_t near = x + base[x] + depth, first = near < 0 ? 0 : near > last ? last : near;
        for (ptrdiff_t i = 0; i < depth; i += 16) {
            const uint8x16_t distances = distances_to_16(word, words + first + i);
            vst1q_u8(slots + i, vbslq_u8(vld1q_u8(all_seen + first + i), distances, unseen));
        }
    }
}

void cost_row_neon(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                   row_span span, uint64_t *buffer, uint8_t *cost) {
    uint8_t *seen = (uint8_t *)(buffer + size.target_width + 2 * size.depth);
    copy_row(target, size, buffer, seen);
    if (size.depth == 64) { /* the usual number, for which the compiler unrolls the loop */
        costs_of_row(reference, base, size, span, buffer, seen, cost, 64);
    } else {
        costs_of_row(reference, base, size, span, buffer, seen, cost, size.depth);
    }
}
