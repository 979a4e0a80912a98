/* The sub-pixel fit of offsets.
 *
 * Around each pixel a plane is fitted to the offsets of its own surface. Raw matching costs, summed over the
 * window along that plane and one pixel to either side of it, make a V whose tip is where the window really
 * matches. Aggregated costs cannot tell: P1 holds neighbours on the same whole pixel. Neighbouring pixels are
 * fitted side by side, each in a lane of its own. */
#include <stdlib.h>
#include <string.h>

#include "lanes.h"
#include "matching/matching.h"
#include "version.h"

enum {
    RADIUS = 2,
    SIDE = 2 * RADIUS + 1,
    MIN_COUNT = 6,
    LARGEST = 1 << 24, /* offset of 65536 pixels */
    NONE = 1 << 28,    /* stands for what is no offset: beyond any reach */
    REACH = 2,         /* costs are kept for this many target pixels to either side of a pixel's offset */
    COST_BITS = 6
};

/* Offsets of a row, RADIUS before the first and beyond the last block, NONE where a pixel cannot be used; the
 * least ones that round to a pixel with costs on both sides; and the costs of 2 REACH + 1 target pixels around
 * each, COST_BITS each, the leftmost lowest. */
typedef struct {
    int32_t *offset, *least;
    uint32_t *costs;
} window_row;

/* Gradient and value at the centre, in 1/256 of the unit of offsets, relative to the centre's offset. */
typedef struct {
    int_lanes value, dx, dy;
    int_lanes found;
} offset_planes;

static inline int_lanes absolute(int_lanes v) { return (v ^ (v >> 31)) - (v >> 31); }

/* Where |v| <= most, in one comparison. */
static inline int_lanes is_within(int_lanes v, int most) {
    return (unsigned_lanes)(v + most) <= (unsigned)(2 * most);
}

static inline int_lanes choose(int_lanes condition, int_lanes yes, int_lanes no) {
    return (condition & yes) | (~condition & no);
}

/* Whether none of a block's pixels can be used; most often the first one tells. */
static inline int is_empty(const int32_t *offset) {
    int l = 0;
    while (l < LANES && offset[l] == NONE) {
        l++;
    }
    return l == LANES;
}

/* Whole quotients of numbers below 2^24 with few digits before the point: rounding lifts none to the next. */
static inline int_lanes quotient(int_lanes a, int_lanes b) {
    return __builtin_convertvector(
        __builtin_convertvector(a, float_lanes) / __builtin_convertvector(b, float_lanes), int_lanes);
}

/* Nearest multiple of 256, divided by it; compilers shift negative numbers so that they round down. */
static inline int32_t nearest_256(int32_t value) { return (value + 128) >> 8; }

static inline int_lanes nearest_256_lanes(int_lanes value) { return (value + 128) >> 8; }

/* Within the widest row; OFFSET_INVALID is not. */
static inline int is_offset(int32_t offset) { return offset >= -LARGEST && offset <= LARGEST; }

static inline void read_row(const int32_t *offset, const uint64_t *reference, const uint64_t *target,
                            match_size size, ptrdiff_t y, window_row row) {
    for (ptrdiff_t x = -RADIUS; x < size.width + RADIUS + LANES; x++) {
        row.offset[x] = NONE;
        row.least[x] = NONE;
        row.costs[x] = 0;
    }
    if (y < 0 || y >= size.height) {
        return;
    }
    for (ptrdiff_t x = 0; x < size.width; x++) {
        const int32_t o = offset[y * size.width + x];
        const ptrdiff_t column = x + nearest_256(is_offset(o) ? o : 0);
        if (!is_offset(o) || column < REACH || column + REACH >= size.target_width) {
            continue;
        }
        const uint64_t word = reference[y * size.width + x], *t = target + y * size.target_width + column - REACH;
        uint64_t invalid = 0;
        uint32_t costs = 0;
        for (int k = 0; k <= 2 * REACH; k++) {
            invalid |= t[k] & CENSUS_INVALID;
            costs |= (uint32_t)__builtin_popcountll(word ^ t[k]) << COST_BITS * k;
        }
        if (!invalid) {
            row.offset[x] = o;
            row.least[x] = 256 * (nearest_256(o) - (REACH - 1)) - 128;
            row.costs[x] = costs;
        }
    }
}

/* Least-squares planes through the offsets within reach of the centre's; `difference` are offsets minus that. */
static inline offset_planes fit_offsets(int_lanes difference[SIDE][SIDE]) {
    int_lanes n = {0}, sx = {0}, sy = {0}, sxx = {0}, sxy = {0}, syy = {0}, so = {0}, sxo = {0}, syo = {0};
#pragma GCC unroll 5
    for (int j = 0; j < SIDE; j++) {
        const int dy = j - RADIUS;
        int_lanes count = {0}, count_x = {0}, sum = {0};
#pragma GCC unroll 5
        for (int i = 0; i < SIDE; i++) {
            const int dx = i - RADIUS, ring = abs(dx) > abs(dy) ? abs(dx) : abs(dy);
            const int_lanes kept = is_within(difference[j][i], MAX_OFFSET_STEP * ring);
            const int_lanes o = difference[j][i] & kept;
            count -= kept;
            count_x -= kept * dx;
            sxx -= kept * (dx * dx);
            sum += o;
            sxo += o * dx;
        }
        n += count;
        sx += count_x;
        sy += count * dy;
        sxy += count_x * dy;
        syy += count * (dy * dy);
        so += sum;
        syo += sum * dy;
    }
    const int_lanes c00 = sxx * syy - sxy * sxy, c01 = sy * sxy - sx * syy, c02 = sx * sxy - sy * sxx;
    const int_lanes c11 = n * syy - sy * sy, c12 = sx * sy - n * sxy, c22 = n * sxx - sx * sx;
    const int_lanes determinant = n * c00 + sx * c01 + sy * c02;
    const int_lanes solved = (n >= MIN_COUNT) & (determinant > 0);
#define DOUBLES(v) __builtin_convertvector(v, double_lanes)
    const double_lanes scale = 256.0 / DOUBLES(choose(solved, determinant, (int_lanes){0} + 1));
    const double_lanes o = DOUBLES(so), xo = DOUBLES(sxo), yo = DOUBLES(syo);
    const double_lanes value = (DOUBLES(c00) * o + DOUBLES(c01) * xo + DOUBLES(c02) * yo) * scale;
    const double_lanes dx = (DOUBLES(c01) * o + DOUBLES(c11) * xo + DOUBLES(c12) * yo) * scale;
    const double_lanes dy = (DOUBLES(c02) * o + DOUBLES(c12) * xo + DOUBLES(c22) * yo) * scale;
#undef DOUBLES
    const int_lanes v = __builtin_convertvector(value, int_lanes), vx = __builtin_convertvector(dx, int_lanes);
    const int_lanes vy = __builtin_convertvector(dy, int_lanes);
    /* Neighbours nearly on a line say nothing about the centre. What is beyond 32 bits becomes an extreme number.
     */
    const int most = 256 * MAX_OFFSET_STEP * SIDE;
    const int_lanes found =
        solved & (v < most) & (v > -most) & (vx < most) & (vx > -most) & (vy < most) & (vy > -most);
    return (offset_planes){v & found, vx & found, vy & found, found};
}

/* Fitted offsets of pixels of the middle row, the first at x. */
static inline int_lanes fit_pixels(const window_row rows[SIDE], ptrdiff_t x, int_lanes centre) {
    int_lanes difference[SIDE][SIDE];
    for (int j = 0; j < SIDE; j++) {
        for (int i = 0; i < SIDE; i++) {
            difference[j][i] = load_ints(rows[j].offset + x + i - RADIUS) - centre;
        }
    }
    const offset_planes plane = fit_offsets(difference);
    int_lanes count = {0}, rounded = {0};
    /* Costs before (from bit 0) and behind (from bit 12) the plane, and on it (from bit 6). */
    unsigned_lanes beside = {0}, on = {0};
    /* By adding a half beforehand, cutting off rounds to the nearest. */
    int_lanes row_value = plane.value + 128 - RADIUS * plane.dy;
#pragma GCC unroll 5
    for (int j = 0; j < SIDE; j++, row_value += plane.dy) {
        int_lanes value = row_value - RADIUS * plane.dx;
#pragma GCC unroll 5
        for (int i = 0; i < SIDE; i++, value += plane.dx) {
            const ptrdiff_t at = x + i - RADIUS;
            /* How far the plane lies above the least offset; what has no costs there is no part of the surface. */
            const int_lanes beyond = (value >> 8) + (centre - load_ints(rows[j].least + at));
            const int_lanes kept = (unsigned_lanes)beyond < 256u * (2 * REACH - 1);
            const int_lanes place = beyond & kept;
            const unsigned_lanes costs = (unsigned_lanes)(load_ints(rows[j].costs + at) & kept) >>
                                         (unsigned_lanes)(COST_BITS * (place >> 8));
            beside += costs & (63 | 63 << 2 * COST_BITS);
            on += costs & 63 << COST_BITS;
            count -= kept;
            rounded += place & 255;
        }
    }
    rounded -= 128 * count;
    const int_lanes before = (int_lanes)(beside & 4095), after = (int_lanes)(beside >> 2 * COST_BITS),
                    at = (int_lanes)(on >> COST_BITS);
    const int_lanes rise = choose(before > after, before, after) - at;
    const int_lanes good = plane.found & (count >= MIN_COUNT) & (rise > 0) & (at <= before) & (at <= after);
    /* Whole pixels lie beside the plane by `rounded / count` on average. A perfect match is at whole pixels. */
    const int_lanes one = (int_lanes){0} + 1;
    const int_lanes tip = quotient((before - after) * 128, choose(good, rise, one)) & (at != 0);
    const int_lanes change = nearest_256_lanes(plane.value) + tip - quotient(rounded, choose(good, count, one));
    return centre + (change & good & (absolute(change) <= MAX_OFFSET_CHANGE));
}

int VERSION_OF(fit_offsets)(const int32_t *offset, const uint64_t *reference, const uint64_t *target,
                            match_size size, int32_t *fitted) {
    const ptrdiff_t stride = size.width + 2 * RADIUS + LANES;
    int32_t *offsets = malloc((size_t)(SIDE * stride) * sizeof *offsets);
    int32_t *least = malloc((size_t)(SIDE * stride) * sizeof *least);
    uint32_t *costs = malloc((size_t)(SIDE * stride) * sizeof *costs);
    const int failed = !offsets || !least || !costs;
    window_row rows[SIDE];
    for (int j = 0; j < SIDE && !failed; j++) {
        rows[j] =
            (window_row){offsets + j * stride + RADIUS, least + j * stride + RADIUS, costs + j * stride + RADIUS};
        read_row(offset, reference, target, size, j - RADIUS, rows[j]);
    }
    for (ptrdiff_t y = 0; y < size.height && !failed; y++) {
        for (ptrdiff_t x = 0; x < size.width; x += LANES) {
            const int_lanes centre = load_ints(rows[RADIUS].offset + x), none = centre == NONE;
            const ptrdiff_t p = y * size.width + x, left = size.width - x, count = left < LANES ? left : LANES;
            if (is_empty(rows[RADIUS].offset + x)) {
                memcpy(fitted + p, offset + p, (size_t)count * sizeof *fitted);
                continue;
            }
            const int_lanes result = fit_pixels(rows, x, centre & ~none);
            if (count == LANES) { /* which most blocks are: whole vectors */
                const int_lanes stored = choose(none, load_ints(offset + p), result);
                memcpy(fitted + p, &stored, sizeof stored);
                continue;
            }
            for (ptrdiff_t l = 0; l < count; l++) {
                fitted[p + l] = none[l] ? offset[p + l] : result[l];
            }
        }
        const window_row oldest = rows[0];
        for (int j = 0; j + 1 < SIDE; j++) {
            rows[j] = rows[j + 1];
        }
        rows[SIDE - 1] = oldest;
        read_row(offset, reference, target, size, y + RADIUS + 1, oldest);
    }
    free(offsets);
    free(least);
    free(costs);
    return failed ? -1 : 0;
}
