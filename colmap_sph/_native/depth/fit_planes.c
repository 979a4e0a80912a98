/* Normals from local planes.
 *
 * On a plane, inverse depth is affine in pixel coordinates: 1/z = m . (col, row, 1) with m = K^-T n / d. A few
 * reweighted least-squares rounds fit it to the neighbours that lie on the pixel's own surface. Neighbouring
 * pixels are fitted side by side, each in a lane of its own, so that vector widths cannot change a result. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "depth/depth.h"
#include "lanes.h"
#include "version.h"

enum { ROUNDS = 3 };

/* Bounds that keep ratios and reciprocals of 32-bit floats finite: of inverse depths, and of relative noise. What
 * overflows nevertheless, the square of how far a neighbour is from the plane, gives it no weight. */
#define SMALLEST 1e-18f
#define LARGEST 1e18f
#define LEAST_NOISE 1e-8f

/* One value per pixel of a block; inverse depths are relative to the centre's: (w - centre) / centre. */
typedef struct {
    float centre[LANES], scale[LANES]; /* inverse depth and its reciprocal */
    float noise[LANES];
    float value[LANES], du[LANES], dv[LANES]; /* the plane at the pixel, and its gradient per pixel */
    int there[LANES], solved[LANES];          /* whether the pixel has a depth, and the last round a plane */
} block;

/* Sums of weights times 1, x, y, xx, xy, yy and of weights times the value times 1, x, y. */
typedef struct {
    float n[6][LANES], b[3][LANES];
} normal_equations;

/* NaN becomes `least`. */
static inline float clamp(float v, float least, float most) { return v > least ? v < most ? v : most : least; }

/* One round, on every `step`-th row and column of the window: neighbours weigh by distance from the centre and
 * from the plane so far (Geman-McClure). */
static inline void accumulate(const float *window, ptrdiff_t stride, int radius, int step, const float *falloff,
                              float widening, const block *k, normal_equations *sums) {
    const int reach = radius / step * step;
    const float_lanes centre = load_floats(k->centre), scale = load_floats(k->scale),
                      noise = load_floats(k->noise);
    const float_lanes value = load_floats(k->value), du = load_floats(k->du), dv = load_floats(k->dv);
    const float_lanes inverse_scale = 1 / (noise * noise * widening * widening);
    float_lanes n[6] = {{0}}, b[3] = {{0}};
    for (int x = -reach; x <= reach; x += step) {
        float_lanes a0 = {0}, a1 = {0}, a2 = {0}, b0 = {0}, b1 = {0};
        const float fx = (float)x;
        for (int y = -reach; y <= reach; y += step) {
            const float_lanes tap = load_floats(window + y * stride + x);
            const float fy = (float)y, near = falloff[abs(x)] * falloff[abs(y)];
            const float_lanes w = (tap - centre) * scale;
            const float_lanes residual = w - (value + du * fx + dv * fy);
            const float_lanes robust = 1 / (1 + residual * residual * inverse_scale);
            const float_lanes weight = (float_lanes)((int_lanes)(near * robust * robust) & (int_lanes)(tap > 0));
            a0 += weight;
            a1 += weight * fy;
            a2 += weight * fy * fy;
            b0 += weight * w;
            b1 += weight * w * fy;
        }
        n[0] += a0;
        n[1] += a0 * fx;
        n[2] += a1;
        n[3] += a0 * fx * fx;
        n[4] += a1 * fx;
        n[5] += a2;
        b[0] += b0;
        b[1] += b0 * fx;
        b[2] += b1;
    }
    memcpy(sums->n, n, sizeof n);
    memcpy(sums->b, b, sizeof b);
}

/* Where there are too few neighbours for a plane, the one so far stays. */
static inline void solve(const normal_equations *sums, block *k) {
    for (int l = 0; l < LANES; l++) {
        const double sw = sums->n[0][l], sx = sums->n[1][l], sy = sums->n[2][l];
        const double sxx = sums->n[3][l], sxy = sums->n[4][l], syy = sums->n[5][l];
        const double b0 = sums->b[0][l], b1 = sums->b[1][l], b2 = sums->b[2][l];
        const double c00 = sxx * syy - sxy * sxy, c01 = sy * sxy - sx * syy, c02 = sx * sxy - sy * sxx;
        const double c11 = sw * syy - sy * sy, c12 = sx * sy - sw * sxy, c22 = sw * sxx - sx * sx;
        const double determinant = sw * c00 + sx * c01 + sy * c02;
        /* Else fewer than three neighbours, or all on a line. */
        const int solved = determinant > 1e-6 * sw * sw * sw;
        const double inverse = 1 / (solved ? determinant : 1);
        const float value = (float)((c00 * b0 + c01 * b1 + c02 * b2) * inverse);
        const float du = (float)((c01 * b0 + c11 * b1 + c12 * b2) * inverse);
        const float dv = (float)((c02 * b0 + c12 * b1 + c22 * b2) * inverse);
        k->solved[l] = solved;
        k->value[l] = solved ? value : k->value[l];
        k->du[l] = solved ? du : k->du[l];
        k->dv[l] = solved ? dv : k->dv[l];
    }
}

/* False where no pixel has a depth. */
static inline int begin(const float *centre, const float *sigma, ptrdiff_t count, float tolerance, block *k) {
    for (int l = 0; l < LANES; l++) {
        const float w = l < count ? centre[l] : 0;
        k->there[l] = w >= SMALLEST;
        k->centre[l] = k->there[l] ? w : 1;
        k->scale[l] = 1 / k->centre[l];
        k->noise[l] = clamp(k->there[l] ? tolerance * sigma[l] * k->scale[l] : 1, LEAST_NOISE, 1);
        k->value[l] = k->du[l] = k->dv[l] = 0;
    }
    int any = 0;
    for (int l = 0; l < LANES; l++) {
        any |= k->there[l];
    }
    return any;
}

/* Whether a pixel with little support is off its plane, or glances at it. `value` is the plane's inverse depth
 * over the pixel's, `facing` the cosine at which its ray meets the plane. */
static inline int is_doubtful(const plane_fit *fit, const block *k, int l, double value, double relative_sigma,
                              double focal_length, double facing, int support) {
    const double shift = fabs(k->value[l]);
    const double slope = sqrt((double)(k->du[l] * k->du[l] + k->dv[l] * k->dv[l]));
    const double size = slope * focal_length > 1 ? slope : 1 / focal_length;
    const int is_off = shift > fit->max_shift * size && shift > fit->shift_sigma * relative_sigma * value;
    return support < fit->supported && (is_off || facing < fit->min_cosine);
}

static inline void store_plane(const plane_fit *fit, const block *k, int l, double column, double row,
                               const double *K, float sigma, int support, float *normal, float *depth) {
    /* m . (col, row, 1) is the plane in image coordinates; n ~ K^T m, towards the camera. */
    const double value = 1.0 + k->value[l];
    const double m0 = k->du[l], m1 = k->dv[l], m2 = value - m0 * column - m1 * row;
    const double x = K[0] * m0, y = K[1] * m0 + K[4] * m1, z = K[2] * m0 + K[5] * m1 + m2;
    const double norm = sqrt(x * x + y * y + z * z);
    const double ray_y = (row - K[5]) / K[4], ray_x = (column - K[2] - K[1] * ray_y) / K[0];
    const double facing = value / (norm * sqrt(ray_x * ray_x + ray_y * ray_y + 1));
    if (!(k->there[l] && k->solved[l] && value > 0 && norm > 0) ||
        is_doubtful(fit, k, l, value, sigma * k->scale[l], K[0], facing, support)) {
        normal[0] = normal[1] = normal[2] = *depth = 0;
        return;
    }
    normal[0] = (float)(-x / norm);
    normal[1] = (float)(-y / norm);
    normal[2] = (float)(-z / norm);
    *depth = (float)(1 / (value * k->centre[l]));
}

int VERSION_OF(fit_planes)(const float *inverse_depth, const float *inverse_sigma, const uint8_t *support,
                           ptrdiff_t height, ptrdiff_t width, const double *K, const plane_fit *fit,
                           float *normals, float *fitted_depth) {
    const int radius = fit->radius;
    float falloff[MAX_FIT_RADIUS + 1];
    for (int i = 0; i <= radius; i++) {
        const float t = (float)i / (float)(radius + 1);
        falloff[i] = (1 - t * t) * (1 - t * t);
    }
    /* A border of zeros, which stand for "none", also to the right of the last block. */
    const ptrdiff_t stride = width + 2 * radius + LANES;
    float *padded = calloc((size_t)((height + 2 * radius) * stride), sizeof *padded);
    if (!padded) {
        return -1;
    }
    for (ptrdiff_t row = 0; row < height; row++) {
        for (ptrdiff_t column = 0; column < width; column++) {
            const float w = inverse_depth[row * width + column], bounded = w < LARGEST ? w : LARGEST;
            padded[(row + radius) * stride + radius + column] = w >= SMALLEST ? bounded : 0;
        }
    }
    for (ptrdiff_t row = 0; row < height; row++) {
        for (ptrdiff_t column = 0; column < width; column += LANES) {
            const ptrdiff_t p = row * width + column, count = width - column < LANES ? width - column : LANES;
            const float *window = padded + (row + radius) * stride + column + radius;
            block k;
            if (!begin(window, inverse_sigma + p, count, fit->tolerance, &k)) {
                memset(normals + 3 * p, 0, (size_t)(3 * count) * sizeof *normals);
                memset(fitted_depth + p, 0, (size_t)count * sizeof *fitted_depth);
                continue;
            }
            for (int round = 0; round < ROUNDS; round++) {
                /* The first round allows for a slope of the surface, the later ones for noise only. */
                const float widening = round == 0 ? (float)(1 + radius) : round == 1 ? 2 : 1;
                normal_equations sums;
                /* The plane that the last round starts from may come from fewer neighbours. */
                const int step = round < ROUNDS - 1 && radius > 1 ? 2 : 1;
                accumulate(window, stride, radius, step, falloff, widening, &k, &sums);
                solve(&sums, &k);
            }
            for (int l = 0; l < count; l++) {
                store_plane(fit, &k, l, (double)(column + l), (double)row, K, inverse_sigma[p + l], support[p + l],
                            normals + 3 * (p + l), fitted_depth + p + l);
            }
        }
    }
    free(padded);
    return 0;
}
