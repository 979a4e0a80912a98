/* Depth along the rays of an image from the disparity map of one of its rectified pairs.
 *
 * Sphere: ray (X, Y, Z) = r (sin t, cos t sin l, cos t cos l); with parallax angle delta and baseline b the
 * distance along the left ray is b cos(t - delta) / sin(delta) = b (cos t cot(delta) + sin t), along the right
 * ray b (cos t cot(delta) - sin t). Columns are equal steps of u = tan(k t) / k, with flatness k, so that
 * tan(k delta) = k (u_l - u_r) / (1 + k u_l k u_r), or of t where k = 0. Plane: Z = b f / d. */
#include <math.h>
#include <string.h>

#include "arctangent.h"
#include "depth/depth.h"
#include "version.h"

/* Of a disparity's roughness, what counts as its standard deviation (measured on rendered and real blocks). */
static const float ROUGHNESS_SHARE = 0.5f;

/* Cotangent within (0, pi / 2) by the series of sine and cosine: absolute error < 1e-9. */
static inline double cotangent(double angle) {
    const double s = angle * angle;
    double sine = 1.0 / (14 * 15), cosine = 1.0 / (15 * 16);
/* Divisors as factors: divisions take longest of all. */
#define TERM(sum, divisor) sum = (1 - s * sum) * (1.0 / (divisor))
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

/* Tangent within (-pi / 2, pi / 2). */
static inline double tangent(double angle) { return copysign(1 / cotangent(fabs(angle)), angle); }

typedef struct {
    const float *values;
    ptrdiff_t height, width;
} disparity_map;

/* Pixels side by side, and how many are from one node to the next: places in the map are worked out at nodes, and
 * interpolated between them. NODES has room for one before, two behind, and whole registers. */
enum { BLOCK = 128, STEP = 8, NODES = BLOCK / STEP + 8, LAST_NODE = BLOCK / STEP + 2 };

/* A cubic through four nodes is off by no more than 3 / 128 of what their fourth difference is: by less than 1e-4
 * pixels, where that is at most this. */
static const double LARGEST_DIFFERENCE = 4e-3;

/* Pixels of one row of the depth map. Fixed sizes, so that the compiler can vectorise. */
typedef struct {
    ptrdiff_t count;                          /* pixels that are asked for, then those that are still ... */
    int32_t place[BLOCK];                     /* ... and which they are, once some were left out */
    double u[BLOCK], v[BLOCK];                /* column and row in the disparity map; 0 where outside */
    int32_t column[BLOCK], row[BLOCK];        /* the nearest pixel there ... */
    float du[BLOCK], dv[BLOCK];               /* ... and how far (u, v) lies from it ... */
    int32_t to_right[BLOCK], to_below[BLOCK]; /* ... on which sides: -1 or 1 */
    int32_t inside[BLOCK];                    /* 1 or 0 */
    int64_t at[BLOCK];                        /* its place among all of the map's */
    int64_t across_at[BLOCK];                 /* that of the pixel beyond (u, v), from there */
    int32_t amid[BLOCK];                      /* whether it has neighbours on all sides */
    float centre[BLOCK];                      /* disparity of the nearest pixel, and of those ... */
    float left[BLOCK], right[BLOCK], above[BLOCK], below[BLOCK]; /* ... around it, NaN beyond the rim ... */
    float across[BLOCK];                                         /* ... and that beyond (u, v) */
    float change[BLOCK], spread[BLOCK];     /* of the disparity from there to (u, v); its standard deviation */
    double x[BLOCK], y[BLOCK], z[BLOCK];    /* ray in the rectified frame, of depth 1 in the camera */
    double across_axis[BLOCK];              /* its distance from the baseline */
    double parallax[BLOCK], stretch[BLOCK]; /* the parallax angle, and its change with that of columns */
    float depth[BLOCK], sigma[BLOCK];
} block;

/* Numbers of pixels that whole registers hold. */
static inline ptrdiff_t filled_up(const block *k) { return (k->count + 15) / 16 * 16; }

/* Column and row in the map of a ray of the sphere. */
static inline void place_ray(const pair_geometry *g, double x, double y, double z, double *u, double *v) {
    *v = arctangent2(y, z) * g->rows_per_radian - g->row_origin;
    *u = arctangent2(x, sqrt(y * y + z * z));
}

static inline void flatten(double flatness, double *u, ptrdiff_t count) {
    if (flatness > 0) {
        for (ptrdiff_t i = 0; i < count; i++) {
            u[i] = tangent(flatness * u[i]) / flatness;
        }
    }
}

/* Where rays of a row lie in the map of a sphere: so many, a number of columns apart, from a column on. */
static inline void place_row(const pair_geometry *g, double row, double first_column, double step, ptrdiff_t count,
                             double *u, double *v) {
    const double *m = g->rectified_from_pixel;
    for (ptrdiff_t i = 0; i < count; i++) {
        const double column = first_column + step * (double)i;
        place_ray(g, m[0] * column + m[1] * row + m[2], m[3] * column + m[4] * row + m[5],
                  m[6] * column + m[7] * row + m[8], u + i, v + i);
    }
    flatten(g->flatness, u, count);
    for (ptrdiff_t i = 0; i < count; i++) {
        u[i] = u[i] * g->columns_per_radian - g->column_origin;
    }
}

/* Whether cubics through the nodes are near enough; not where there is NaN, at an epipole, or across a seam. */
static inline int is_smooth(const double *nodes) {
    int smooth = 1;
    for (int j = 0; j + 4 <= LAST_NODE; j++) {
        const double difference = nodes[j] - 4 * nodes[j + 1] + 6 * nodes[j + 2] - 4 * nodes[j + 3] + nodes[j + 4];
        smooth &= fabs(difference) <= LARGEST_DIFFERENCE;
    }
    return smooth;
}

/* Values of pixels from those at nodes, the first of which lies STEP columns before the first pixel. */
static inline void interpolate_nodes(const double *nodes, ptrdiff_t count, double *values) {
    double weights[4][STEP];
    for (int p = 0; p < STEP; p++) {
        const double t = (double)p / STEP;
        weights[0][p] = -t * (t - 1) * (t - 2) * (1.0 / 6);
        weights[1][p] = (t + 1) * (t - 1) * (t - 2) * 0.5;
        weights[2][p] = -(t + 1) * t * (t - 2) * 0.5;
        weights[3][p] = (t + 1) * t * (t - 1) * (1.0 / 6);
    }
    for (ptrdiff_t j = 0; j < count / STEP; j++) {
        for (int p = 0; p < STEP; p++) {
            values[j * STEP + p] = weights[0][p] * nodes[j] + weights[1][p] * nodes[j + 1] +
                                   weights[2][p] * nodes[j + 2] + weights[3][p] * nodes[j + 3];
        }
    }
}

/* Where the pixels' rays lie in the disparity map; false where all lie above or below it. */
static inline int locate(const pair_geometry *g, const disparity_map *map, double row, double first_column,
                         block *k) {
    const double *m = g->rectified_from_pixel, end_v = (double)map->height - 0.5;
    const ptrdiff_t count = filled_up(k);
    if (g->spherical) {
        double u[NODES], v[NODES];
        place_row(g, row, first_column - STEP, STEP, NODES, u, v);
        if (is_smooth(u) && is_smooth(v)) {
            interpolate_nodes(u, count, k->u);
            interpolate_nodes(v, count, k->v);
        } else {
            place_row(g, row, first_column, 1, count, k->u, k->v);
        }
    } else {
        for (ptrdiff_t i = 0; i < count; i++) {
            const double column = first_column + (double)i, z = m[6] * column + m[7] * row + m[8];
            const double scale = z > 0 ? 1 / z : NAN;
            k->u[i] = (m[0] * column + m[1] * row + m[2]) * scale * g->columns_per_radian - g->column_origin;
            k->v[i] = (m[3] * column + m[4] * row + m[5]) * scale * g->rows_per_radian - g->row_origin;
        }
    }
    int any = 0;
    for (ptrdiff_t i = 0; i < count; i++) {
        any |= (k->v[i] > -0.5) & (k->v[i] < end_v);
    }
    return any;
}

/* Finds the nearest pixels of the disparity map; false where none is inside. */
static inline int find_nearest(const disparity_map *map, block *k) {
    const double end_u = (double)map->width - 0.5, end_v = (double)map->height - 0.5;
    const ptrdiff_t count = filled_up(k);
    for (ptrdiff_t i = 0; i < count; i++) {
        const int inside = (k->u[i] > -0.5) & (k->v[i] > -0.5) & (k->u[i] < end_u) & (k->v[i] < end_v);
        /* From 1 on, so that cutting off the fraction rounds down; not by adding 0.5, which would round the number
         * before 0.5 up to 1. */
        const double u = inside ? k->u[i] : 0, v = inside ? k->v[i] : 0;
        const int32_t before_u = (int32_t)(u + 1) - 1, before_v = (int32_t)(v + 1) - 1;
        k->column[i] = before_u + (u - before_u >= 0.5);
        k->row[i] = before_v + (v - before_v >= 0.5);
        k->to_right[i] = u - k->column[i] < 0 ? -1 : 1;
        k->to_below[i] = v - k->row[i] < 0 ? -1 : 1;
        k->u[i] = u;
        k->du[i] = (float)(u - k->column[i]);
        k->dv[i] = (float)(v - k->row[i]);
        k->inside[i] = inside;
    }
    const int32_t last_column = (int32_t)map->width - 1, last_row = (int32_t)map->height - 1;
    for (ptrdiff_t i = 0; i < count; i++) {
        k->at[i] = k->row[i] * (int64_t)map->width + k->column[i];
        k->across_at[i] = k->to_below[i] * (int64_t)map->width + k->to_right[i];
        k->amid[i] = (k->column[i] > 0) & (k->column[i] < last_column) & (k->row[i] > 0) & (k->row[i] < last_row);
    }
    int any = 0;
    for (ptrdiff_t i = 0; i < count; i++) {
        any |= k->inside[i];
    }
    return any;
}

/* Leaves out the pixels whose nearest ones have no disparity. */
static inline void keep_found(const disparity_map *map, block *k) {
    const ptrdiff_t count = k->count, filled = filled_up(k);
    ptrdiff_t n = 0;
    float value[BLOCK];
    int32_t found[BLOCK];
    for (ptrdiff_t i = 0; i < filled; i++) {
        value[i] = map->values[k->at[i]];
    }
    for (ptrdiff_t i = 0; i < filled; i++) {
        found[i] = k->inside[i] & (value[i] == value[i]);
    }
    for (ptrdiff_t i = 0; i < count; i++) {
        k->place[n] = (int32_t)i;
        k->centre[n] = value[i];
        n += found[i];
    }
    k->count = n;
}

/* Reads the disparities around a nearest pixel, some of which may lie beyond the map's rim. */
static inline void read_at_rim(const disparity_map *map, ptrdiff_t i, ptrdiff_t n, block *k) {
    const ptrdiff_t width = map->width, x = k->column[i], y = k->row[i];
    const float *centre = map->values + k->at[i];
    const int has_left = x > 0, has_right = x < width - 1, has_above = y > 0, has_below = y < map->height - 1;
    const int has_beside = k->to_right[i] > 0 ? has_right : has_left;
    const int has_beyond = k->to_below[i] > 0 ? has_below : has_above;
    k->left[n] = has_left ? centre[-1] : NAN;
    k->right[n] = has_right ? centre[1] : NAN;
    k->above[n] = has_above ? centre[-width] : NAN;
    k->below[n] = has_below ? centre[width] : NAN;
    k->across[n] = has_beside && has_beyond ? centre[k->across_at[i]] : NAN;
}

/* Reads the disparities around the nearest pixels. */
static inline void read_around(const disparity_map *map, block *k) {
    const ptrdiff_t width = map->width;
    for (ptrdiff_t n = 0; n < k->count; n++) {
        const ptrdiff_t i = k->place[n];
        if (k->amid[i]) {
            const float *centre = map->values + k->at[i];
            k->left[n] = centre[-1];
            k->right[n] = centre[1];
            k->above[n] = centre[-width];
            k->below[n] = centre[width];
            k->across[n] = centre[k->across_at[i]];
        } else {
            read_at_rim(map, i, n, k);
        }
    }
    if (k->count < BLOCK) { /* else all stay where they are */
        for (ptrdiff_t n = 0; n < k->count; n++) {
            const ptrdiff_t i = k->place[n];
            k->du[n] = k->du[i];
            k->dv[n] = k->dv[i];
            k->u[n] = k->u[i];
        }
    }
}

/* Standard deviation of the disparities: they are rough by how far they lie from the mean of their neighbours,
 * along the axis where that is more; matches in foliage and at edges are less certain than those on smooth
 * surfaces. A missing neighbour counts as a whole pixel. */
static inline void find_spread(const pair_geometry *g, block *k) {
    const ptrdiff_t count = filled_up(k);
    const float most = (float)g->max_disparity_step, share = ROUGHNESS_SHARE;
    const float variance = (float)(g->disparity_sigma * g->disparity_sigma);
    for (ptrdiff_t i = 0; i < count; i++) {
        const float along_row = fabsf(k->centre[i] - 0.5f * (k->left[i] + k->right[i]));
        const float along_column = fabsf(k->centre[i] - 0.5f * (k->above[i] + k->below[i]));
        const float r = isnan(along_row) ? 1 : along_row, c = isnan(along_column) ? 1 : along_column;
        const float more = r > c ? r : c, rough = share * (more < most ? more : most);
        k->spread[i] = sqrtf(variance + rough * rough);
    }
}

/* Disparities at (u, v) less those of the nearest pixels: interpolated only between those of one surface; NaN
 * where there is none. */
static inline void interpolate(double max_disparity_step, block *k) {
    const ptrdiff_t count = filled_up(k);
    const float max_step = (float)max_disparity_step;
    for (ptrdiff_t i = 0; i < count; i++) {
        const float du = k->du[i], dv = k->dv[i], fx = fabsf(du), fy = fabsf(dv), centre = k->centre[i];
        const float beside = (du < 0 ? k->left[i] : k->right[i]) - centre;
        const float beyond = (dv < 0 ? k->above[i] : k->below[i]) - centre;
        const float across = k->across[i] - centre, weight = (1 - fx) * (1 - fy);
        /* Comparisons are false for NaN. */
        const float w1 = fabsf(beside) <= max_step ? fx * (1 - fy) : 0;
        const float w2 = fabsf(beyond) <= max_step ? (1 - fx) * fy : 0;
        const float w3 = fabsf(across) <= max_step ? fx * fy : 0;
        const float sum = (w1 > 0 ? w1 * beside : 0) + (w2 > 0 ? w2 * beyond : 0) + (w3 > 0 ? w3 * across : 0);
        k->change[i] = sum / (weight + w1 + w2 + w3);
    }
}

/* The rays of the pixels that are left. */
static inline void find_rays(const pair_geometry *g, double row, double first_column, block *k) {
    const ptrdiff_t count = filled_up(k);
    const double *m = g->rectified_from_pixel;
    for (ptrdiff_t i = 0; i < count; i++) {
        const double column = first_column + k->place[i];
        k->x[i] = m[0] * column + m[1] * row + m[2];
        k->y[i] = m[3] * column + m[4] * row + m[5];
        k->z[i] = m[6] * column + m[7] * row + m[8];
        k->across_axis[i] = sqrt(k->y[i] * k->y[i] + k->z[i] * k->z[i]);
    }
}

/* With the ray r of depth 1, sin t = x / |r| and cos t = across / |r|: depth, the distance over |r|, has |r|^2 as
 * its only divisor. */
static inline void triangulate_sphere(const pair_geometry *g, block *k) {
    const ptrdiff_t count = filled_up(k);
    const double side = g->is_left ? 1 : -1, radians = 1 / g->columns_per_radian;
    for (ptrdiff_t i = 0; i < count; i++) {
        k->parallax[i] = ((double)k->centre[i] + k->change[i] + g->disparity_origin) * radians;
        k->stretch[i] = 1;
    }
    const double flatness = g->flatness;
    if (flatness > 0) {
        for (ptrdiff_t i = 0; i < count; i++) {
            const double own = flatness * radians * (k->u[i] + g->column_origin);
            const double apart = flatness * k->parallax[i], other = own - side * apart;
            k->parallax[i] = arctangent2(apart, 1 + own * other) / flatness;
            k->stretch[i] = 1 / (1 + other * other);
        }
    }
    for (ptrdiff_t i = 0; i < count; i++) {
        const double delta = k->parallax[i];
        const double cot = cotangent(delta), across = k->across_axis[i];
        const double scale = g->baseline / (k->x[i] * k->x[i] + across * across);
        const double depth = scale * (across * cot + side * k->x[i]);
        const double slope = scale * across * (1 + cot * cot);
        const int found = delta > 0 && delta < HALF_PI && depth > 0; /* false for NaN */
        k->depth[i] = found ? (float)depth : 0;
        k->sigma[i] = found ? (float)(slope * k->stretch[i] * radians * k->spread[i]) : 0;
    }
}

static inline void triangulate_plane(const pair_geometry *g, block *k) {
    const ptrdiff_t count = filled_up(k);
    for (ptrdiff_t i = 0; i < count; i++) {
        const double d = (double)k->centre[i] + k->change[i] + g->disparity_origin;
        const double inverse = 1 / (d * k->z[i]), z = g->baseline * g->columns_per_radian * inverse;
        const int found = d > 0 && k->z[i] > 0;
        k->depth[i] = found ? (float)z : 0;
        k->sigma[i] = found ? (float)(z * inverse * k->z[i] * k->spread[i]) : 0;
    }
}

void VERSION_OF(depth_candidates)(const float *disparity, ptrdiff_t map_height, ptrdiff_t map_width,
                                  const pair_geometry *g, ptrdiff_t first_row, ptrdiff_t rows, ptrdiff_t columns,
                                  float *depth, float *sigma) {
    const disparity_map map = {disparity, map_height, map_width};
    block k;
    memset(&k, 0, sizeof k);
    for (ptrdiff_t y = 0; y < rows; y++) {
        for (ptrdiff_t start = 0; start < columns; start += BLOCK) {
            const ptrdiff_t count = columns - start < BLOCK ? columns - start : BLOCK;
            const ptrdiff_t first = y * columns + start;
            memset(depth + first, 0, (size_t)count * sizeof *depth);
            memset(sigma + first, 0, (size_t)count * sizeof *sigma);
            k.count = count;
            if (!locate(g, &map, (double)(first_row + y), (double)start, &k) || !find_nearest(&map, &k)) {
                continue;
            }
            keep_found(&map, &k);
            read_around(&map, &k);
            find_spread(g, &k);
            interpolate(g->max_disparity_step, &k);
            find_rays(g, (double)(first_row + y), (double)start, &k);
            if (g->spherical) {
                triangulate_sphere(g, &k);
            } else {
                triangulate_plane(g, &k);
            }
            for (ptrdiff_t i = 0; i < k.count; i++) {
                depth[first + k.place[i]] = k.depth[i];
                sigma[first + k.place[i]] = k.sigma[i];
            }
        }
    }
}
