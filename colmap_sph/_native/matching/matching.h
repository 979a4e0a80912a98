/* Kernels of matching: a reference image is compared with a target image of the same height. Slot `i` of reference
 * pixel (y, x) stands for the target pixel (y, x + base[y, x] + i), 0 <= i < depth. `depth` is a multiple of 32.
 * The target is a source image warped by predicted offsets, so that surfaces lie as flat as they are expected to.
 * Those on pixels with many slots have versions per instruction set, equal to the bit. */
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
    MAX_OFFSET_STEP = 512,   /* 1/256 pixel: neighbours whose offsets differ by more are not one surface */
    MAX_OFFSET_CHANGE = 256, /* 1/256 pixel */
    MAX_OFFSET = 1 << 24,    /* 1/256 pixel: widest row */
    MAX_MEAN_RADIUS = 10,
    MAX_MEAN_STEP = 1 << 20
};

/* Census images come in 1/64 grey value: on weak texture, whole ones are too coarse. A difference up to half a
 * grey value, which may be rounding, counts as none. */
enum { CENSUS_STEPS = 64, CENSUS_MARGIN = CENSUS_STEPS / 2 };

/* Bit 63 of a census word marks a pixel without image content. */
#define CENSUS_INVALID (UINT64_C(1) << 63)
#define OFFSET_INVALID INT32_MIN

typedef struct {
    ptrdiff_t height, width, target_width, depth;
    ptrdiff_t source_width;
} match_size;

/* Grey values, counted in steps, have a code of GREY_BITS: of two values it differs in as many bits as there are
 * steps between them (Johnson's counter), up to GREY_BITS, and beyond in fewer again. Codes are looked up by every
 * GREY_CODE_STEP of the values that an image may have. */
enum { GREY_BITS = 14, GREY_CODE_STEP = 16, GREY_CODES = (UINT16_MAX + 1) / GREY_CODE_STEP };

/* `padded` is the image with a border of CENSUS_RADIUS_{Y,X}. Of a `fine` one, neighbours within 5 x 5 pixels have
 * two bits, and others none. With `grey`, codes of make_grey_codes, the pixel's own grey value takes the places of
 * the neighbours in the outermost columns. */
typedef struct {
    const int16_t *padded;
    const uint8_t *valid;
    ptrdiff_t height, width;
    int fine;
    const uint64_t *grey;
} census_image;

/* Bit set where the neighbour is darker by more than CENSUS_MARGIN. Rows begin `stride` words apart. */
typedef void census_fn(census_image image, ptrdiff_t stride, uint64_t *census);

/* GREY_CODES of them; steps in 1/64 grey value, at least 1. */
void make_grey_codes(int step, uint64_t *codes);

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

/* Of all sums that point at the source column of a winner's target pixel there is a least one. The winner passes
 * the check if its own sum is larger by at most `max_excess`, or if that of the first target pixel which has it is
 * at most `max_difference` columns from it. */
typedef struct {
    int32_t max_difference, max_excess;
} left_right_check;

/* Winner, left-right check from the same volume, sub-pixel offset in 1/256 pixel or OFFSET_INVALID. `columns` are
 * those of the source that target pixels show; outside of it there is none. */
typedef int selection_fn(const uint8_t *aggregated, const int32_t *base, const uint64_t *reference,
                         const uint64_t *target, const int32_t *columns, match_size size, left_right_check check,
                         int32_t *offset);

/* `surface` is the base as aggregation sees it, among the columns of the source. */
typedef struct {
    const uint64_t *reference, *target;
    const int32_t *columns, *base, *surface;
    const uint8_t *image;
    match_size size;
    path_penalties penalties;
    left_right_check check;
} match_input;

/* A band of an image's rows, from `first` to before `end` of those that are given: among them are the rows beside
 * it, where the image has any. So many rows of the image lie above and below the band. */
typedef struct {
    ptrdiff_t first, end, above, below;
} row_band;

/* Bytes of what a sweep brings from a band to the next one. */
typedef size_t sweep_bytes_fn(match_size size);

/* A sweep over a band for that alone, from `state` to `state`, which is not read at the first of the image's rows.
 */
typedef int sweep_fn(const match_input *input, row_band band, int backward, uint8_t *state);

/* Cost, aggregation and selection of a band in one, from what both sweeps bring to it to what they take from it,
 * so that the result is that of one piece. `scratch` has room for 2 bytes per slot of the band. */
typedef int match_fn(const match_input *input, row_band band, uint8_t *forward, uint8_t *backward,
                     uint8_t *scratch, int32_t *offset);

/* Offsets fitted to the raw costs of a window around each pixel; `size.depth` is not used. */
typedef int fit_offsets_fn(const int32_t *offset, const uint64_t *reference, const uint64_t *target,
                           match_size size, int32_t *fitted);

/* A source image as the reference is expected to see it: target pixel w shows what lies `prediction` (1/256 pixel)
 * from reference column w - margin; beyond the reference's sides the outermost predictions count, and beyond those
 * of the source its outermost pixels. `columns` are the nearest ones of the source, -1 outside; their rows begin
 * `stride` apart. Content is what lies in one of them and is made of content alone. */
void warp(const float *source, const uint8_t *valid, const int32_t *prediction, ptrdiff_t margin, match_size size,
          float *warped, uint8_t *warped_valid, ptrdiff_t stride, int32_t *columns);

/* From offsets to pixels of the target, as above, to offsets to the source. */
void unwarp_offsets(const int32_t *offset, const int32_t *prediction, ptrdiff_t margin, match_size size,
                    int32_t *unwarped);

/* Every offset becomes the mean, rounded towards itself, of those within `radius` of it that differ from it by no
 * more than `max_step`. */
typedef void mean_offsets_fn(const int32_t *offset, ptrdiff_t height, ptrdiff_t width, int radius, int max_step,
                             int32_t *mean);

/* A level and the next finer one, of twice as many rows and columns or one less. */
typedef struct {
    ptrdiff_t height, width, fine_height, fine_width;
} level_sizes;

/* Offsets of a level's pixels at those of the next finer one: interpolated where 3 x 3 of them differ by no more
 * than `max_step`, else repeated. */
typedef void upsample_offsets_fn(const int32_t *offset, level_sizes size, int max_step, int32_t *fine);

/* What the pixels of a level search about their predicted offsets (1/256 pixel), so many residuals each: the first
 * one, in pixels. It is half of them before the prediction, or as near to that as leaves `clearance` beyond the
 * least and the most offset of the neighbourhood, in pixels of the level above; where both do not fit, halfway
 * between them. The prediction itself is left `own_clearance`. */
typedef struct {
    int depth, clearance, own_clearance;
} search_limits;

void search_windows(const int32_t *predicted, const float *least, const float *most, level_sizes size,
                    search_limits limits, int32_t *base);

/* Disparities in pixels, minus the offsets and what `shifts` says by their fraction; NaN where there is none. */
void to_disparity(const int32_t *offset, ptrdiff_t pixels, const float *shifts, float *disparity);

census_fn census_scalar, census_avx2, census_avx512bw, census_avx512, census_neon;
fit_offsets_fn fit_offsets_scalar, fit_offsets_avx2, fit_offsets_avx512bw, fit_offsets_avx512;
mean_offsets_fn mean_offsets_scalar, mean_offsets_avx2, mean_offsets_avx512bw, mean_offsets_avx512;
upsample_offsets_fn upsample_offsets_scalar, upsample_offsets_avx2, upsample_offsets_avx512bw,
    upsample_offsets_avx512;

#endif
