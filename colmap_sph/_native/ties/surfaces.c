/* Planes through the disparities around places; see ties.h. */
#include <math.h>

#include "ties/ties.h"

enum { SIDE = 2 * PLANE_RADIUS + 1 };

/* The least-squares plane of a window's disparities, if there are enough: false, or `plane` and `roughness`. */
static int fit_plane(const float *middle, ptrdiff_t width, double least_found, double plane[3], float *roughness) {
    double n = 0, sx = 0, sy = 0, sxx = 0, sxy = 0, syy = 0, so = 0, sxo = 0, syo = 0;
    for (int y = -PLANE_RADIUS; y <= PLANE_RADIUS; y++) {
        for (int x = -PLANE_RADIUS; x <= PLANE_RADIUS; x++) {
            const float value = middle[y * width + x];
            const double there = isfinite(value) ? 1 : 0, o = isfinite(value) ? (double)value : 0;
            n += there, sx += there * x, sy += there * y;
            sxx += there * (x * x), sxy += there * (x * y), syy += there * (y * y);
            so += o, sxo += o * x, syo += o * y;
        }
    }
    const double c00 = sxx * syy - sxy * sxy, c01 = sy * sxy - sx * syy, c02 = sx * sxy - sy * sxx;
    const double c11 = n * syy - sy * sy, c12 = sx * sy - n * sxy, c22 = n * sxx - sx * sx;
    const double determinant = n * c00 + sx * c01 + sy * c02;
    if (n < least_found * (SIDE * SIDE) || !(determinant > 0)) {
        return 0;
    }
    plane[0] = (c00 * so + c01 * sxo + c02 * syo) / determinant;
    plane[1] = (c01 * so + c11 * sxo + c12 * syo) / determinant;
    plane[2] = (c02 * so + c12 * sxo + c22 * syo) / determinant;
    double most = 0;
    for (int y = -PLANE_RADIUS; y <= PLANE_RADIUS; y++) {
        for (int x = -PLANE_RADIUS; x <= PLANE_RADIUS; x++) {
            const double value = (double)middle[y * width + x];
            const double distance = fabs(value - (plane[0] + plane[1] * x + plane[2] * y));
            most = isfinite(value) && distance > most ? distance : most;
        }
    }
    *roughness = (float)most;
    return 1;
}

void fit_surfaces(disparity_map map, const double *places, ptrdiff_t count, double least_found, double *planes,
                  float *roughness) {
    const double last_column = (double)map.width - 1 - PLANE_RADIUS;
    const double last_row = (double)map.height - 1 - PLANE_RADIUS;
    for (ptrdiff_t p = 0; p < count; p++) {
        const double column = rint(places[2 * p]), row = rint(places[2 * p + 1]);
        double *plane = planes + 3 * p;
        plane[0] = plane[1] = plane[2] = 0;
        roughness[p] = INFINITY;
        if (column >= PLANE_RADIUS && column <= last_column && row >= PLANE_RADIUS && row <= last_row &&
            fit_plane(map.disparity + (ptrdiff_t)row * map.width + (ptrdiff_t)column, map.width, least_found,
                      plane, roughness + p)) {
            plane[0] += (places[2 * p] - column) * plane[1] + (places[2 * p + 1] - row) * plane[2];
        }
    }
}
