/* Vectorised aggregation_scalar.c: a `vector` holds BYTES slots of 8 bits.
 *
 * The path along the row stays in registers. The three paths from the row before keep one row each, in place: row
 * n stores pixel x where its predecessor on the path was, which nothing needs any more. Between the pixels lies a
 * gap, so that a load one slot beside a pixel's own reads NO_SLOT. What a path meets at the edge of the
 * image, or of its content, are zeros: they make L = C.
 *
 * Rows go in groups, each LAG pixels behind the one before: what they leave to each other is still in the nearest
 * cache, and none need wait for its own pixel before. */
#include <stdlib.h>
#include <string.h>

#include "aligned_memory.h"
#include "matching/aggregation_vector.h"
#include "matching/rows.h"
#include "version.h"

#ifndef __clang__ /* gcc takes `least` of sweep_pixel for unset, as it cannot know that a pixel has slots */
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#endif

enum {
    PATHS = 4, /* of a sweep: three from the row before, and one along the row */
    VERTICAL_PATHS = 3,
    ROWS = 2, /* at most, of a group */
    LAG = 8,
    GAP = DEPTH_STEP,
    MAX_VECTORS = MAX_DEPTH / BYTES, /* registers per pixel */
    AHEAD = 2048                     /* bytes fetched ahead: the processor's own prefetching is late */
};

/* ---- memory ------------------------------------------------------------------------------------------------ */

/* A path has some places more than the row has pixels, so that a row's first pixel does not take the place that
 * the last one of the row before still needs. */
static ptrdiff_t places_of(match_size size) { return size.width + ROWS - 1; }

/* With 32 slots a pixel has one line of the cache, and what lies beside its slots is in it, too. */
ALWAYS_INLINE ptrdiff_t pixel_stride(ptrdiff_t depth) { return depth + GAP; }
ALWAYS_INLINE ptrdiff_t first_slot(ptrdiff_t depth) { return depth == 32 ? GAP / 2 : GAP; }

static size_t path_bytes(match_size size) {
    return ((size_t)(places_of(size) * pixel_stride(size.depth)) + GAP + 63) / 64 * 64;
}

/* Behind the paths, what no row leaves to the next: of each row of a group ... */
typedef struct {
    uint8_t *grey, *grey_before; /* this row and the one before, with a pixel on both sides */
    uint8_t *far;                /* by pixel: bit k where bases differ too much to be one surface's */
} row_notes;

static size_t notes_bytes(match_size size) { return ((size_t)size.width + 2 + 63) / 64 * 64; }

/* ... and the penalties, four times, by 255 + difference in intensity. */
enum { PENALTIES = 2048 };

static const uint32_t *penalties_of(const sweep_state *s) {
    return (const uint32_t *)(const void *)(s->memory + s->memory_size) + 255;
}

static row_notes notes_of(const sweep_state *s, ptrdiff_t row) {
    const size_t bytes = notes_bytes(s->size);
    uint8_t *notes = s->memory + s->memory_size + PENALTIES + (size_t)row * 3 * bytes;
    return (row_notes){notes + 1, notes + bytes + 1, notes + 2 * bytes};
}

static uint8_t *slots_of(const sweep_state *s, ptrdiff_t place, int k) {
    return s->memory + (size_t)k * path_bytes(s->size) + first_slot(s->size.depth) +
           place * pixel_stride(s->size.depth);
}

/* What a pixel without a predecessor on the path finds in its place. */
static void clear_place(const sweep_state *s, ptrdiff_t place, int k) {
    memset(slots_of(s, place, k), 0, (size_t)s->size.depth);
}

size_t VERSION_OF(sweep_bytes)(match_size size) {
#if BYTES == 64
    if (size.depth % BYTES) { /* as below */
        return sweep_bytes_avx2(size);
    }
#endif
    return VERTICAL_PATHS * path_bytes(size);
}

int VERSION_OF(sweep_begin)(sweep_state *state, const int32_t *base, const uint8_t *image, match_size size,
                            path_penalties penalties, int backward) {
#if BYTES == 64
    if (size.depth % BYTES) { /* 32 slots fill half a register: nothing to gain */
        return sweep_begin_avx2(state, base, image, size, penalties, backward);
    }
#endif
    *state =
        (sweep_state){.base = base, .image = image, .size = size, .penalties = penalties, .backward = backward};
    state->memory_size = VERSION_OF(sweep_bytes)(size);
    state->memory = allocate_aligned(64, state->memory_size + PENALTIES + ROWS * 3 * notes_bytes(size));
    if (!state->memory) {
        return -1;
    }
    memset(state->memory, NO_SLOT, state->memory_size);
    uint32_t *words = (uint32_t *)(void *)(state->memory + state->memory_size);
    for (int difference = -255; difference <= 255; difference++) {
        words[255 + difference] = penalties.p2[abs(difference)] * UINT32_C(0x01010101);
    }
    return 0;
}

/* ---- before a row ------------------------------------------------------------------------------------------ */

/* Row n of path k has pixel x in place x + (k - 1) n direction, going round: its predecessor's in row n - 1. */
static ptrdiff_t place_of(const sweep_state *s, ptrdiff_t done, ptrdiff_t x, int k) {
    const ptrdiff_t places = places_of(s->size);
    const ptrdiff_t place = x + (k - 1) * (s->backward ? -1 : 1) * (done % places);
    return place < 0 ? place + places : place >= places ? place - places : place;
}

/* Bit k of `far` for `count` pixels from p on, whose predecessors lie `offset` pixels from them. */
static void compare_bases(const sweep_state *s, ptrdiff_t p, ptrdiff_t offset, ptrdiff_t count, int k,
                          uint8_t *far) {
    const int32_t *a = s->base + p, *b = a + offset;
    const uint32_t most = (uint32_t)s->penalties.max_slant;
    for (ptrdiff_t x = 0; x < count; x++) {
        const uint32_t difference = (uint32_t)(a[x] > b[x] ? a[x] : b[x]) - (uint32_t)(a[x] < b[x] ? a[x] : b[x]);
        far[x] |= (uint8_t)((difference > most) << k);
    }
}

/* Those of a span's pixels whose predecessors lie `column` columns from them in another span. */
static row_span followers(row_span own, row_span before, ptrdiff_t column) {
    const ptrdiff_t first = before.first - column > own.first ? before.first - column : own.first;
    const ptrdiff_t end = before.end - column < own.end ? before.end - column : own.end;
    return first < end ? (row_span){first, end} : (row_span){own.end, own.end};
}

/* Path k < 3 comes from the row before: from column x - 1, x or x + 1 in the direction of the sweep; path 3 along
 * the row. */
static void prepare_row(const sweep_state *s, ptrdiff_t y, ptrdiff_t done, row_notes notes) {
    const ptrdiff_t direction = s->backward ? -1 : 1, width = s->size.width, before = done > 0 ? y - direction : y;
    const row_span own = span_of(s, y), above = done > 0 ? span_of(s, before) : (row_span){0, 0};
    memcpy(notes.grey, s->image + y * width, (size_t)width);
    memcpy(notes.grey_before, s->image + before * width, (size_t)width);
    notes.grey[-1] = notes.grey_before[-1] = notes.grey[width] = notes.grey_before[width] = 0;
    memset(notes.far, 0, (size_t)width);
    for (int k = 0; k < 4; k++) {
        const ptrdiff_t column = k == 3 ? -direction : (k - 1) * direction;
        const row_span follow = followers(own, k == 3 ? own : above, column);
        compare_bases(s, y * width + follow.first, (k == 3 ? 0 : -direction * width) + column,
                      follow.end - follow.first, k, notes.far + follow.first);
        for (ptrdiff_t x = own.first; x < own.end && k < VERTICAL_PATHS; x++) {
            if (x == follow.first) {
                x = follow.end;
            }
            if (x < own.end) {
                clear_place(s, place_of(s, done, x, k), k);
            }
        }
    }
}

/* ---- one pixel --------------------------------------------------------------------------------------------- */

/* The path along the row: slots of the pixel before in registers. */
typedef struct {
    vector slots[MAX_VECTORS];
} along_row;

/* A row on its way. */
typedef struct {
    const uint8_t *cost;
    uint8_t *detours;
    uint8_t *sums;
    uint8_t *slots[VERTICAL_PATHS], *last[VERTICAL_PATHS]; /* the pixel's places; behind which they begin anew */
    row_notes notes;
    ptrdiff_t y;
} moving_row;

/* Slots from -1 to `depth`: slot i of the result is slot i + difference of `slots`, if there is one. */
static const uint8_t *shifted(const uint8_t *slots, int64_t difference, ptrdiff_t depth, uint8_t *scratch) {
    memset(scratch, NO_SLOT, (size_t)(depth + 2 * BYTES));
    const int64_t first = difference > 0 ? -1 : -difference;
    const int64_t end = difference < 0 ? depth + 1 : depth - difference;
    if (end > first) {
        memcpy(scratch + BYTES + first, slots + first + difference, (size_t)(end - first));
    }
    return scratch + BYTES;
}

/* The same of the path along the row; `beside` is what lies beneath and above its slots then. */
static __attribute__((noinline)) void shift_along(const sweep_state *s, int64_t difference, along_row *along,
                                                  vector beside[2]) {
    uint8_t unshifted[MAX_DEPTH], scratch[MAX_DEPTH + 2 * BYTES];
    const ptrdiff_t depth = s->size.depth;
    ptrdiff_t stored = 0;
    do { /* at least one, as the compiler cannot know */
        store(unshifted + BYTES * stored, along->slots[stored]);
    } while (++stored < depth / BYTES);
    const uint8_t *slots = shifted(unshifted, difference, depth, scratch);
    for (ptrdiff_t i = 0; i < depth / BYTES; i++) {
        along->slots[i] = load(slots + BYTES * i);
    }
    beside[0] = load(slots - BYTES);
    beside[1] = load(slots + depth);
}

/* What a path adds to the cost, from the slots of the pixel before. */
ALWAYS_INLINE vector detour_of(vector below, vector same, vector above, vector p1, vector p2) {
    return lesser(lesser(same, add(lesser(below, above), p1)), p2);
}

/* Pixel x of a row. */
ALWAYS_INLINE void sweep_pixel(const sweep_state *s, moving_row *row, along_row *along, const uint32_t *penalties,
                               vector p1, ptrdiff_t x, const ptrdiff_t depth, const int backward) {
    const ptrdiff_t direction = backward ? -1 : 1, vectors = depth / BYTES;
    const ptrdiff_t grey = row->notes.grey[x];
    uint8_t scratch[VERTICAL_PATHS][MAX_DEPTH + 2 * BYTES];
    const uint8_t *before[VERTICAL_PATHS];
    vector p2[PATHS];
    for (int k = 0; k < VERTICAL_PATHS; k++) {
        before[k] = row->slots[k];
        p2[k] = repeat_word(penalties[row->notes.grey_before[x + (k - 1) * direction] - grey]);
    }
    p2[VERTICAL_PATHS] = repeat_word(penalties[row->notes.grey[x - direction] - grey]);
    vector beside = repeat_byte(NO_SLOT), last_above = beside;
    if (__builtin_expect(row->notes.far[x], 0)) {
        const ptrdiff_t width = s->size.width;
        const int32_t *base = s->base + row->y * width + x;
        for (int k = 0; k < VERTICAL_PATHS; k++) {
            if (row->notes.far[x] >> k & 1) {
                const int64_t difference = (int64_t)*base - base[direction * (k - 1 - width)];
                before[k] = shifted(before[k], difference, depth, scratch[k]);
            }
        }
        if (row->notes.far[x] >> 3) {
            along_row copy = *along; /* so that the usual case needs no address of it */
            vector new_beside[2];
            shift_along(s, (int64_t)*base - base[-direction], &copy, new_beside);
            *along = copy;
            beside = new_beside[0];
            last_above = new_beside[1];
        }
    }
    const uint8_t *pixel_cost = row->cost + x * depth;
    uint8_t *detours = row->detours + x * depth;
    uint8_t *sums = backward ? row->sums + x * depth : NULL;
    vector paths[PATHS][MAX_VECTORS], least[PATHS];
#if BYTES == 16 /* or clang keeps `paths` in memory */
#pragma GCC unroll 4
#endif
    for (ptrdiff_t i = 0; i < vectors; i++) {
        const vector cost = load(pixel_cost + BYTES * i);
        if (BYTES >= 32 || i % 4 == 0) { /* no more than twice per line of the cache */
            prefetch(pixel_cost, BYTES * i + direction * AHEAD);
            prefetch(detours, BYTES * i + direction * AHEAD);
        }
        vector detour[PATHS];
        for (int k = 0; k < VERTICAL_PATHS; k++) {
            const uint8_t *slots = before[k] + BYTES * i;
            detour[k] = detour_of(load(slots - 1), load(slots), load(slots + 1), p1, p2[k]);
        }
        const vector old = along->slots[i], next = i + 1 < vectors ? along->slots[i + 1] : last_above;
        detour[VERTICAL_PATHS] = detour_of(one_up(beside, old), old, one_down(old, next), p1, p2[VERTICAL_PATHS]);
        beside = old;
        for (int k = 0; k < PATHS; k++) {
            paths[k][i] = add(cost, detour[k]);
            least[k] = i == 0 ? paths[k][i] : lesser(least[k], paths[k][i]);
        }
        const vector sum = add_saturated(add(detour[0], detour[1]), add(detour[2], detour[3]));
        if (backward) {
            const vector half = average(load(detours + BYTES * i), sum), twice = add(cost, cost);
            store(sums + BYTES * i, add_saturated(half, add(twice, twice)));
        } else {
            store(detours + BYTES * i, sum);
        }
    }
    spread_minima(least);
#if BYTES == 16
#pragma GCC unroll 4
#endif
    for (ptrdiff_t i = 0; i < vectors; i++) {
        for (int k = 0; k < VERTICAL_PATHS; k++) {
            store(row->slots[k] + BYTES * i, subtract(paths[k][i], least[k]));
        }
        along->slots[i] = subtract(paths[VERTICAL_PATHS][i], least[VERTICAL_PATHS]);
    }
    for (int k = 0; k < VERTICAL_PATHS; k++) {
        const ptrdiff_t places = row->slots[k] == row->last[k] ? 1 - places_of(s->size) : 1;
        row->slots[k] += direction * places * pixel_stride(depth);
    }
}

/* ---- rows -------------------------------------------------------------------------------------------------- */

ALWAYS_INLINE void sweep_group(sweep_state *s, ptrdiff_t y, const uint8_t *cost, uint8_t *detours, uint8_t *sums,
                               const ptrdiff_t rows, const ptrdiff_t depth, const int backward) {
    const ptrdiff_t direction = backward ? -1 : 1, width = s->size.width;
    const vector p1 = repeat_byte(s->penalties.p1);
    const uint32_t *p2 = penalties_of(s);
    along_row along[ROWS];
    moving_row moving[ROWS];
    row_span spans[ROWS], both = {width, 0};
    for (ptrdiff_t r = 0; r < rows; r++) {
        const ptrdiff_t step_to = r * direction * width * depth;
        moving[r] = (moving_row){.cost = cost + step_to,
                                 .detours = detours + step_to,
                                 .sums = backward ? sums + step_to : NULL,
                                 .notes = notes_of(s, r),
                                 .y = y + r * direction};
        spans[r] = span_of(s, moving[r].y);
        both.first = spans[r].first < both.first ? spans[r].first : both.first;
        both.end = spans[r].end > both.end ? spans[r].end : both.end;
        const ptrdiff_t start = backward ? spans[r].end - 1 : spans[r].first;
        prepare_row(s, moving[r].y, s->done + r, moving[r].notes);
        for (int k = 0; k < VERTICAL_PATHS; k++) {
            moving[r].slots[k] = slots_of(s, place_of(s, s->done + r, start, k), k);
            moving[r].last[k] = slots_of(s, backward ? 0 : places_of(s->size) - 1, k);
        }
        for (ptrdiff_t i = 0; i < depth / BYTES; i++) {
            along[r].slots[i] = repeat_byte(0);
        }
    }
    const ptrdiff_t start = backward ? both.end - 1 : both.first;
    for (ptrdiff_t m = 0; m < both.end - both.first + (rows - 1) * LAG; m++) {
#pragma GCC unroll 4
        for (ptrdiff_t r = 0; r < rows; r++) {
            const ptrdiff_t x = start + (m - r * LAG) * direction;
            if (rows == 1 || (x >= spans[r].first && x < spans[r].end)) {
                sweep_pixel(s, &moving[r], &along[r], p2, p1, x, depth, backward);
            }
        }
    }
    s->done += rows;
}

ALWAYS_INLINE void sweep_rows_of(sweep_state *s, ptrdiff_t y, ptrdiff_t rows, const uint8_t *cost,
                                 uint8_t *detours, uint8_t *sums, const ptrdiff_t depth, const int backward) {
    const ptrdiff_t direction = backward ? -1 : 1, row_size = direction * s->size.width * depth;
    ptrdiff_t r = 0;
    for (; r + ROWS <= rows && s->size.width > 0; r += ROWS) {
        sweep_group(s, y + r * direction, cost + r * row_size, detours + r * row_size,
                    backward ? sums + r * row_size : NULL, ROWS, depth, backward);
    }
    for (; r < rows && s->size.width > 0; r++) {
        sweep_group(s, y + r * direction, cost + r * row_size, detours + r * row_size,
                    backward ? sums + r * row_size : NULL, 1, depth, backward);
    }
}

/* The usual numbers of disparities as constants, for which the compiler keeps slots in registers. */
#define SWEEP_OF(depth) \
    s->backward ? sweep_rows_of(s, y, rows, cost, detours, sums, depth, 1) \
                : sweep_rows_of(s, y, rows, cost, detours, sums, depth, 0)

void VERSION_OF(sweep_rows)(sweep_state *s, ptrdiff_t y, ptrdiff_t rows, const uint8_t *cost, uint8_t *detours,
                            uint8_t *sums) {
#if BYTES == 64
    if (s->size.depth % BYTES) {
        sweep_rows_avx2(s, y, rows, cost, detours, sums);
        return;
    }
#endif
    switch (s->size.depth) {
#if BYTES <= 32
    case 32:
        SWEEP_OF(32);
        break;
#endif
    case 64:
        SWEEP_OF(64);
        break;
    case 128:
        SWEEP_OF(128);
        break;
    default:
        SWEEP_OF(s->size.depth);
    }
}
