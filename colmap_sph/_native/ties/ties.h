/* Kernels of ties: small windows of the left image of a pair, found in the right one by least squares. */
#ifndef COLMAP_SPH_TIES_H
#define COLMAP_SPH_TIES_H

#include "common.h"

enum {
    PLANE_RADIUS = 4, /* of the window whose disparities must lie on a plane */
    PARAMETERS = 4,   /* of a window's move: along and across, and the change of the two slopes */
    MAX_WINDOW = 1024 /* pixels of a window */
};

typedef struct {
    const float *disparity;
    ptrdiff_t height, width;
} disparity_map;

/* Planes through the disparities around places (column, row): their value there, and the change per column and
 * row. `roughness` is the largest distance of one of these disparities from the plane; infinite where the window
 * leaves the map or less than the share `least_found` of it has a disparity. */
void fit_surfaces(disparity_map map, const double *places, ptrdiff_t count, double least_found, double *planes,
                  float *roughness);

/* How a rectified pair's places are seen in one of its images. */
typedef struct {
    const double *pixel_from_ray; /* 3 x 3 */
    double column_origin, row_origin, column_scale,
        row_scale; /* (place + origin) / scale is an angle, or tangent */
    int spherical;
    double flatness; /* of the sphere: of its columns the angle is arctan(flatness * that) / flatness */
} rectified_camera;

/* Where the image shows the pixels of windows around places, as cv2.remap counts; far outside where it does not.
 * A window's pixel (i, j) from its middle lies in column place + slopes · (i, j), row place + j. */
typedef void place_windows_fn(const double *places, const double *slopes, rectified_camera camera, ptrdiff_t count,
                              ptrdiff_t height, ptrdiff_t width, float *columns, float *rows);

place_windows_fn place_windows_scalar, place_windows_avx2, place_windows_avx512bw, place_windows_avx512;

/* Windows, without their rim of one pixel, with mean 0 and standard deviation 1, but for `least_contrast`; how
 * they change with each parameter, 4 rows of pixels; and the 4 x 4 normal matrix of that. */
void make_templates(const float *windows, ptrdiff_t count, ptrdiff_t height, ptrdiff_t width, float least_contrast,
                    float *values, float *jacobian, float *normal);

/* Windows of the right image against templates. */
typedef struct {
    const float *values, *jacobian, *inverse, *windows;
    ptrdiff_t count, pixels;
    float least_contrast;
} template_windows;

/* One step of the least squares: the move of each window, its correlation with the template, and the mean square
 * of their difference. */
void step_windows(template_windows input, float *move, float *correlation, float *variance);

#endif
