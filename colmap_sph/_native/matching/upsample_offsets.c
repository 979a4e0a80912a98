/* From the offsets of one level to those of the next finer one; see matching.h. */
#include "matching/matching.h"
#include "version.h"

/* Three offsets side by side in each of three rows; beyond the sides, the outermost. */
typedef struct {
    const int32_t *above, *own, *below;
} three_rows;

static three_rows rows_around(const int32_t *offset, level_sizes size, ptrdiff_t y) {
    const int32_t *above = offset + within(y - 1, size.height) * size.width;
    return (three_rows){above, offset + y * size.width, offset + within(y + 1, size.height) * size.width};
}

ALWAYS_INLINE int32_t least_of(int32_t a, int32_t b, int32_t c) { return a < b ? (a < c ? a : c) : b < c ? b : c; }

ALWAYS_INLINE int32_t most_of(int32_t a, int32_t b, int32_t c) { return a > b ? (a > c ? a : c) : b > c ? b : c; }

/* Differences may wrap round, where they are too large to be used. */
ALWAYS_INLINE int32_t minus(int32_t a, int32_t b) { return (int32_t)((uint32_t)a - (uint32_t)b); }

ALWAYS_INLINE int32_t plus(int32_t a, int32_t b) { return (int32_t)((uint32_t)a + (uint32_t)b); }

ALWAYS_INLINE int32_t three_times(int32_t a) { return (int32_t)(3 * (uint32_t)a); }

/* Two pixels of a finer row, a quarter of a pixel from the middle towards the row beside it. */
ALWAYS_INLINE void upsample_pixel(three_rows rows, const int32_t *beside, ptrdiff_t left, ptrdiff_t x,
                                  ptrdiff_t right, int32_t max_step, int32_t *restrict fine) {
    const int32_t *a = rows.above, *o = rows.own, *b = rows.below;
    const int32_t least = least_of(least_of(a[left], a[x], a[right]), least_of(o[left], o[x], o[right]),
                                   least_of(b[left], b[x], b[right]));
    const int32_t most = most_of(most_of(a[left], a[x], a[right]), most_of(o[left], o[x], o[right]),
                                 most_of(b[left], b[x], b[right]));
    const int32_t span = minus(most, least); /* negative where it wraps round */
    const int interpolates = span >= 0 && span <= max_step;
    /* 1/16 of 9 times its own, 3 times those beside it and once the one across, less its own. */
    const int32_t middle = plus(three_times(minus(beside[x], o[x])), 8);
    const int32_t first = plus(three_times(minus(o[left], o[x])), minus(beside[left], o[x]));
    const int32_t second = plus(three_times(minus(o[right], o[x])), minus(beside[right], o[x]));
    fine[0] = interpolates ? plus(o[x], plus(middle, first) >> 4) : o[x];
    fine[1] = interpolates ? plus(o[x], plus(middle, second) >> 4) : o[x];
}

void VERSION_OF(upsample_offsets)(const int32_t *offset, level_sizes size, int max_step, int32_t *fine) {
    const ptrdiff_t last = size.width - 1;
    for (ptrdiff_t y = 0; y < size.fine_height && last >= 0; y++) {
        const three_rows rows = rows_around(offset, size, y >> 1);
        const int32_t *beside = y & 1 ? rows.below : rows.above;
        int32_t *out = fine + y * size.fine_width, ends[2];
        for (ptrdiff_t x = 1; x < last; x++) {
            upsample_pixel(rows, beside, x - 1, x, x + 1, max_step, out + 2 * x);
        }
        upsample_pixel(rows, beside, within(last - 1, size.width), last, last, max_step, ends);
        for (ptrdiff_t i = 0; i < 2 && 2 * last + i < size.fine_width; i++) {
            out[2 * last + i] = ends[i];
        }
        if (last > 0) {
            upsample_pixel(rows, beside, 0, 0, 1, max_step, out);
        }
    }
}
