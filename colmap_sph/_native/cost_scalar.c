#include <string.h>

#include "kernels.h"

static uint8_t hamming(uint64_t a, uint64_t b) {
    uint64_t difference = a ^ b;
    uint8_t count = 0;
    for (; difference; difference &= difference - 1) {
        count++;
    }
    return count;
}

int cost_scalar(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                uint8_t *cost) {
    for (ptrdiff_t y = 0; y < size.height; y++) {
        const uint64_t *target_row = target + y * size.target_width;
        for (ptrdiff_t x = 0; x < size.width; x++) {
            const ptrdiff_t pixel = y * size.width + x;
            uint8_t *slots = cost + pixel * size.depth;
            if (reference[pixel] & CENSUS_INVALID) {
                memset(slots, 0, (size_t)size.depth);
                continue;
            }
            for (ptrdiff_t i = 0; i < size.depth; i++) {
                const ptrdiff_t column = x + base[pixel] + i;
                const int seen =
                    column >= 0 && column < size.target_width && !(target_row[column] & CENSUS_INVALID);
                slots[i] = seen ? hamming(reference[pixel], target_row[column]) : COST_UNSEEN;
            }
        }
    }
    return 0;
}
