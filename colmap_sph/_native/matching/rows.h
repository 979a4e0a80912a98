/* The matching kernels row by row, so that the matcher can pass rows from one to the next while in cache.
 * All pointers to pixels are to the row in question unless said otherwise. */
#ifndef COLMAP_SPH_ROWS_H
#define COLMAP_SPH_ROWS_H

#include "matching/matching.h"

/* The line of the cache `offset` bytes from `row`, which may lie outside of it. */
ALWAYS_INLINE void prefetch(const void *row, ptrdiff_t offset) {
    __builtin_prefetch((const void *)((uintptr_t)row + (uintptr_t)offset));
}

/* From the first pixel of a row with content to behind the last: what lies outside is not worked on. */
typedef struct {
    ptrdiff_t first, end;
} row_span;

/* ---- matching cost ----------------------------------------------------------------------------------------- */

/* Costs of one row, `size.depth` for each pixel of the span, in their places among `size.width`; `buffer` is one
 * of cost_row_buffer. */
typedef void cost_row_fn(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                         row_span span, uint64_t *buffer, uint8_t *cost);
/* Room for one target row with `depth` unseen pixels on both sides, in three words each; NULL without memory. */
uint64_t *cost_row_buffer(match_size size);

/* ---- path aggregation -------------------------------------------------------------------------------------- */

/* One sweep over the image, four paths at once, forward (from the top left) or backward. `memory` holds all that a
 * row leaves to the next. */
typedef struct {
    const int32_t *base;   /* of the whole image, */
    const uint8_t *image;  /* as this one */
    const row_span *spans; /* of each row, outside of which paths begin and end; NULL: all pixels */
    match_size size;
    path_penalties penalties;
    int backward;
    ptrdiff_t done; /* rows */
    uint8_t *memory;
    size_t memory_size;
} sweep_state;

ALWAYS_INLINE row_span span_of(const sweep_state *s, ptrdiff_t y) {
    return s->spans ? s->spans[y] : (row_span){0, s->size.width};
}

/* 0, or -1 without memory; ended by free_aligned(state->memory). Without spans, at first. */
typedef int sweep_begin_fn(sweep_state *state, const int32_t *base, const uint8_t *image, match_size size,
                           path_penalties penalties, int backward);
/* The next `rows` rows, from y on. A forward sweep writes `detours`; a backward one, whose rows lie before the one
 * that the pointers are to, reads them and writes `sums`. */
typedef void sweep_rows_fn(sweep_state *state, ptrdiff_t y, ptrdiff_t rows, const uint8_t *cost, uint8_t *detours,
                           uint8_t *sums);

/* ---- selection --------------------------------------------------------------------------------------------- */

typedef struct {
    int32_t *winner;        /* of every pixel its best slot; -1 without content */
    uint8_t *best_sum;      /* of every target pixel the least of its own, with `depth` more on both sides */
    uint32_t *best;         /* of every source column the least sum, and in 24 bits the target pixel that has it */
    const int32_t *columns; /* of the source, by target pixel; NULL where each pixel stands for itself */
} selection_buffers;

/* 0, or -1 without memory; ended by free(buffers->winner). */
int selection_begin(selection_buffers *buffers, match_size size);
/* Sets the least sums of source columns, from those of the target pixels that show them. */
void merge_columns(const int32_t *columns, match_size size, selection_buffers *buffers);
typedef void selection_row_fn(const uint8_t *sums, const int32_t *base, const uint64_t *reference,
                              const uint64_t *target, const int32_t *columns, match_size size,
                              left_right_check check, selection_buffers *buffers, int32_t *offset);

/* The second half of selection: what is left of `buffers->winner`, fitted. */
typedef void check_winners_fn(const uint8_t *sums, const int32_t *base, const uint64_t *target, match_size size,
                              left_right_check check, const selection_buffers *buffers, int32_t *offset);
check_winners_fn check_winners_scalar, check_winners_avx2;

/* ---- whole images from rows -------------------------------------------------------------------------------- */

typedef struct {
    cost_row_fn *cost_row;
    sweep_begin_fn *sweep_begin;
    sweep_rows_fn *sweep_rows;
    selection_row_fn *selection_row;
} row_kernels;

cost_row_fn cost_row_scalar, cost_row_avx2, cost_row_avx512, cost_row_neon;
sweep_bytes_fn sweep_bytes_scalar, sweep_bytes_avx2, sweep_bytes_avx512, sweep_bytes_neon;
sweep_begin_fn sweep_begin_scalar, sweep_begin_avx2, sweep_begin_avx512, sweep_begin_neon;
sweep_rows_fn sweep_rows_scalar, sweep_rows_avx2, sweep_rows_avx512, sweep_rows_neon;
selection_row_fn selection_row_scalar, selection_row_avx2, selection_row_avx512, selection_row_neon;

int cost_of_rows(const row_kernels *kernels, const uint64_t *reference, const uint64_t *target,
                 const int32_t *base, match_size size, uint8_t *cost);
int aggregate_rows(const row_kernels *kernels, const uint8_t *cost, const int32_t *base, const uint8_t *image,
                   match_size size, path_penalties penalties, uint8_t *detours, uint8_t *aggregated);
int select_rows(const row_kernels *kernels, const uint8_t *aggregated, const int32_t *base,
                const uint64_t *reference, const uint64_t *target, const int32_t *columns, match_size size,
                left_right_check check, int32_t *offset);
int sweep_over_rows(const row_kernels *kernels, const match_input *input, row_band band, int backward,
                    uint8_t *state);
int match_rows(const row_kernels *kernels, const match_input *input, row_band band, uint8_t *forward,
               uint8_t *backward, uint8_t *scratch, int32_t *offset);

#endif
