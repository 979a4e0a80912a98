/* What becomes of census words once all neighbours are compared. */
#ifndef COLMAP_SPH_WEIGHED_CENSUS_H
#define COLMAP_SPH_WEIGHED_CENSUS_H

#include "matching/matching.h"

/* Bits of the neighbours within 5 x 5 pixels, and of those in the window's outermost columns. */
#define WITHIN_5_X_5 UINT64_C(0x7c3e1e1f0f800)
#define OUTERMOST UINT64_C(0x2030180c0c060301)

/* Neighbours within 5 x 5 pixels count twice, others not: second bits stand in the places of those around them,
 * within 7 x 7. */
ALWAYS_INLINE uint64_t near_twice(uint64_t word) {
    return (word & WITHIN_5_X_5) | (word & UINT64_C(0xc24120909000)) << 13 |
           (word & UINT64_C(0x8041600000)) >> 20 | (word & UINT64_C(0x7000000000000)) << 8 |
           (word & UINT64_C(0x6800)) >> 8 | (word & UINT64_C(0x10080000000)) >> 24 |
           (word & UINT64_C(0x2000000000)) << 18;
}

/* The word of a pixel with content; see census_image. */
ALWAYS_INLINE uint64_t weighed_census(uint64_t word, int16_t centre, int fine, const uint64_t *grey) {
    const uint64_t near = fine ? near_twice(word) : word;
    return grey ? (near & ~OUTERMOST) | grey[(centre - INT16_MIN) / GREY_CODE_STEP] : near;
}

#endif
