/* Gaps of offsets, filled from what is nearest: chamfer distances of 5 x 5 pixels (Borgefors 1986), two passes. */
#include <stdlib.h>

#include "matching/matching.h"
#include "offsets/offsets.h"

/* What is nearest to a pixel: its distance, and in the lower half its residual, the largest first. So the least of
 * several is the nearest, and of those equally near the one with the largest residual. */
typedef uint64_t nearest;

enum { MARGIN = 2 };

static const nearest DISTANCE = (nearest)1 << 32, NOWHERE = (nearest)1 << 62;

ALWAYS_INLINE nearest least(nearest a, nearest b) { return a < b ? a : b; }

/* Sums and differences wrap around, and back. */
ALWAYS_INLINE nearest at_residual(int32_t offset, int32_t predicted) {
    return ((uint32_t)offset - (uint32_t)predicted) ^ INT32_MAX;
}

ALWAYS_INLINE int32_t with_residual(int32_t predicted, nearest from) {
    return (int32_t)((uint32_t)predicted + ((uint32_t)from ^ INT32_MAX));
}

/* A row, in one direction, from the two that were passed before: the one beside it, and the one beyond that. All
 * have MARGIN pixels more at either end. */
static void spread(const nearest *restrict beyond, const nearest *restrict beside, ptrdiff_t width,
                   ptrdiff_t direction, nearest *restrict row) {
    const nearest straight = STRAIGHT_STEP * DISTANCE, diagonal = DIAGONAL_STEP * DISTANCE;
    const nearest knight = KNIGHT_STEP * DISTANCE;
    nearest before = NOWHERE;
    for (ptrdiff_t i = 0, x = direction > 0 ? 0 : width - 1; i < width; i++, x += direction) {
        if (row[x] >= DISTANCE) {
            const nearest across = least(beside[x - 1], beside[x + 1]) + diagonal;
            const nearest far = least(least(beside[x - 2], beside[x + 2]), least(beyond[x - 1], beyond[x + 1]));
            const nearest other = least(least(across, far + knight), least(row[x], beside[x] + straight));
            row[x] = least(other, before + straight);
        }
        before = row[x];
    }
}

int fill_nearest(const int32_t *offset, const int32_t *predicted, ptrdiff_t height, ptrdiff_t width,
                 float *filled) {
    const ptrdiff_t stride = width + 2 * MARGIN, count = (height + 2 * MARGIN) * stride;
    nearest *from = malloc((size_t)count * sizeof *from);
    if (!from) {
        return -1;
    }
    for (ptrdiff_t i = 0; i < MARGIN * (stride + 1); i++) {
        from[i] = from[count - 1 - i] = NOWHERE;
    }
    for (ptrdiff_t y = 0; y < height; y++) {
        nearest *row = from + (y + MARGIN) * stride + MARGIN;
        for (ptrdiff_t x = 0; x < width; x++) {
            const ptrdiff_t p = y * width + x;
            row[x] = offset[p] == OFFSET_INVALID ? NOWHERE : at_residual(offset[p], predicted[p]);
        }
        for (ptrdiff_t i = 0; i < 2 * MARGIN; i++) {
            row[width + i] = NOWHERE; /* and before the next row */
        }
        spread(row - 2 * stride, row - stride, width, 1, row);
    }
    for (ptrdiff_t y = height - 1; y >= 0; y--) {
        nearest *row = from + (y + MARGIN) * stride + MARGIN;
        spread(row + 2 * stride, row + stride, width, -1, row);
        for (ptrdiff_t x = 0; x < width; x++) {
            const ptrdiff_t p = y * width + x;
            const int32_t own = row[x] == NOWHERE ? predicted[p] : with_residual(predicted[p], row[x]);
            filled[p] = (float)own / 256;
        }
    }
    free(from);
    return 0;
}
