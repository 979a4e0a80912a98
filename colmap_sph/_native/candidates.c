/* Depth along the rays of an image from the disparity map of one of its rectified pairs.
 *
 * Sphere: ray (X, Y, Z) = r (sin t, cos t sin l, cos t cos l); with parallax angle delta and baseline b the
 * distance along the left ray is b cos(t - delta) / sin(delta) = b (cos t cot(delta) + sin t), along the right
 * ray b (cos t cot(delta) - sin t). Plane: Z = b f / d. */
#include <math.h>

#include "kernels.h"

/* Of a disparity's roughness, what counts as its standard deviation (measured on rendered and real blocks). */
static const double ROUGHNESS_SHARE = 0.5;
static const double HALF_PI = 1.57079632679489661923;

/* atan2 without branches or library calls, so that the compiler can vectorise it; absolute error < 1e-9. */
static inline double arctangent2(double y, double x) {
    const double ay = fabs(y), ax = fabs(x);
    const double larger = ax > ay ? ax : ay, smaller = ax > ay ? ay : ax;
    const double ratio = smaller / (larger > 1e-300 ? larger : 1e-300);
    const int upper = ratio > 0.41421356237309503; /* tan(pi / 8) */
    const double t = upper ? (ratio - 1.0) / (ratio + 1.0) : ratio;
    const double s = t * t;
    double sum = 1.0 / 21;
    sum = 1.0 / 19 - s * sum;
    sum = 1.0 / 17 - s * sum;
    sum = 1.0 / 15 - s * sum;
    sum = 1.0 / 13 - s * sum;
    sum = 1.0 / 11 - s * sum;
    sum = 1.0 / 9 - s * sum;
    sum = 1.0 / 7 - s * sum;
    sum = 1.0 / 5 - s * sum;
    sum = 1.0 / 3 - s * sum;
    sum = t - t * s * sum;
    sum += upper ? 0.5 * HALF_PI : 0.0;
    sum = ay > ax ? HALF_PI - sum : sum;
    sum = x < 0 ? 2 * HALF_PI - sum : sum;
    return y < 0 ? -sum : sum;
}

typedef struct {
    double x, y, z;
} vector;

static inline vector ray_of_pixel(const double *m, double column, double row) {
    return (vector){m[0] * column + m[1] * row + m[2], m[3] * column + m[4] * row + m[5],
                    m[6] * column + m[7] * row + m[8]};
}

/* Nearest whole number; not by truncating u + 0.5, which would round the number before 0.5 up to 1. */
static inline ptrdiff_t nearest(double u) {
    const double whole = floor(u);
    return (ptrdiff_t)whole + (u - whole >= 0.5);
}

/* Interpolates only between disparities of the surface of the nearest pixel; NaN when that pixel has none. */
static float sample_surface(const float *map, ptrdiff_t height, ptrdiff_t width, double u, double v,
                            double max_step) {
    if (!(u > -0.5 && v > -0.5 && u < (double)width - 0.5 && v < (double)height - 0.5)) {
        return NAN;
    }
    const ptrdiff_t x0 = (ptrdiff_t)floor(u), y0 = (ptrdiff_t)floor(v);
    const double fx = u - (double)x0, fy = v - (double)y0;
    const float centre = map[nearest(v) * width + nearest(u)];
    if (isnan(centre)) {
        return NAN;
    }
    double sum = 0, weights = 0;
    for (int k = 0; k < 4; k++) {
        const ptrdiff_t x = x0 + (k & 1), y = y0 + (k >> 1);
        if (x < 0 || y < 0 || x >= width || y >= height) {
            continue;
        }
        const float d = map[y * width + x];
        if (fabs((double)d - centre) <= max_step) { /* false for NaN */
            const double weight = ((k & 1) ? fx : 1 - fx) * ((k >> 1) ? fy : 1 - fy);
            sum += weight * d;
            weights += weight;
        }
    }
    return weights > 0 ? (float)(sum / weights) : NAN;
}

/* How far a disparity lies from the mean of its neighbours, along the axis where that is more: matches in foliage
 * and at edges are less certain than those on smooth surfaces. A missing neighbour counts as a whole pixel. */
static double roughness(const float *map, ptrdiff_t height, ptrdiff_t width, double u, double v) {
    const ptrdiff_t x = nearest(u), y = nearest(v);
    const float *centre = map + y * width + x;
    const double across = x > 0 && x + 1 < width ? fabs(*centre - 0.5 * (centre[-1] + centre[1])) : NAN;
    const double along = y > 0 && y + 1 < height ? fabs(*centre - 0.5 * (centre[-width] + centre[width])) : NAN;
    return fmax(isnan(across) ? 1 : across, isnan(along) ? 1 : along);
}

/* Depth and its standard deviation for a ray whose camera z component is 1. */
static void triangulate_sphere(const pair_geometry *g, vector ray, double disparity, double disparity_sigma,
                               float *depth, float *sigma) {
    const double delta = (disparity + g->disparity_origin) / g->columns_per_radian;
    if (!(delta > 0 && delta < HALF_PI)) {
        return;
    }
    const double across = sqrt(ray.y * ray.y + ray.z * ray.z);
    const double norm = sqrt(ray.x * ray.x + across * across);
    const double sine = ray.x / norm, cosine = across / norm;
    const double cotangent = 1.0 / tan(delta);
    const double distance = g->baseline * (cosine * cotangent + (g->is_left ? sine : -sine));
    const double slope = g->baseline * cosine * (1 + cotangent * cotangent);
    if (distance > 0) {
        *depth = (float)(distance / norm);
        *sigma = (float)(slope * disparity_sigma / g->columns_per_radian / norm);
    }
}

static void triangulate_plane(const pair_geometry *g, vector ray, double disparity, double disparity_sigma,
                              float *depth, float *sigma) {
    const double d = disparity + g->disparity_origin;
    if (d > 0 && ray.z > 0) {
        const double z = g->baseline * g->columns_per_radian / d;
        *depth = (float)(z / ray.z);
        *sigma = (float)(z / d * disparity_sigma / ray.z);
    }
}

enum { BLOCK = 256 };

void depth_candidates(const float *disparity, ptrdiff_t map_height, ptrdiff_t map_width, const pair_geometry *g,
                      ptrdiff_t first_row, ptrdiff_t rows, ptrdiff_t columns, float *depth, float *sigma) {
    double u[BLOCK], v[BLOCK];
    for (ptrdiff_t n = 0; n < rows * columns; n++) {
        depth[n] = 0;
        sigma[n] = 0;
    }
    for (ptrdiff_t y = 0; y < rows; y++) {
        const double row = (double)(first_row + y);
        for (ptrdiff_t start = 0; start < columns; start += BLOCK) {
            const ptrdiff_t count = columns - start < BLOCK ? columns - start : BLOCK;
            for (ptrdiff_t i = 0; i < count; i++) {
                const vector r = ray_of_pixel(g->rectified_from_pixel, (double)(start + i), row);
                if (g->spherical) {
                    u[i] = arctangent2(r.x, sqrt(r.y * r.y + r.z * r.z)) * g->columns_per_radian;
                    v[i] = arctangent2(r.y, r.z) * g->rows_per_radian;
                } else {
                    u[i] = r.z > 0 ? r.x / r.z * g->columns_per_radian : NAN;
                    v[i] = r.z > 0 ? r.y / r.z * g->rows_per_radian : NAN;
                }
            }
            for (ptrdiff_t i = 0; i < count; i++) {
                const float d = sample_surface(disparity, map_height, map_width, u[i] - g->column_origin,
                                               v[i] - g->row_origin, g->max_disparity_step);
                if (isnan(d)) {
                    continue;
                }
                const ptrdiff_t n = y * columns + start + i;
                const vector r = ray_of_pixel(g->rectified_from_pixel, (double)(start + i), row);
                const double rough = fmin(
                    roughness(disparity, map_height, map_width, u[i] - g->column_origin, v[i] - g->row_origin),
                    g->max_disparity_step);
                const double spread = hypot(g->disparity_sigma, ROUGHNESS_SHARE * rough);
                (g->spherical ? triangulate_sphere : triangulate_plane)(g, r, d, spread, depth + n, sigma + n);
            }
        }
    }
}
