#include "images/images.h"
#include "images/ray_place.h"
#include "version.h"

/* A row of rectified pixels, whose rays are `row` times their weights, and what their columns add. */
static void source_row(const float *row, const float *restrict across, const float *restrict down,
                       const float *restrict away, const float *restrict weights, ptrdiff_t width,
                       const float *size, float *restrict columns, float *restrict rows,
                       uint8_t *restrict inside) {
    const float row_x = row[0], row_y = row[1], row_z = row[2], source_width = size[0], source_height = size[1];
    for (ptrdiff_t x = 0; x < width; x++) {
        const ray_place place = place_of_ray(row_x, row_y, row_z, weights[x], across[x], down[x], away[x],
                                             source_width, source_height);
        columns[x] = place.column;
        rows[x] = place.row;
        inside[x] = (uint8_t)-place.inside;
    }
}

void VERSION_OF(source_pixels)(ray_tables tables, float source_width, float source_height, float *columns,
                               float *rows, uint8_t *inside) {
    const ptrdiff_t height = tables.height, width = tables.width;
    const float *across = tables.columns, *down = across + width, *away = down + width;
    const float size[2] = {source_width, source_height};
    for (ptrdiff_t y = 0; y < height; y++) {
        const float row[3] = {tables.rows[y], tables.rows[height + y], tables.rows[2 * height + y]};
        source_row(row, across, down, away, tables.weights, width, size, columns + y * width, rows + y * width,
                   inside + y * width);
    }
}
