#include "matching/rows.h"

#include <stdlib.h>
#include <string.h>

#include "aligned_memory.h"

uint64_t *cost_row_buffer(match_size size) {
    /* Three words per pixel: room for 17 planes of bytes, whose lines are filled up. */
    const size_t padded_width = (size_t)(size.target_width + 2 * size.depth) + 128;
    return malloc(3 * padded_width * sizeof(uint64_t));
}

int selection_begin(selection_buffers *buffers, match_size size) {
    /* Three more, as vectorised versions read four at once. */
    const ptrdiff_t best_sums = size.target_width + 2 * size.depth + 3;
    const size_t words = (size_t)(size.width + size.source_width);
    buffers->winner = malloc(words * sizeof(int32_t) + (size_t)best_sums);
    if (!buffers->winner) {
        return -1;
    }
    buffers->best = (uint32_t *)(buffers->winner + size.width);
    buffers->best_sum = (uint8_t *)(buffers->best + size.source_width);
    return 0;
}

/* Whether target pixels are those of the source, which was not warped. Each then stands for itself. */
static int are_the_source(const int32_t *columns, match_size size) {
    int32_t w = 0;
    while (w < (int32_t)size.target_width && columns[w] == w) {
        w++;
    }
    return w == (int32_t)size.target_width && size.target_width <= size.source_width;
}

/* Whether nothing points at eight target pixels. */
static int are_passed_over(const uint8_t *best_sum) {
    uint64_t eight;
    memcpy(&eight, best_sum, sizeof eight);
    return eight == UINT64_MAX;
}

void merge_columns(const int32_t *columns, match_size size, selection_buffers *buffers) {
    /* Where a surface is stretched, its target pixels skip columns of the source: they stand for these, too. */
    enum { MAX_STRETCH = 4 };
    const int32_t source_width = (int32_t)size.source_width, target_width = (int32_t)size.target_width;
    buffers->columns = are_the_source(columns, size) ? NULL : columns;
    if (!buffers->columns) {
        return;
    }
    const uint8_t *best_sum = buffers->best_sum + size.depth;
    uint32_t *best = buffers->best;
    memset(best, UINT8_MAX, (size_t)source_width * sizeof *best);
    for (int32_t w = 0; w < target_width; w++) {
        while (w + 8 <= target_width && are_passed_over(best_sum + w)) {
            w += 8;
        }
        if (w == target_width) {
            break;
        }
        const int32_t first = columns[w];
        /* Those that nothing points at have no say. */
        if (best_sum[w] == UINT8_MAX || first < 0 || first >= source_width) {
            continue;
        }
        const uint32_t own = (uint32_t)best_sum[w] << 24 | (uint32_t)w;
        best[first] = own < best[first] ? own : best[first];
        const uint32_t step = w + 1 < target_width ? (uint32_t)columns[w + 1] - (uint32_t)first : 1;
        for (uint32_t i = 1; i < step && step <= MAX_STRETCH && first + (int32_t)i < source_width; i++) {
            uint32_t *skipped = best + first + i;
            *skipped = own < *skipped ? own : *skipped;
        }
    }
}

int cost_of_rows(const row_kernels *kernels, const uint64_t *reference, const uint64_t *target,
                 const int32_t *base, match_size size, uint8_t *cost) {
    uint64_t *buffer = cost_row_buffer(size);
    const int status = buffer ? 0 : -1;
    for (ptrdiff_t y = 0; !status && y < size.height; y++) {
        kernels->cost_row(reference + y * size.width, target + y * size.target_width, base + y * size.width, size,
                          (row_span){0, size.width}, buffer, cost + y * size.width * size.depth);
    }
    free(buffer);
    return status;
}

int aggregate_rows(const row_kernels *kernels, const uint8_t *cost, const int32_t *base, const uint8_t *image,
                   match_size size, path_penalties penalties, uint8_t *detours, uint8_t *aggregated) {
    for (int backward = 0; backward < 2; backward++) {
        sweep_state state;
        if (kernels->sweep_begin(&state, base, image, size, penalties, backward)) {
            return -1;
        }
        const ptrdiff_t y = backward ? size.height - 1 : 0, row = y * size.width * size.depth;
        if (size.height > 0) {
            kernels->sweep_rows(&state, y, size.height, cost + row, detours + row,
                                backward ? aggregated + row : NULL);
        }
        free_aligned(state.memory);
    }
    return 0;
}

int select_rows(const row_kernels *kernels, const uint8_t *aggregated, const int32_t *base,
                const uint64_t *reference, const uint64_t *target, const int32_t *columns, match_size size,
                left_right_check check, int32_t *offset) {
    selection_buffers buffers;
    if (selection_begin(&buffers, size)) {
        return -1;
    }
    for (ptrdiff_t y = 0; y < size.height; y++) {
        const ptrdiff_t row = y * size.width;
        kernels->selection_row(aggregated + row * size.depth, base + row, reference + row,
                               target + y * size.target_width, columns + y * size.target_width, size, check,
                               &buffers, offset + row);
    }
    free(buffers.winner);
    return 0;
}

/* ---- the matcher ------------------------------------------------------------------------------------------- */

typedef struct {
    const row_kernels *kernels;
    const match_input *input;
    ptrdiff_t row_size;
    row_span *spans;
    uint64_t *cost_buffer;
    uint8_t *row_sums;
    selection_buffers selection;
    sweep_state forward, backward;
} matcher;

/* A group is as many rows as are swept at once and still are in the cache for the next step. */
enum { GROUP = 2 };

static void cost_rows(matcher *m, ptrdiff_t y, ptrdiff_t rows, uint8_t *cost) {
    const match_input *in = m->input;
    for (ptrdiff_t r = y; r < y + rows; r++) {
        m->kernels->cost_row(in->reference + r * in->size.width, in->target + r * in->size.target_width,
                             in->base + r * in->size.width, in->size, m->spans[r], m->cost_buffer,
                             cost + (r - y) * m->row_size);
    }
}

static void forward_rows(matcher *m, ptrdiff_t y, ptrdiff_t rows, uint8_t *cost, uint8_t *detours) {
    cost_rows(m, y, rows, cost);
    m->kernels->sweep_rows(&m->forward, y, rows, cost, detours, NULL);
}

/* Rows up to y, whose costs and forward detours are given. */
static void backward_rows(matcher *m, ptrdiff_t y, ptrdiff_t rows, const uint8_t *cost, uint8_t *detours,
                          int32_t *offset) {
    const match_input *in = m->input;
    uint8_t *row_sums = m->row_sums + (rows - 1) * m->row_size;
    m->kernels->sweep_rows(&m->backward, y, rows, cost, detours, row_sums);
    for (ptrdiff_t r = 0; r < rows; r++) {
        const ptrdiff_t row = (y - r) * in->size.width;
        m->kernels->selection_row(row_sums - r * m->row_size, in->base + row, in->reference + row,
                                  in->target + (y - r) * in->size.target_width,
                                  in->columns + (y - r) * in->size.target_width, in->size, in->check,
                                  &m->selection, offset + row);
    }
}

static ptrdiff_t lesser(ptrdiff_t a, ptrdiff_t b) { return a < b ? a : b; }

static void find_spans(const uint64_t *reference, match_size size, row_span *spans) {
    for (ptrdiff_t y = 0; y < size.height; y++, reference += size.width) {
        ptrdiff_t first = 0, end = size.width;
        while (first < end && reference[first] & CENSUS_INVALID) {
            first++;
        }
        while (end > first && reference[end - 1] & CENSUS_INVALID) {
            end--;
        }
        spans[y] = (row_span){first, end};
    }
}

/* What a matcher works in; -1 without memory. matcher_end in any case. */
static int matcher_begin(matcher *m, const row_kernels *kernels, const match_input *in) {
    *m = (matcher){.kernels = kernels, .input = in, .row_size = in->size.width * in->size.depth};
    if (kernels->sweep_begin(&m->forward, in->surface, in->image, in->size, in->penalties, 0) ||
        kernels->sweep_begin(&m->backward, in->surface, in->image, in->size, in->penalties, 1) ||
        selection_begin(&m->selection, in->size)) {
        return -1;
    }
    m->cost_buffer = cost_row_buffer(in->size);
    m->row_sums = malloc(((size_t)(m->row_size * GROUP) + 1) * sizeof *m->row_sums);
    m->spans = malloc(((size_t)in->size.height + 1) * sizeof *m->spans);
    if (!m->cost_buffer || !m->row_sums || !m->spans) {
        return -1;
    }
    find_spans(in->reference, in->size, m->spans);
    m->forward.spans = m->backward.spans = m->spans;
    return 0;
}

static void matcher_end(matcher *m) {
    free(m->spans);
    free(m->row_sums);
    free(m->cost_buffer);
    free(m->selection.winner);
    free_aligned(m->backward.memory);
    free_aligned(m->forward.memory);
}

/* A sweep goes on where `state` was noted. */
static void resume(sweep_state *sweep, ptrdiff_t done, const uint8_t *state) {
    sweep->done = done;
    if (done > 0) {
        memcpy(sweep->memory, state, sweep->memory_size);
    }
}

int sweep_over_rows(const row_kernels *kernels, const match_input *in, row_band band, int backward,
                    uint8_t *state) {
    matcher m;
    int status = matcher_begin(&m, kernels, in);
    /* Costs, and detours that nobody reads, of a group. */
    uint8_t *group = status ? NULL : calloc((size_t)(2 * GROUP * m.row_size) + 1, 1);
    if (group) {
        uint8_t *cost = group, *detours = group + GROUP * m.row_size;
        sweep_state *sweep = backward ? &m.backward : &m.forward;
        resume(sweep, backward ? band.below : band.above, state);
        for (ptrdiff_t n = 0, rows; n < band.end - band.first; n += rows) {
            rows = lesser(GROUP, band.end - band.first - n);
            const ptrdiff_t first = backward ? band.end - n - rows : band.first + n;
            const ptrdiff_t last = backward ? rows - 1 : 0; /* where the sweep begins, in the group */
            cost_rows(&m, first, rows, cost);
            kernels->sweep_rows(sweep, first + last, rows, cost + last * m.row_size, detours + last * m.row_size,
                                m.row_sums + last * m.row_size);
        }
        memcpy(state, sweep->memory, sweep->memory_size);
    } else {
        status = -1;
    }
    free(group);
    matcher_end(&m);
    return status;
}

int match_rows(const row_kernels *kernels, const match_input *in, row_band band, uint8_t *forward,
               uint8_t *backward, uint8_t *scratch, int32_t *offset) {
    matcher m;
    const int status = matcher_begin(&m, kernels, in);
    if (!status) {
        const ptrdiff_t count = band.end - band.first;
        uint8_t *cost = scratch, *detours = scratch + count * m.row_size;
        resume(&m.forward, band.above, forward);
        resume(&m.backward, band.below, backward);
        for (ptrdiff_t n = 0; n < count; n += GROUP) {
            forward_rows(&m, band.first + n, lesser(GROUP, count - n), cost + n * m.row_size,
                         detours + n * m.row_size);
        }
        for (ptrdiff_t n = count; n > 0; n -= lesser(GROUP, n)) {
            backward_rows(&m, band.first + n - 1, lesser(GROUP, n), cost + (n - 1) * m.row_size,
                          detours + (n - 1) * m.row_size, offset - band.first * in->size.width);
        }
        memcpy(forward, m.forward.memory, m.forward.memory_size);
        memcpy(backward, m.backward.memory, m.backward.memory_size);
    }
    matcher_end(&m);
    return status;
}
