/* A rectified image, read between four pixels of its source. Places of a row first, then what lies there: both are
 * plain enough for compilers to work on many pixels at once. */
#include <stdlib.h>

#include "images/images.h"
#include "images/ray_place.h"
#include "version.h"

/* Of each pixel of a row the upper left one of the four that it lies between, and how far towards the others. */
typedef struct {
    int32_t *corner;
    float *right, *down;
} row_places;

/* The nearest place in an image that ends at `last`; 0 for what is no number. */
ALWAYS_INLINE float within_image(float place, float last) {
    const float least = place > 0 ? place : 0;
    return least < last ? least : last;
}

static void place_row(const float *row, const float *restrict across, const float *restrict down,
                      const float *restrict away, const float *restrict weights, ptrdiff_t width,
                      source_image source, int32_t *restrict corner, float *restrict right, float *restrict below,
                      uint8_t *restrict valid) {
    const float row_x = row[0], row_y = row[1], row_z = row[2];
    const float source_width = (float)source.width, source_height = (float)source.height;
    const int32_t stride = (int32_t)source.width, last_row = (int32_t)source.height - 2, last_column = stride - 2;
    for (ptrdiff_t x = 0; x < width; x++) {
        const ray_place place = place_of_ray(row_x, row_y, row_z, weights[x], across[x], down[x], away[x],
                                             source_width, source_height);
        const float u = within_image(place.column, source_width - 1);
        const float v = within_image(place.row, source_height - 1);
        const int32_t whole_u = (int32_t)u, whole_v = (int32_t)v;
        const int32_t column = whole_u < last_column ? whole_u : last_column;
        const int32_t line = whole_v < last_row ? whole_v : last_row;
        corner[x] = line * stride + column;
        right[x] = u - (float)column;
        below[x] = v - (float)line;
        valid[x] = (uint8_t)-place.inside;
    }
}

static void read_row(const float *restrict image, ptrdiff_t stride, const int32_t *restrict corner,
                     const float *restrict right, const float *restrict down, ptrdiff_t width,
                     float *restrict grey) {
    const float *next = image + stride;
    for (ptrdiff_t x = 0; x < width; x++) {
        const int32_t at = corner[x];
        const float upper = image[at] + (image[at + 1] - image[at]) * right[x];
        const float lower = next[at] + (next[at + 1] - next[at]) * right[x];
        grey[x] = upper + (lower - upper) * down[x];
    }
}

/* Pixels in which one that is ignored has a part are not valid. */
static void mask_row(const uint8_t *mask, ptrdiff_t stride, row_places places, ptrdiff_t width, uint8_t *valid) {
    for (ptrdiff_t x = 0; x < width; x++) {
        if (!valid[x]) {
            continue;
        }
        const uint8_t *at = mask + places.corner[x], *next = at + stride;
        const int left = places.right[x] < 1, right = places.right[x] > 0;
        const int up = places.down[x] < 1, down = places.down[x] > 0;
        const int ignored = (up & left & (at[0] < UINT8_MAX)) | (up & right & (at[1] < UINT8_MAX)) |
                            (down & left & (next[0] < UINT8_MAX)) | (down & right & (next[1] < UINT8_MAX));
        valid[x] = ignored ? 0 : UINT8_MAX;
    }
}

int VERSION_OF(resample)(ray_tables tables, source_image source, float *grey, uint8_t *valid) {
    const ptrdiff_t height = tables.height, width = tables.width;
    const float *across = tables.columns, *down = across + width, *away = down + width;
    float *buffer = malloc((3 * (size_t)width + 1) * sizeof *buffer);
    if (!buffer) {
        return -1;
    }
    const row_places places = {(int32_t *)(void *)(buffer + 2 * width), buffer, buffer + width};
    for (ptrdiff_t y = 0; y < height; y++, grey += width, valid += width) {
        const float row[3] = {tables.rows[y], tables.rows[height + y], tables.rows[2 * height + y]};
        place_row(row, across, down, away, tables.weights, width, source, places.corner, places.right, places.down,
                  valid);
        read_row(source.pixels, source.width, places.corner, places.right, places.down, width, grey);
        if (source.mask) {
            mask_row(source.mask, source.width, places, width, valid);
        }
    }
    free(buffer);
    return 0;
}
