/* The kernels of surfaces as Python's functions. */
#include <string.h>

#include "boundary.h"
#include "surface/surface.h"

#define DRAW_HEIGHTS(X) \
    X(IN, float32, depth, MAP_H, MAP_W) \
    X(IN, float32, normals, 3, MAP_H, MAP_W) \
    X(IN, float64, ray_from_pixel, 3, 3) \
    X(IN, float64, cells_from_camera, 3, 3) \
    X(IN, float64, shift, 3) \
    X(VALUE, double, half) \
    X(VALUE, double, max_ratio) \
    X(OUT, float32, raster, H, W)
ARGUMENTS(draw_heights, DRAW_HEIGHTS);

static int run_draw_heights(void *arguments) {
    const draw_heights_arguments *a = arguments;
    drawn_view view = {.depth = a->depth, .normals = a->normals, .height = a->size.MAP_H, .width = a->size.MAP_W};
    memcpy(view.ray_from_pixel, a->ray_from_pixel, sizeof view.ray_from_pixel);
    memcpy(view.cells_from_camera, a->cells_from_camera, sizeof view.cells_from_camera);
    memcpy(view.shift, a->shift, sizeof view.shift);
    draw_heights(&view, a->half, a->max_ratio, a->raster, a->size.H, a->size.W);
    return 0;
}

FUNCTION(
    draw_heights, DRAW_HEIGHTS, any,
    "Draw every pixel with a depth as a patch of its plane, so many pixels to each side, into a raster, whose\n"
    "cells keep the greatest height at their centres.");

native_function *const surface_functions[] = {&draw_heights_function, NULL};
