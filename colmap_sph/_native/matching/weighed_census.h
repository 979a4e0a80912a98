/* Census words in which the neighbours within 5 x 5 pixels count twice, the 12 next ones once and others not: 60
 * bits. */
#ifndef COLMAP_SPH_WEIGHED_CENSUS_H
#define COLMAP_SPH_WEIGHED_CENSUS_H

#include "matching/matching.h"

/* Bits of a word that stay: the neighbours within 5 x 5 pixels, and those of the others that are nearest. */
#define KEPT (UINT64_C(0x0707c7f3f3f8f838) | CENSUS_INVALID)

/* Second bits of the 5 x 5 stand in places of those that are left out. */
ALWAYS_INLINE uint64_t weighed_census(uint64_t word) {
    return (word & KEPT) | (word & UINT64_C(0x7018180e0f800)) >> 5 | (word & UINT64_C(0xc26000000000)) << 14 |
           (word & UINT64_C(0x60000000)) << 24 | (word & UINT64_C(0x100000)) >> 18 |
           (word & UINT64_C(0x1000000)) >> 23;
}

#endif
