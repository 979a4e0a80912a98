/* Kernels of matching: a reference image is compared with a target image of the same height. Slot `i` of reference
 * pixel (y, x) stands for the target pixel (y, x + base[y, x] + i), 0 <= i < depth. `depth` is a multiple of 32.
 * All of them have versions per instruction set, equal to the bit. */
#ifndef COLMAP_SPH_MATCHING_H
#define COLMAP_SPH_MATCHING_H

#include "common.h"

enum {
    CENSUS_RADIUS_X = 4, /* 9 x 7 window, 62 comparisons */
    CENSUS_RADIUS_Y = 3,
    CENSUS_BITS = 62,
    COST_UNSEEN = 32, /* target pixel outside its image: as bad as a random match (62 / 2), no worse */
    /* A path cost is at most CENSUS_BITS + P2, which NO_SLOT exceeds. NO_SLOT + P1 and 2 P2 fit in 8 bits. */
    MAX_P1 = 63,
    MAX_P2 = 127,
    NO_SLOT = 192,
    DEPTH_STEP = 32,
    MAX_DEPTH = 1024,
    MAX_OFFSET_STEP = 512,  /* 1/256 pixel: neighbours whose offsets differ by more are not one surface */
    MAX_OFFSET_CHANGE = 256 /* 1/256 pixel */
};

/* Census images come in 1/64 grey value (_CENSUS_STEPS in matching.py); a difference up to half a grey value,
 * which may be rounding, counts as none. */
enum { CENSUS_MARGIN = 32 };

/* Bit 63 of a census word marks a pixel without image content. */
#define CENSUS_INVALID (UINT64_C(1) << 63)
#define OFFSET_INVALID INT32_MIN

typedef struct {
    ptrdiff_t height, width, target_width, depth;
} match_size;

/* `padded` is the image with a border of CENSUS_RADIUS_{Y,X}; bit set where the neighbour is darker by more than
 * CENSUS_MARGIN. */
typedef void census_fn(const int16_t *padded, const uint8_t *valid, ptrdiff_t height, ptrdiff_t width,
                       uint64_t *census);

typedef int cost_fn(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                    uint8_t *cost);

typedef struct {
    uint8_t p1;
    const uint8_t *p2; /* by absolute intensity difference; p1 <= p2 <= MAX_P2, p1 <= MAX_P1 */
    /* Bases of neighbours that differ by at most this are taken for the slope of one surface, which then costs
     * nothing to follow. */
    int32_t max_slant;
} path_penalties;

/* Half of the sum over 8 paths, rounded up, and on the way what the first four add to the costs; see
 * aggregation_scalar.c. */
typedef int aggregation_fn(const uint8_t *cost, const int32_t *base, const uint8_t *image, match_size size,
                           path_penalties penalties, uint8_t *detours, uint8_t *aggregated);

/* Of all sums that point at a winner's target pixel there is a least one. The winner passes the check if its own
 * sum is larger by at most `max_excess`, or if one of the least is at most `max_difference` columns from it. */
typedef struct {
    int32_t max_difference, max_excess;
} left_right_check;

/* Winner, left-right check from the same volume, sub-pixel offset in 1/256 pixel or OFFSET_INVALID. */
typedef int selection_fn(const uint8_t *aggregated, const int32_t *base, const uint64_t *reference,
                         const uint64_t *target, match_size size, left_right_check check, int32_t *offset);

typedef struct {
    const uint64_t *reference, *target;
    const int32_t *base;
    const uint8_t *image;
    match_size size;
    path_penalties penalties;
    left_right_check check;
} match_input;

/* Cost, aggregation and selection in one. `scratch` has room for 2 bytes per slot of `band_rows` rows; the result
 * does not depend on their number, but with fewer rows than the image has, half of the sweeps are done twice. */
typedef int match_fn(const match_input *input, ptrdiff_t band_rows, uint8_t *scratch, int32_t *offset);

/* Offsets fitted to the raw costs of a window around each pixel; `size.depth` is not used. */
typedef int fit_offsets_fn(const int32_t *offset, const uint64_t *reference, const uint64_t *target,
                           match_size size, int32_t *fitted);

census_fn census_scalar, census_avx2;
fit_offsets_fn fit_offsets_scalar, fit_offsets_avx2, fit_offsets_avx512;

#endif
