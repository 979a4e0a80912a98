/* The AVX2 kernels row by row, so that the whole matcher can pass rows from one to the next while in cache. */
#ifndef COLMAP_SPH_ROWS_AVX2_H
#define COLMAP_SPH_ROWS_AVX2_H

#include "kernels.h"

enum { VERTICAL_PATHS = 3 };

/* ---- matching cost ----------------------------------------------------------------------------------------- */

/* Room for one target row with `depth` unseen pixels on both sides; NULL without memory. */
uint64_t *cost_row_buffer(match_size size);
/* Costs of one row, `size.width * size.depth` of them; all pointers but the buffer are to that row. */
void cost_row(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
              uint64_t *buffer, uint8_t *cost);

/* ---- path aggregation -------------------------------------------------------------------------------------- */

/* One sweep over the image, four paths at once, forward (from the top left) or backward. */
typedef struct {
    const int32_t *base;
    const uint8_t *image;
    match_size size;
    path_penalties penalties;
    int backward;
    ptrdiff_t done;   /* rows */
    ptrdiff_t turned; /* the same, modulo the width */
    ptrdiff_t stride; /* from pixel to pixel in `rows` */
    uint8_t *rows[VERTICAL_PATHS];
    uint8_t *memory;
} sweep_state;

int sweep_begin(sweep_state *state, const int32_t *base, const uint8_t *image, match_size size,
                path_penalties penalties, int backward);
/* The next row, y, from its costs: sums_out = sums_in (NULL: 0) + the four paths. */
void sweep_row(sweep_state *state, ptrdiff_t y, const uint8_t *cost, const uint16_t *sums_in, uint16_t *sums_out);
void sweep_end(sweep_state *state);

/* ---- selection --------------------------------------------------------------------------------------------- */

typedef struct {
    uint16_t *least, *best_column; /* of every target pixel */
} selection_buffers;

int selection_begin(selection_buffers *buffers, match_size size);
/* Offsets of one row from its sums; all pointers but the buffers are to that row. */
void selection_row(const uint16_t *sums, const int32_t *base, const uint64_t *reference, const uint64_t *target,
                   match_size size, int32_t max_left_right_difference, selection_buffers *buffers,
                   int32_t *offset);
void selection_end(selection_buffers *buffers);

#endif
