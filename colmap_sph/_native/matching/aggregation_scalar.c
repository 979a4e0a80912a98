/* Path aggregation of semi-global matching (Hirschmueller 2008, eq. 13), 8 paths in two sweeps:
 *
 *     L(p, d) = C(p, d) + min(L(q, d), L(q, d - 1) + P1, L(q, d + 1) + P1, min_k L(q, k) + P2) - min_k L(q, k)
 *
 * q is the pixel before p on the path. d is a column offset into the target, so slot i of p meets slot
 * i + base(p) - base(q) of q; but where the bases differ by no more than `max_slant`, they follow a slanted
 * surface, and slot i meets slot i (an orientation prior as in Scharstein et al. 2017,
 * doi:10.1109/3DV.2017.00033). Slots that q does not have are no way to come.
 *
 * What is kept of q is L(q, d) - min_k L(q, k). 8 bits are enough: what a path adds to C <= 62, its detour, is at
 * most P2 <= 127. Four paths' detours are summed in 8 bits, too, up to 255: beyond are slots that no path favours.
 * The sum over all paths comes in halves, up to 255, too:
 *
 *     S(p, d) = (forward detours + backward detours + 1) / 2 + 4 C(p, d) */
#include <stdlib.h>
#include <string.h>

#include "aligned_memory.h"
#include "matching/rows.h"

static uint8_t slot_or_max(const uint8_t *slots, ptrdiff_t depth, ptrdiff_t i) {
    return i >= 0 && i < depth ? slots[i] : NO_SLOT;
}

static uint8_t min_u8(int a, int b) { return (uint8_t)(a < b ? a : b); }

/* One step of one path: from `before` (NULL where the path begins, where L = C) to `path`; the detours are added
 * to those of other paths. */
static void path_step(const uint8_t *cost, const uint8_t *before, ptrdiff_t depth, int64_t shift, uint8_t p1,
                      uint8_t p2, uint8_t *path, uint8_t *detours) {
    uint8_t least = 255;
    for (ptrdiff_t i = 0; i < depth; i++) {
        uint8_t detour = 0;
        if (before) {
            const ptrdiff_t same = i + shift;
            const int below = slot_or_max(before, depth, same - 1), above = slot_or_max(before, depth, same + 1);
            detour = min_u8(min_u8(slot_or_max(before, depth, same), p2), (uint8_t)(min_u8(below, above) + p1));
        }
        detours[i] = min_u8(detours[i] + detour, 255);
        path[i] = (uint8_t)(cost[i] + detour);
        least = min_u8(least, path[i]);
    }
    for (ptrdiff_t i = 0; i < depth; i++) {
        path[i] -= least;
    }
}

size_t sweep_bytes_scalar(match_size size) {
    /* This row and the one before, of four paths; and a pixel's detours. */
    return (size_t)((8 * size.width + 1) * size.depth);
}

int sweep_begin_scalar(sweep_state *state, const int32_t *base, const uint8_t *image, match_size size,
                       path_penalties penalties, int backward) {
    *state =
        (sweep_state){.base = base, .image = image, .size = size, .penalties = penalties, .backward = backward};
    state->memory_size = sweep_bytes_scalar(size);
    state->memory = allocate_aligned(64, state->memory_size);
    return state->memory ? 0 : -1;
}

/* The four paths that come from pixels already visited, top-left to bottom-right or back. */
static void sweep_row(sweep_state *s, ptrdiff_t y, const uint8_t *cost, uint8_t *detours, uint8_t *sums) {
    const ptrdiff_t step = s->backward ? -1 : 1, width = s->size.width, depth = s->size.depth;
    uint8_t *rows[2][4]; /* [this row or the one before][path] */
    for (ptrdiff_t k = 0; k < 8; k++) {
        rows[(k / 4 + s->done) & 1][k % 4] = s->memory + k * width * depth;
    }
    uint8_t *sum = s->memory + 8 * width * depth;
    const row_span own = span_of(s, y), none = {0, 0}, above = s->done > 0 ? span_of(s, y - step) : none;
    for (ptrdiff_t m = own.first; m < own.end; m++) {
        const ptrdiff_t x = s->backward ? own.end - 1 - (m - own.first) : m;
        const ptrdiff_t p = y * width + x;
        memset(sum, 0, (size_t)depth);
        for (int path = 0; path < 4; path++) {
            /* Path 0 comes along the row, 1 to 3 from the three neighbours in the row before. */
            const ptrdiff_t before_x = path == 0 ? x - step : x + (path - 2) * step;
            const row_span span = path == 0 ? own : above;
            const int inside = before_x >= span.first && before_x < span.end;
            const ptrdiff_t q = (path == 0 ? y : y - step) * width + before_x;
            const uint8_t *before = inside ? rows[path > 0][path] + before_x * depth : NULL;
            const int64_t difference = inside ? (int64_t)s->base[p] - s->base[q] : 0;
            const int contrast = inside ? abs(s->image[p] - s->image[q]) : 0;
            path_step(cost + x * depth, before, depth,
                      llabs(difference) <= s->penalties.max_slant ? 0 : difference, s->penalties.p1,
                      s->penalties.p2[contrast], rows[0][path] + x * depth, sum);
        }
        for (ptrdiff_t i = 0; i < depth; i++) {
            const ptrdiff_t slot = x * depth + i;
            if (s->backward) {
                sums[slot] = min_u8((detours[slot] + sum[i] + 1) / 2 + (uint8_t)(4 * cost[slot]), 255);
            } else {
                detours[slot] = sum[i];
            }
        }
    }
    s->done++;
}

void sweep_rows_scalar(sweep_state *s, ptrdiff_t y, ptrdiff_t rows, const uint8_t *cost, uint8_t *detours,
                       uint8_t *sums) {
    const ptrdiff_t step = s->backward ? -1 : 1;
    for (ptrdiff_t r = 0; r < rows; r++) {
        const ptrdiff_t row = r * step * s->size.width * s->size.depth;
        sweep_row(s, y + r * step, cost + row, detours + row, s->backward ? sums + row : NULL);
    }
}
