#include "images/images.h"
#include "version.h"

/* Rays of length about 1 whose depth is less lie beside the camera. */
static const float LEAST_DEPTH = 1e-6f;

/* A row of rectified pixels, whose rays are `row` times their weights, and what their columns add. */
static void source_row(const float *row, const float *restrict across, const float *restrict down,
                       const float *restrict away, const float *restrict weights, ptrdiff_t width,
                       const float *size, float *restrict columns, float *restrict rows,
                       uint8_t *restrict inside) {
    const float row_x = row[0], row_y = row[1], row_z = row[2], source_width = size[0], source_height = size[1];
    for (ptrdiff_t x = 0; x < width; x++) {
        const float z = row_z * weights[x] + away[x], scale = z > LEAST_DEPTH ? 1 / z : z;
        const float u = (row_x * weights[x] + across[x]) * scale, v = (row_y * weights[x] + down[x]) * scale;
        const int32_t in = (z > LEAST_DEPTH) & (u >= 0) & (u <= source_width) & (v >= 0) & (v <= source_height);
        /* COLMAP counts from the pixel's corner. */
        columns[x] = u - 0.5f;
        rows[x] = v - 0.5f;
        inside[x] = (uint8_t)-in;
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
