/* Kernels of surfaces seen from one side. One version each, so that the result never depends on the processor. */
#ifndef COLMAP_SPH_SURFACE_H
#define COLMAP_SPH_SURFACE_H

#include "common.h"

/* A view's depth map and normals (three planes), the ray K^-1 (column, row, 1) of its pixels, and the affine map
 * from points in its camera frame to column, row and height in a raster. */
typedef struct {
    const float *depth, *normals;
    ptrdiff_t height, width;
    double ray_from_pixel[9], cells_from_camera[9], shift[3];
} drawn_view;

/* Draws every pixel with a depth as a patch of its plane, two triangles of `half` a pixel to each side. A cell
 * gets the greatest height that a patch has at its centre, which is at a whole column and row; those that no patch
 * meets keep theirs. Passed over are pixels seen from behind, and those whose depth changes by more than a factor
 * of `max_ratio` over the patch. */
void draw_heights(const drawn_view *view, double half, double max_ratio, float *raster, ptrdiff_t height,
                  ptrdiff_t width);

#endif
