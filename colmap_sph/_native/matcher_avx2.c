/* Costs, both sweeps and the selection, row by row: costs are swept while still in cache, and the sums of all
 * paths exist for one row at a time. */
#include <stdlib.h>

#include "rows_avx2.h"

static int match_rows(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                      int32_t max_left_right_difference, uint16_t *sums, uint8_t *cost, sweep_state sweeps[2],
                      int32_t *offset) {
    const ptrdiff_t row_size = size.width * size.depth;
    uint64_t *buffer = cost_row_buffer(size);
    uint16_t *row_sums = malloc((size_t)row_size * sizeof *row_sums);
    selection_buffers selection = {0};
    const int failed = !buffer || !row_sums || selection_begin(&selection, size);
    for (ptrdiff_t y = 0; y < size.height && !failed; y++) {
        const ptrdiff_t row = y * size.width;
        cost_row(reference + row, target + y * size.target_width, base + row, size, buffer, cost + y * row_size);
        sweep_row(&sweeps[0], y, cost + y * row_size, NULL, sums + y * row_size);
    }
    for (ptrdiff_t y = size.height - 1; y >= 0 && !failed; y--) {
        const ptrdiff_t row = y * size.width;
        sweep_row(&sweeps[1], y, cost + y * row_size, sums + y * row_size, row_sums);
        selection_row(row_sums, base + row, reference + row, target + y * size.target_width, size,
                      max_left_right_difference, &selection, offset + row);
    }
    selection_end(&selection);
    free(row_sums);
    free(buffer);
    return failed ? -1 : 0;
}

int match_avx2(const uint64_t *reference, const uint64_t *target, const int32_t *base, const uint8_t *image,
               match_size size, path_penalties penalties, int32_t max_left_right_difference, uint16_t *scratch,
               int32_t *offset) {
    uint8_t *cost = (uint8_t *)(scratch + size.height * size.width * size.depth);
    sweep_state sweeps[2] = {{0}};
    int status = -1;
    if (!sweep_begin(&sweeps[0], base, image, size, penalties, 0) &&
        !sweep_begin(&sweeps[1], base, image, size, penalties, 1)) {
        status =
            match_rows(reference, target, base, size, max_left_right_difference, scratch, cost, sweeps, offset);
    }
    sweep_end(&sweeps[0]);
    sweep_end(&sweeps[1]);
    return status;
}
