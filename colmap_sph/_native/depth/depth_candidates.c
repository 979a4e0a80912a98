/* Depth along the rays of an image from the disparity map of one of its rectified pairs.
 *
 * Sphere: ray (X, Y, Z) = r (sin t, cos t sin l, cos t cos l); with parallax angle delta and baseline b the
 * distance along the left ray is b cos(t - delta) / sin(delta) = b (cos t cot(delta) + sin t), along the right
 * ray b (cos t cot(delta) - sin t). Plane: Z = b f / d. */
#include <math.h>
#include <string.h>

#include "depth/depth.h"
#include "version.h"

/* Of a disparity's roughness, what counts as its standard deviation (measured on rendered and real blocks). */
static const double ROUGHNESS_SHARE = 0.5;
static const double HALF_PI = 1.57079632679489661923;

/* atan2 without branches or library calls, so that the compiler can vectorise it; absolute error < 1e-9. */
static inline double arctangent2(double y, double x) {
    const double ay = fabs(y), ax = fabs(x);
    const double larger = ax > ay ? ax : ay, smaller = ax > ay ? ay : ax;
    const int upper = smaller > 0.41421356237309503 * larger; /* tan(pi / 8) */
    const double divisor = upper ? larger + smaller : larger;
    const double t = (upper ? smaller - larger : smaller) / (divisor > 1e-300 ? divisor : 1e-300);
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

/* Nearest whole number; not by truncating u + 0.5, which would round the number before 0.5 up to 1. */
static inline ptrdiff_t nearest(double u) {
    const double whole = floor(u);
    return (ptrdiff_t)whole + (u - whole >= 0.5);
}

typedef struct {
    const float *values;
    ptrdiff_t height, width;
} disparity_map;

/* How far a disparity lies from the mean of its neighbours, along the axis where that is more: matches in foliage
 * and at edges are less certain than those on smooth surfaces. A missing neighbour counts as a whole pixel. */
static inline double roughness(const disparity_map *map, ptrdiff_t x, ptrdiff_t y) {
    const float *centre = map->values + y * map->width + x;
    const double across = x > 0 && x + 1 < map->width ? fabs(*centre - 0.5 * (centre[-1] + centre[1])) : NAN;
    const double along =
        y > 0 && y + 1 < map->height ? fabs(*centre - 0.5 * (centre[-map->width] + centre[map->width])) : NAN;
    return fmax(isnan(across) ? 1 : across, isnan(along) ? 1 : along);
}

/* Disparity at (u, v) and its roughness: interpolated only between disparities of the surface of the nearest
 * pixel; NaN when that pixel has none. */
static inline double sample_surface(const disparity_map *map, double u, double v, double max_step, double *rough) {
    if (!(u > -0.5 && v > -0.5 && u < (double)map->width - 0.5 && v < (double)map->height - 0.5)) {
        return NAN;
    }
    const ptrdiff_t x = nearest(u), y = nearest(v);
    const double centre = map->values[y * map->width + x];
    if (isnan(centre)) {
        return NAN;
    }
    *rough = roughness(map, x, y);
    /* The other corners of the cell around (u, v): beside, above or below, and across from the nearest one. */
    const double du = u - (double)x, dv = v - (double)y;
    const ptrdiff_t x1 = x + (du < 0 ? -1 : 1), y1 = y + (dv < 0 ? -1 : 1);
    const int in_row = x1 >= 0 && x1 < map->width, in_column = y1 >= 0 && y1 < map->height;
    const double fx = fabs(du), fy = fabs(dv);
    const double beside = in_row ? map->values[y * map->width + x1] : NAN;
    const double above = in_column ? map->values[y1 * map->width + x] : NAN;
    const double across = in_row && in_column ? map->values[y1 * map->width + x1] : NAN;
    const double weight = (1 - fx) * (1 - fy);
    /* Comparisons are false for NaN. */
    const double w1 = fabs(beside - centre) <= max_step ? fx * (1 - fy) : 0;
    const double w2 = fabs(above - centre) <= max_step ? (1 - fx) * fy : 0;
    const double w3 = fabs(across - centre) <= max_step ? fx * fy : 0;
    const double sum = (w1 > 0 ? w1 * (beside - centre) : 0) + (w2 > 0 ? w2 * (above - centre) : 0) +
                       (w3 > 0 ? w3 * (across - centre) : 0);
    return centre + sum / (weight + w1 + w2 + w3);
}

enum { BLOCK = 256 };

/* Pixels of one row of the depth map. Fixed sizes, so that the compiler can vectorise. */
typedef struct {
    double x[BLOCK], y[BLOCK], z[BLOCK]; /* ray in the rectified frame, of depth 1 in the camera */
    double u[BLOCK], v[BLOCK];           /* column and row in the disparity map */
    double disparity[BLOCK], spread[BLOCK];
    double depth[BLOCK], sigma[BLOCK];
} block;

static inline void locate(const pair_geometry *g, double row, double first_column, block *k) {
    const double *m = g->rectified_from_pixel;
    for (int i = 0; i < BLOCK; i++) {
        const double column = first_column + i;
        k->x[i] = m[0] * column + m[1] * row + m[2];
        k->y[i] = m[3] * column + m[4] * row + m[5];
        k->z[i] = m[6] * column + m[7] * row + m[8];
    }
    const double columns = g->columns_per_radian, column_origin = g->column_origin;
    const double rows = g->rows_per_radian, row_origin = g->row_origin;
    if (g->spherical) {
        for (int i = 0; i < BLOCK; i++) {
            const double across = sqrt(k->y[i] * k->y[i] + k->z[i] * k->z[i]);
            k->u[i] = arctangent2(k->x[i], across) * columns - column_origin;
            k->v[i] = arctangent2(k->y[i], k->z[i]) * rows - row_origin;
        }
    } else {
        for (int i = 0; i < BLOCK; i++) {
            const double scale = k->z[i] > 0 ? 1 / k->z[i] : NAN;
            k->u[i] = k->x[i] * scale * columns - column_origin;
            k->v[i] = k->y[i] * scale * rows - row_origin;
        }
    }
}

/* Cotangent within (0, pi / 2) by the series of sine and cosine: relative error < 1e-12. */
static inline double cotangent(double angle) {
    const double s = angle * angle;
    double sine = 1.0 / (18 * 19), cosine = 1.0 / (17 * 18);
/* Divisors as factors: divisions take longest of all. */
#define TERM(sum, divisor) sum = (1 - s * sum) * (1.0 / (divisor))
    TERM(sine, 16 * 17);
    TERM(cosine, 15 * 16);
    TERM(sine, 14 * 15);
    TERM(cosine, 13 * 14);
    TERM(sine, 12 * 13);
    TERM(cosine, 11 * 12);
    TERM(sine, 10 * 11);
    TERM(cosine, 9 * 10);
    TERM(sine, 8 * 9);
    TERM(cosine, 7 * 8);
    TERM(sine, 6 * 7);
    TERM(cosine, 5 * 6);
    TERM(sine, 4 * 5);
    TERM(cosine, 3 * 4);
    TERM(sine, 2 * 3);
    TERM(cosine, 1 * 2);
#undef TERM
    return (1 - s * cosine) / (angle * (1 - s * sine));
}

static inline void triangulate_sphere(const pair_geometry *g, block *k) {
    const double side = g->is_left ? 1 : -1, radians = 1 / g->columns_per_radian;
    for (int i = 0; i < BLOCK; i++) {
        const double delta = (k->disparity[i] + g->disparity_origin) * radians;
        const double across = sqrt(k->y[i] * k->y[i] + k->z[i] * k->z[i]);
        const double norm = sqrt(k->x[i] * k->x[i] + across * across);
        const double sine = k->x[i] / norm, cosine = across / norm, cot = cotangent(delta);
        const double distance = g->baseline * (cosine * cot + side * sine);
        const double slope = g->baseline * cosine * (1 + cot * cot);
        const int found = delta > 0 && delta < HALF_PI && distance > 0; /* false for NaN */
        k->depth[i] = found ? distance / norm : 0;
        k->sigma[i] = found ? slope * k->spread[i] * radians / norm : 0;
    }
}

static inline void triangulate_plane(const pair_geometry *g, block *k) {
    for (int i = 0; i < BLOCK; i++) {
        const double d = k->disparity[i] + g->disparity_origin;
        const double z = g->baseline * g->columns_per_radian / d;
        const int found = d > 0 && k->z[i] > 0;
        k->depth[i] = found ? z / k->z[i] : 0;
        k->sigma[i] = found ? z / d * k->spread[i] / k->z[i] : 0;
    }
}

void VERSION_OF(depth_candidates)(const float *disparity, ptrdiff_t map_height, ptrdiff_t map_width,
                                  const pair_geometry *g, ptrdiff_t first_row, ptrdiff_t rows, ptrdiff_t columns,
                                  float *depth, float *sigma) {
    const disparity_map map = {disparity, map_height, map_width};
    block k;
    for (ptrdiff_t y = 0; y < rows; y++) {
        for (ptrdiff_t start = 0; start < columns; start += BLOCK) {
            const int count = columns - start < BLOCK ? (int)(columns - start) : BLOCK;
            locate(g, (double)(first_row + y), (double)start, &k);
            int found = 0;
            for (int i = 0; i < BLOCK; i++) {
                double rough = 0;
                k.disparity[i] =
                    i < count ? sample_surface(&map, k.u[i], k.v[i], g->max_disparity_step, &rough) : NAN;
                rough = ROUGHNESS_SHARE * (rough < g->max_disparity_step ? rough : g->max_disparity_step);
                k.spread[i] = g->disparity_sigma * g->disparity_sigma + rough * rough;
                found += !isnan(k.disparity[i]);
            }
            if (!found) {
                memset(depth + y * columns + start, 0, (size_t)count * sizeof *depth);
                memset(sigma + y * columns + start, 0, (size_t)count * sizeof *sigma);
                continue;
            }
            for (int i = 0; i < BLOCK; i++) {
                k.spread[i] = sqrt(k.spread[i]);
            }
            if (g->spherical) {
                triangulate_sphere(g, &k);
            } else {
                triangulate_plane(g, &k);
            }
            for (int i = 0; i < count; i++) {
                depth[y * columns + start + i] = (float)k.depth[i];
                sigma[y * columns + start + i] = (float)k.sigma[i];
            }
        }
    }
}
