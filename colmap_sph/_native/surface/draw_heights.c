#include <float.h>
#include <math.h>

#include "surface/surface.h"

typedef struct {
    double column, row, value;
} corner;

typedef struct {
    ptrdiff_t first_row, end_row, first_column, end_column;
} window;

typedef struct {
    float *cells;
    ptrdiff_t height, width;
} raster_of_heights;

static ptrdiff_t first_at(double place, ptrdiff_t end) {
    return place <= 0 ? 0 : place >= (double)end ? end : (ptrdiff_t)ceil(place);
}

static ptrdiff_t end_after(double place, ptrdiff_t end) {
    return place < 0 ? 0 : place >= (double)end ? end : (ptrdiff_t)floor(place) + 1;
}

/* The cells whose centres lie in the triangle's bounding box. */
static window window_of(const corner *a, const corner *b, const corner *c, const raster_of_heights *raster) {
    const double left = fmin(a->column, fmin(b->column, c->column));
    const double right = fmax(a->column, fmax(b->column, c->column));
    const double top = fmin(a->row, fmin(b->row, c->row));
    const double bottom = fmax(a->row, fmax(b->row, c->row));
    return (window){first_at(top, raster->height), end_after(bottom, raster->height),
                    first_at(left, raster->width), end_after(right, raster->width)};
}

/* Twice the signed area of the triangle of two corners and a place. */
static double area(const corner *a, const corner *b, double column, double row) {
    return (b->column - a->column) * (row - a->row) - (b->row - a->row) * (column - a->column);
}

static void draw_triangle(const corner *a, const corner *b, const corner *c, const raster_of_heights *raster) {
    const double whole = area(a, b, c->column, c->row);
    if (whole == 0) {
        return;
    }
    const window cells = window_of(a, b, c, raster);
    for (ptrdiff_t row = cells.first_row; row < cells.end_row; row++) {
        for (ptrdiff_t column = cells.first_column; column < cells.end_column; column++) {
            const double of_a = area(b, c, (double)column, (double)row) / whole;
            const double of_b = area(c, a, (double)column, (double)row) / whole;
            const double of_c = area(a, b, (double)column, (double)row) / whole;
            if (of_a >= 0 && of_b >= 0 && of_c >= 0) {
                const float value = (float)(of_a * a->value + of_b * b->value + of_c * c->value);
                float *cell = raster->cells + row * raster->width + column;
                *cell = value > *cell ? value : *cell;
            }
        }
    }
}

static int is_finite(const corner *a) {
    return fabs(a->column) <= FLT_MAX && fabs(a->row) <= FLT_MAX && fabs(a->value) <= FLT_MAX;
}

/* Where the pixel (x, y) with this depth lies. */
static corner cell_of(const drawn_view *view, double x, double y, double depth) {
    const double *ray_of = view->ray_from_pixel;
    double point[3];
    for (int i = 0; i < 3; i++) {
        point[i] = (ray_of[3 * i] * x + ray_of[3 * i + 1] * y + ray_of[3 * i + 2]) * depth;
    }
    double cell[3];
    for (int i = 0; i < 3; i++) {
        const double *row = view->cells_from_camera + 3 * i;
        cell[i] = row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + view->shift[i];
    }
    return (corner){cell[0], cell[1], cell[2]};
}

/* The patch's corners; false where it is not to be drawn. */
static int patch_of(const drawn_view *view, ptrdiff_t x, ptrdiff_t y, double half, double max_ratio,
                    corner patch[4]) {
    const ptrdiff_t plane = view->height * view->width;
    const ptrdiff_t p = y * view->width + x;
    const double normal[3] = {view->normals[p], view->normals[plane + p], view->normals[2 * plane + p]};
    double slope[3]; /* n . ray is slope . (column, row, 1) */
    for (int i = 0; i < 3; i++) {
        const double *ray_of = view->ray_from_pixel + i;
        slope[i] = normal[0] * ray_of[0] + normal[1] * ray_of[3] + normal[2] * ray_of[6];
    }
    const double middle = slope[0] * (double)x + slope[1] * (double)y + slope[2];
    static const int signs[4][2] = {{-1, -1}, {1, -1}, {1, 1}, {-1, 1}};
    int is_drawn = middle < 0;
    for (int i = 0; i < 4 && is_drawn; i++) {
        const double right = signs[i][0] * half;
        const double down = signs[i][1] * half;
        const double ratio = middle / (middle + slope[0] * right + slope[1] * down);
        patch[i] = cell_of(view, (double)x + right, (double)y + down, view->depth[p] * ratio);
        is_drawn = ratio > 1 / max_ratio && ratio < max_ratio && is_finite(patch + i);
    }
    return is_drawn;
}

void draw_heights(const drawn_view *view, double half, double max_ratio, float *raster, ptrdiff_t height,
                  ptrdiff_t width) {
    const raster_of_heights target = {raster, height, width};
    for (ptrdiff_t y = 0; y < view->height; y++) {
        for (ptrdiff_t x = 0; x < view->width; x++) {
            corner patch[4];
            if (view->depth[y * view->width + x] > 0 && patch_of(view, x, y, half, max_ratio, patch)) {
                draw_triangle(&patch[0], &patch[1], &patch[2], &target);
                draw_triangle(&patch[0], &patch[2], &patch[3], &target);
            }
        }
    }
}
