/* Means of offsets of one surface; see `mean_offsets_fn` in matching.h. */
#include <string.h>

#include "lanes.h"
#include "matching/matching.h"
#include "version.h"

/* Sums of differences fit in 32 bits, also of those from the least that are kept. */
_Static_assert((2 * MAX_MEAN_RADIUS + 1) * (2 * MAX_MEAN_RADIUS + 1) * (int64_t)(2 * MAX_MEAN_STEP) < INT32_MAX,
               "sums");

/* Rows of a window that lie in the image, from the middle. */
typedef struct {
    ptrdiff_t first, last;
} row_range;

/* Means of LANES pixels in a row, whose windows reach beyond neither side; `own` is the first of them. */
static inline void mean_of_lanes(const int32_t *own, ptrdiff_t width, row_range rows, int radius, int32_t max_step,
                                 int32_t *mean) {
    const int_lanes middle = load_ints(own);
    /* From the middle's offset less max_step to that plus max_step, as far as 32 bits go. */
    const int_lanes below = (middle < INT32_MIN + max_step);
    const int_lanes above = (middle > INT32_MAX - max_step);
    const int_lanes least = (below & INT32_MIN) | (~below & (middle - (max_step & ~below)));
    const int_lanes most = (above & INT32_MAX) | (~above & (middle + (max_step & ~above)));
    const unsigned_lanes range = (unsigned_lanes)most - (unsigned_lanes)least;
    unsigned_lanes sum_from_least = {0};
    int_lanes count = {0};
    for (ptrdiff_t dy = rows.first; dy <= rows.last; dy++) {
        for (ptrdiff_t dx = -radius; dx <= radius; dx++) {
            const unsigned_lanes other = (unsigned_lanes)load_ints(own + dy * width + dx);
            /* Wraps round for what is less, to more than any range. */
            const unsigned_lanes from_least = other - (unsigned_lanes)least;
            const int_lanes kept = from_least <= range;
            sum_from_least += from_least & (unsigned_lanes)kept;
            count -= kept;
        }
    }
    const int_lanes sum = (int_lanes)sum_from_least - count * (middle - least);
    /* Whole quotients of 32-bit numbers: doubles are fine enough that rounding lifts none to the next. */
    const double_lanes quotient =
        __builtin_convertvector(sum, double_lanes) / __builtin_convertvector(count, double_lanes);
    const int_lanes means = middle + __builtin_convertvector(quotient, int_lanes);
    memcpy(mean, &means, sizeof means);
}

static inline int32_t mean_at(const int32_t *row, ptrdiff_t width, row_range rows, ptrdiff_t x, int radius,
                              int32_t max_step) {
    int32_t sum = 0, count = 0;
    for (ptrdiff_t dy = rows.first; dy <= rows.last; dy++) {
        for (ptrdiff_t dx = -radius; dx <= radius; dx++) {
            if (x + dx >= 0 && x + dx < width) {
                const int64_t difference = (int64_t)row[dy * width + x + dx] - row[x];
                const int kept = difference <= max_step && difference >= -max_step;
                sum += kept ? (int32_t)difference : 0;
                count += kept;
            }
        }
    }
    return row[x] + sum / count;
}

void VERSION_OF(mean_offsets)(const int32_t *offset, ptrdiff_t height, ptrdiff_t width, int radius, int max_step,
                              int32_t *mean) {
    for (ptrdiff_t y = 0; y < height; y++) {
        const int32_t *row = offset + y * width;
        const row_range rows = {y < radius ? -y : -radius, height - 1 - y < radius ? height - 1 - y : radius};
        const ptrdiff_t end = width - radius, last = end - LANES; /* of whole windows */
        for (ptrdiff_t x = radius; last >= radius && x < end; x += LANES) {
            /* The last block overlaps the one before it. */
            const ptrdiff_t first = x < last ? x : last;
            mean_of_lanes(row + first, width, rows, radius, max_step, mean + y * width + first);
        }
        for (ptrdiff_t x = 0; x < width; x++) {
            if (last < radius || x < radius || x >= end) {
                mean[y * width + x] = mean_at(row, width, rows, x, radius, max_step);
            }
        }
    }
}
