#include "fusion/pixels.h"

void count_points(const fused_rows *rows, ptrdiff_t *points, ptrdiff_t *words) {
    const ptrdiff_t width = rows->maps->width;
    *points = *words = 0;
    for (ptrdiff_t p = rows->first_row * width; p < rows->end_row * width; p++) {
        const int views = views_of_point(rows, p);
        *points += views > 0;
        *words += views > 0 ? views + 1 : 0;
    }
}
