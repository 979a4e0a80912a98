#include "matching/matching.h"

/* Bits of a word that stay: the neighbours within 5 x 5 pixels, and those of the others that are nearest. */
#define KEPT (UINT64_C(0x0707c7f3f3f8f838) | CENSUS_INVALID)

/* Second bits of the 5 x 5, in places of those that are left out. */
static inline uint64_t second_bits(uint64_t word) {
    return (word & UINT64_C(0x7018180e0f800)) >> 5 | (word & UINT64_C(0xc26000000000)) << 14 |
           (word & UINT64_C(0x60000000)) << 24 | (word & UINT64_C(0x100000)) >> 18 |
           (word & UINT64_C(0x1000000)) >> 23;
}

void weigh_census(const uint64_t *census, ptrdiff_t pixels, uint64_t *weighed) {
    for (ptrdiff_t p = 0; p < pixels; p++) {
        weighed[p] = (census[p] & KEPT) | second_bits(census[p]);
    }
}
