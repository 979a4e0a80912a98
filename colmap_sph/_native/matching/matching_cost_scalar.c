#include <string.h>

#include "matching/rows.h"

static uint8_t hamming(uint64_t a, uint64_t b) {
    uint64_t difference = a ^ b;
    uint8_t count = 0;
    for (; difference; difference &= difference - 1) {
        count++;
    }
    return count;
}

void cost_row_scalar(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                     row_span span, uint64_t *buffer, uint8_t *cost) {
    (void)buffer;
    for (ptrdiff_t x = span.first; x < span.end; x++) {
        uint8_t *slots = cost + x * size.depth;
        if (reference[x] & CENSUS_INVALID) {
            memset(slots, 0, (size_t)size.depth);
            continue;
        }
        for (ptrdiff_t i = 0; i < size.depth; i++) {
            const ptrdiff_t column = x + base[x] + i;
            const int seen = column >= 0 && column < size.target_width && !(target[column] & CENSUS_INVALID);
            slots[i] = seen ? hamming(reference[x], target[column]) : COST_UNSEEN;
        }
    }
}
