/* Means of offsets of one surface; see `mean_offsets_fn` in matching.h. */
#include <string.h>

#include "matching/matching.h"
#include "version.h"

/* Sums of differences fit in 32 bits. */
_Static_assert((2 * MAX_MEAN_RADIUS + 1) * (2 * MAX_MEAN_RADIUS + 1) * (int64_t)MAX_MEAN_STEP < INT32_MAX, "sums");

/* To the sums and counts of a row's pixels, those of the pixels of another row that lie dx to the right. */
static void add_row(const int32_t *own, const int32_t *other, ptrdiff_t width, ptrdiff_t dx, int32_t max_step,
                    int32_t *sum, int32_t *count) {
    const ptrdiff_t first = dx < 0 ? -dx : 0, end = dx > 0 ? width - dx : width;
    for (ptrdiff_t x = first; x < end; x++) {
        /* Unsigned, as the difference of extremes wraps round, to one of the other sign. */
        const int32_t difference = (int32_t)((uint32_t)other[x + dx] - (uint32_t)own[x]);
        const int32_t kept = -((difference <= max_step) & (difference >= -max_step) &
                               ((difference < 0) == (other[x + dx] < own[x])));
        sum[x] += difference & kept;
        count[x] -= kept;
    }
}

void VERSION_OF(mean_offsets)(const int32_t *offset, ptrdiff_t height, ptrdiff_t width, int radius, int max_step,
                              int32_t *sums, int32_t *mean) {
    int32_t *counts = sums + width;
    for (ptrdiff_t y = 0; y < height; y++) {
        const int32_t *own = offset + y * width;
        memset(sums, 0, (size_t)(2 * width) * sizeof *sums);
        for (ptrdiff_t dy = -radius; dy <= radius; dy++) {
            for (ptrdiff_t dx = -radius; dx <= radius && y + dy >= 0 && y + dy < height; dx++) {
                add_row(own, own + dy * width, width, dx, max_step, sums, counts);
            }
        }
        for (ptrdiff_t x = 0; x < width; x++) {
            mean[y * width + x] = own[x] + sums[x] / counts[x];
        }
    }
}
