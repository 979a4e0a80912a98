/* Connected regions of offsets: runs within the rows, joined with those that they touch in the row above. */
#include <stdlib.h>
#include <string.h>

#include "matching/matching.h"
#include "offsets/offsets.h"

/* Pixels of a row, from `first` to before `end`. `parent` is another run of the segment, before this one; itself
 * for the first, whose `size` is the segment's. */
typedef struct {
    int32_t first, end, parent, size;
} run;

typedef struct {
    run *runs;
    ptrdiff_t count, room;
} run_list;

ALWAYS_INLINE int are_joined(int32_t a, int32_t b) {
    /* Compilers shift negative numbers so that they round down. */
    const int64_t step = (int64_t)(a >> 6) - (b >> 6);
    _Static_assert(SEGMENT_UNIT == 1 << 6, "the shift");
    return a != OFFSET_INVALID && b != OFFSET_INVALID && step <= MAX_SEGMENT_STEP && step >= -MAX_SEGMENT_STEP;
}

static int32_t root_of(run *runs, int32_t r) {
    while (runs[r].parent != r) {
        runs[r].parent = runs[runs[r].parent].parent;
        r = runs[r].parent;
    }
    return r;
}

static void join(run *runs, int32_t a, int32_t b) {
    a = root_of(runs, a);
    b = root_of(runs, b);
    const int32_t first = a < b ? a : b, second = a < b ? b : a;
    if (first != second) {
        runs[second].parent = first;
        runs[first].size += runs[second].size;
    }
}

static int make_room(run_list *list, ptrdiff_t more) {
    if (list->count + more <= list->room) {
        return 0;
    }
    const ptrdiff_t room = 2 * list->room + more;
    run *runs = realloc(list->runs, (size_t)room * sizeof *runs);
    if (!runs) {
        return -1;
    }
    list->runs = runs;
    list->room = room;
    return 0;
}

static void add_runs(run_list *list, const int32_t *row, ptrdiff_t width) {
    for (ptrdiff_t x = 0; x < width;) {
        if (row[x] == OFFSET_INVALID) {
            x++;
            continue;
        }
        const ptrdiff_t first = x++;
        while (x < width && are_joined(row[x - 1], row[x])) {
            x++;
        }
        const int32_t own = (int32_t)list->count;
        list->runs[list->count++] = (run){(int32_t)first, (int32_t)x, own, (int32_t)(x - first)};
    }
}

/* Runs of a row, from `own` on, with those of the row above, from `above` on. */
static void join_rows(run_list *list, ptrdiff_t above, ptrdiff_t own, const int32_t *row, ptrdiff_t width) {
    run *runs = list->runs;
    const ptrdiff_t end_above = own;
    while (above < end_above && own < list->count) {
        const run *a = runs + above, *b = runs + own;
        const int32_t end = a->end < b->end ? a->end : b->end;
        for (int32_t x = a->first > b->first ? a->first : b->first; x < end; x++) {
            if (are_joined(row[x - width], row[x])) {
                join(runs, (int32_t)above, (int32_t)own);
                break;
            }
        }
        const int next_above = a->end <= b->end, next_own = b->end <= a->end;
        above += next_above;
        own += next_own;
    }
}

int remove_small_segments(int32_t *offset, ptrdiff_t height, ptrdiff_t width, ptrdiff_t min_segment) {
    run_list list = {NULL, 0, 0};
    ptrdiff_t *first_runs = malloc((size_t)(height + 1) * sizeof *first_runs);
    int failed = !first_runs;
    for (ptrdiff_t y = 0; y < height && !failed; y++) {
        const int32_t *row = offset + y * width;
        first_runs[y] = list.count;
        failed = make_room(&list, width);
        if (!failed) {
            add_runs(&list, row, width);
            if (y > 0) {
                join_rows(&list, first_runs[y - 1], first_runs[y], row, width);
            }
            first_runs[y + 1] = list.count;
        }
    }
    for (ptrdiff_t y = 0; y < height && !failed; y++) {
        for (ptrdiff_t r = first_runs[y]; r < first_runs[y + 1]; r++) {
            if (list.runs[root_of(list.runs, (int32_t)r)].size < min_segment) {
                for (int32_t x = list.runs[r].first; x < list.runs[r].end; x++) {
                    offset[y * width + x] = OFFSET_INVALID;
                }
            }
        }
    }
    free(first_runs);
    free(list.runs);
    return failed ? -1 : 0;
}
