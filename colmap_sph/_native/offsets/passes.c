/* Single passes over the offsets of an image; see offsets.h. */
#include "offsets/offsets.h"

#include <math.h>
#include <string.h>

#include "matching/matching.h"

void keep_between(int32_t *offset, ptrdiff_t pixels, ptrdiff_t first, ptrdiff_t last) {
    const int none = first > last || first > INT32_MAX || last < INT32_MIN;
    const int32_t least = none ? INT32_MAX : first < INT32_MIN ? INT32_MIN : (int32_t)first;
    const int32_t most = none ? INT32_MIN : last > INT32_MAX ? INT32_MAX : (int32_t)last;
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const int32_t o = offset[p];
        offset[p] = o < least || o > most ? OFFSET_INVALID : o;
    }
}

void count_fractions(const int32_t *offset, ptrdiff_t pixels, uint32_t *counts) {
    memset(counts, 0, 256 * sizeof *counts);
    for (ptrdiff_t p = 0; p < pixels; p++) {
        counts[offset[p] & 255] += offset[p] != OFFSET_INVALID;
    }
}

void unwarp_torn(const int32_t *offset, const uint8_t *torn, ptrdiff_t pixels, int as_it_is, int32_t *unwarped) {
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const int64_t there = (int64_t)offset[p] - 256 * (int64_t)as_it_is;
        const int found = offset[p] != OFFSET_INVALID && there > -MAX_OFFSET && there < MAX_OFFSET;
        unwarped[p] = torn[p] ? (found ? (int32_t)there : OFFSET_INVALID) : unwarped[p];
    }
}

/* Sums that may leave 32 bits where numbers make no sense: they wrap around. */
ALWAYS_INLINE int32_t plus(int32_t a, int32_t b) { return (int32_t)((uint32_t)a + (uint32_t)b); }

void first_offsets(search_bases bases, int32_t *first) {
    for (ptrdiff_t p = 0; p < bases.height * bases.width; p++) {
        const int32_t whole = plus(bases.predicted[p], 128) >> 8;
        first[p] = plus(bases.base[p], bases.torn[p] ? 0 : whole);
    }
}

void target_bases(search_bases bases, int margin, int as_it_is, int gap, int32_t *target_base) {
    for (ptrdiff_t y = 0; y < bases.height; y++) {
        for (int32_t x = 0; x < (int32_t)bases.width; x++) {
            const ptrdiff_t p = y * bases.width + x;
            const int32_t base = bases.base[p], nearest = -gap - x;
            target_base[p] = bases.torn[p] ? plus(base > nearest ? base : nearest, as_it_is) : plus(base, margin);
        }
    }
}

void join_targets(joined_sizes sizes, uint64_t *census, int32_t *columns) {
    const ptrdiff_t source = sizes.width - sizes.source_width;
    for (ptrdiff_t y = 0; y < sizes.height; y++, census += sizes.width, columns += sizes.width) {
        for (ptrdiff_t x = sizes.warped_width; x < source; x++) {
            census[x] = CENSUS_INVALID;
            columns[x] = -1;
        }
        for (int32_t x = 0; x < (int32_t)sizes.source_width; x++) {
            columns[source + x] = x;
        }
    }
}

void bases_about(int32_t *offset, ptrdiff_t pixels, int depth, int32_t first, int32_t last) {
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const int32_t base = (plus(offset[p], 128) >> 8) - depth / 2;
        offset[p] = base < first ? first : base > last ? last : base;
    }
}

/* 1 where the step is larger than `max_step`, which is not negative, either way. */
ALWAYS_INLINE uint8_t is_step(int32_t a, int32_t b, int32_t max_step) {
    const int32_t step = (int32_t)((uint32_t)a - (uint32_t)b);
    return step > max_step || step < -max_step;
}

void mark_steps(const int32_t *offset, ptrdiff_t height, ptrdiff_t width, int32_t max_step, uint8_t *marks) {
    for (ptrdiff_t y = 0; y < height; y++) {
        const int32_t *row = offset + y * width;
        const int32_t *above = y > 0 ? row - width : row, *below = y + 1 < height ? row + width : row;
        uint8_t *marked = marks + y * width;
        for (ptrdiff_t x = 0; x < width; x++) {
            marked[x] = is_step(row[x], above[x], max_step) | is_step(row[x], below[x], max_step);
        }
        for (ptrdiff_t x = 0; x + 1 < width; x++) {
            marked[x] |= is_step(row[x], row[x + 1], max_step);
        }
        for (ptrdiff_t x = 1; x < width; x++) {
            marked[x] |= is_step(row[x], row[x - 1], max_step);
        }
    }
}

slope_counts count_slopes(const int32_t *offset, ptrdiff_t height, ptrdiff_t width, int32_t edge, int32_t steep) {
    slope_counts counts = {0, 0};
    for (ptrdiff_t y = 0; y + 2 < height; y += 2) {
        const int32_t *row = offset + y * width, *below = row + 2 * width;
        for (ptrdiff_t x = 0; x + 2 < width; x += 2) {
            const int is_surface = !is_step(row[x + 2], row[x], edge) && !is_step(below[x], row[x], edge);
            const int is_steep = is_step(row[x + 2], row[x], steep) || is_step(below[x], row[x], steep);
            counts.surface += is_surface;
            counts.steep += is_surface & is_steep;
        }
    }
    return counts;
}

/* Of so many disparities side by side, which compilers keep in vectors. */
enum { RANGE_LANES = 16 };

static inline void widen(const float *disparity, float *restrict least, float *restrict most) {
    for (int l = 0; l < RANGE_LANES; l++) {
        const float d = disparity[l];
        const float near = fabsf(d) < INFINITY ? d : INFINITY, far = fabsf(d) < INFINITY ? d : -INFINITY;
        least[l] = near < least[l] ? near : least[l];
        most[l] = far > most[l] ? far : most[l];
    }
}

void disparity_range(const float *disparity, ptrdiff_t pixels, float ends[2]) {
    float least[RANGE_LANES], most[RANGE_LANES], last[RANGE_LANES];
    for (int l = 0; l < RANGE_LANES; l++) {
        least[l] = INFINITY;
        most[l] = -INFINITY;
        last[l] = NAN;
    }
    ptrdiff_t p = 0;
    for (; p + RANGE_LANES <= pixels; p += RANGE_LANES) {
        widen(disparity + p, least, most);
    }
    if (p < pixels) {
        memcpy(last, disparity + p, (size_t)(pixels - p) * sizeof *last);
        widen(last, least, most);
    }
    for (int l = 1; l < RANGE_LANES; l++) {
        least[0] = least[l] < least[0] ? least[l] : least[0];
        most[0] = most[l] > most[0] ? most[l] : most[0];
    }
    ends[0] = least[0] <= most[0] ? least[0] : 0;
    ends[1] = least[0] <= most[0] ? most[0] : 0;
}

void code_disparity(const float *disparity, ptrdiff_t pixels, float least, float step, uint16_t *codes) {
    /* Adding a number to whose size floats are whole, and taking it away again, rounds to even. */
    const float whole = 1 << 23;
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const float steps = (disparity[p] - least) / step;
        const float within_codes = steps > 0 ? (steps < 65534 ? steps : 65534) : 0;
        const int32_t code = (int32_t)((within_codes + whole) - whole) + 1;
        codes[p] = (uint16_t)(isfinite(disparity[p]) ? code : 0);
    }
}

void decode_disparity(const uint16_t *codes, ptrdiff_t pixels, float least, float step, float *disparity) {
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const float value = ((float)codes[p] - 1) * step + least;
        disparity[p] = codes[p] ? value : NAN;
    }
}
