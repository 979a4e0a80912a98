#include "rows.h"

#include <stdlib.h>
#include <string.h>

uint64_t *cost_row_buffer(match_size size) {
    const ptrdiff_t padded_width = size.target_width + 2 * size.depth;
    uint64_t *buffer = malloc((size_t)padded_width * sizeof *buffer);
    for (ptrdiff_t i = 0; buffer && i < padded_width; i++) {
        buffer[i] = CENSUS_INVALID;
    }
    return buffer;
}

int selection_begin(selection_buffers *buffers, match_size size) {
    const ptrdiff_t keys = (size.target_width + 2 * size.depth + 1) / 2 * 2;
    buffers->keys = malloc((size_t)(keys + size.width) * sizeof *buffers->keys);
    buffers->winner = buffers->keys ? (int32_t *)(buffers->keys + keys) : NULL;
    return buffers->keys ? 0 : -1;
}

int cost_of_rows(const row_kernels *kernels, const uint64_t *reference, const uint64_t *target,
                 const int32_t *base, match_size size, uint8_t *cost) {
    uint64_t *buffer = cost_row_buffer(size);
    const int status = buffer ? 0 : -1;
    for (ptrdiff_t y = 0; !status && y < size.height; y++) {
        kernels->cost_row(reference + y * size.width, target + y * size.target_width, base + y * size.width, size,
                          buffer, cost + y * size.width * size.depth);
    }
    free(buffer);
    return status;
}

int aggregate_rows(const row_kernels *kernels, const uint8_t *cost, const int32_t *base, const uint8_t *image,
                   match_size size, path_penalties penalties, uint16_t *aggregated) {
    for (int backward = 0; backward < 2; backward++) {
        sweep_state state;
        if (kernels->sweep_begin(&state, base, image, size, penalties, backward)) {
            return -1;
        }
        for (ptrdiff_t n = 0; n < size.height; n++) {
            const ptrdiff_t y = backward ? size.height - 1 - n : n, row = y * size.width * size.depth;
            kernels->sweep_row(&state, y, cost + row, backward ? aggregated + row : NULL, aggregated + row);
        }
        free(state.memory);
    }
    return 0;
}

int select_rows(const row_kernels *kernels, const uint16_t *aggregated, const int32_t *base,
                const uint64_t *reference, const uint64_t *target, match_size size,
                int32_t max_left_right_difference, int32_t *offset) {
    selection_buffers buffers;
    if (selection_begin(&buffers, size)) {
        return -1;
    }
    for (ptrdiff_t y = 0; y < size.height; y++) {
        const ptrdiff_t row = y * size.width;
        kernels->selection_row(aggregated + row * size.depth, base + row, reference + row,
                               target + y * size.target_width, size, max_left_right_difference, &buffers,
                               offset + row);
    }
    free(buffers.keys);
    return 0;
}

/* ---- the matcher ------------------------------------------------------------------------------------------- */

typedef struct {
    const row_kernels *kernels;
    const match_input *input;
    ptrdiff_t row_size, band_rows;
    uint64_t *cost_buffer;
    uint16_t *row_sums;
    selection_buffers selection;
    sweep_state forward, backward;
    uint8_t *checkpoints; /* what the forward sweep brings to each band but the first */
} matcher;

static void forward_row(matcher *m, ptrdiff_t y, uint8_t *cost, uint16_t *sums) {
    const match_input *in = m->input;
    m->kernels->cost_row(in->reference + y * in->size.width, in->target + y * in->size.target_width,
                         in->base + y * in->size.width, in->size, m->cost_buffer, cost);
    m->kernels->sweep_row(&m->forward, y, cost, NULL, sums);
}

static void backward_row(matcher *m, ptrdiff_t y, const uint8_t *cost, const uint16_t *sums, int32_t *offset) {
    const match_input *in = m->input;
    const ptrdiff_t row = y * in->size.width;
    m->kernels->sweep_row(&m->backward, y, cost, sums, m->row_sums);
    m->kernels->selection_row(m->row_sums, in->base + row, in->reference + row,
                              in->target + y * in->size.target_width, in->size, in->max_left_right_difference,
                              &m->selection, offset + row);
}

/* The last band first. Its forward sweep starts from what was noted when the rows above it were swept for that
 * alone: the result is that of one piece, to the bit. */
static void match_bands(matcher *m, ptrdiff_t bands, uint16_t *sums, int32_t *offset) {
    const ptrdiff_t height = m->input->size.height, row_size = m->row_size;
    uint8_t *cost = (uint8_t *)(sums + m->band_rows * row_size);
    for (ptrdiff_t y = 0; y < (bands - 1) * m->band_rows; y++) {
        forward_row(m, y, cost, sums);
        if ((y + 1) % m->band_rows == 0) {
            const size_t band = (size_t)(y / m->band_rows);
            memcpy(m->checkpoints + band * m->forward.memory_size, m->forward.memory, m->forward.memory_size);
        }
    }
    for (ptrdiff_t band = bands - 1; band >= 0; band--) {
        const ptrdiff_t first = band * m->band_rows;
        const ptrdiff_t end = first + m->band_rows < height ? first + m->band_rows : height;
        m->forward.done = first;
        if (band > 0) {
            memcpy(m->forward.memory, m->checkpoints + (size_t)(band - 1) * m->forward.memory_size,
                   m->forward.memory_size);
        }
        for (ptrdiff_t y = first; y < end; y++) {
            forward_row(m, y, cost + (y - first) * row_size, sums + (y - first) * row_size);
        }
        for (ptrdiff_t y = end - 1; y >= first; y--) {
            backward_row(m, y, cost + (y - first) * row_size, sums + (y - first) * row_size, offset);
        }
    }
}

int match_rows(const row_kernels *kernels, const match_input *in, ptrdiff_t band_rows, uint16_t *scratch,
               int32_t *offset) {
    const ptrdiff_t bands = in->size.height > 0 ? (in->size.height + band_rows - 1) / band_rows : 0;
    matcher m = {.kernels = kernels, .input = in, .band_rows = band_rows};
    m.row_size = in->size.width * in->size.depth;
    int status = -1;
    if (!kernels->sweep_begin(&m.forward, in->base, in->image, in->size, in->penalties, 0) &&
        !kernels->sweep_begin(&m.backward, in->base, in->image, in->size, in->penalties, 1) &&
        !selection_begin(&m.selection, in->size)) {
        m.cost_buffer = cost_row_buffer(in->size);
        m.row_sums = malloc(((size_t)m.row_size + 1) * sizeof *m.row_sums);
        m.checkpoints = malloc((size_t)(bands > 1 ? bands - 1 : 1) * m.forward.memory_size);
        if (m.cost_buffer && m.row_sums && m.checkpoints) {
            match_bands(&m, bands, scratch, offset);
            status = 0;
        }
    }
    free(m.checkpoints);
    free(m.row_sums);
    free(m.cost_buffer);
    free(m.selection.keys);
    free(m.backward.memory);
    free(m.forward.memory);
    return status;
}
