/* On a plane, inverse depth is affine in pixel coordinates: 1/z = m . (col, row, 1) with m = K^-T n / d. A few
 * reweighted least-squares rounds fit it to the neighbours that lie on the pixel's own surface. */
#include <math.h>

#include "kernels.h"

enum { ROUNDS = 3 };

typedef struct {
    double value, du, dv; /* inverse depth at the centre and its gradient per pixel */
} plane;

/* Weighted normal equations of 1/z = value + du * x + dv * y. */
static int solve(const double n[6], const double b[3], plane *fit) {
    /* n = {Sw, Sx, Sy, Sxx, Sxy, Syy} */
    const double c00 = n[3] * n[5] - n[4] * n[4], c01 = n[2] * n[4] - n[1] * n[5], c02 = n[1] * n[4] - n[2] * n[3];
    const double determinant = n[0] * c00 + n[1] * c01 + n[2] * c02;
    if (!(determinant > 1e-6 * n[0] * n[0] * n[0])) {
        return 0; /* fewer than three neighbours, or all on a line */
    }
    const double c11 = n[0] * n[5] - n[2] * n[2], c12 = n[1] * n[2] - n[0] * n[4], c22 = n[0] * n[3] - n[1] * n[1];
    fit->value = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant;
    fit->du = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant;
    fit->dv = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant;
    return 1;
}

/* One round: neighbours weigh by distance from the centre and from the plane so far (Geman-McClure). */
static int refit(const float *inverse, ptrdiff_t height, ptrdiff_t width, ptrdiff_t row, ptrdiff_t column,
                 int radius, const double *falloff, double scale, plane *fit) {
    double n[6] = {0}, b[3] = {0};
    const double inverse_scale = 1 / (scale * scale);
    for (int y = -radius; y <= radius; y++) {
        if (row + y < 0 || row + y >= height) {
            continue;
        }
        for (int x = -radius; x <= radius; x++) {
            if (column + x < 0 || column + x >= width) {
                continue;
            }
            const double w = inverse[(row + y) * width + column + x];
            if (!(w > 0)) {
                continue;
            }
            const double residual = w - (fit->value + fit->du * x + fit->dv * y);
            const double robust = 1 / (1 + residual * residual * inverse_scale);
            const double weight = falloff[x < 0 ? -x : x] * falloff[y < 0 ? -y : y] * robust * robust;
            n[0] += weight;
            n[1] += weight * x;
            n[2] += weight * y;
            n[3] += weight * x * x;
            n[4] += weight * x * y;
            n[5] += weight * y * y;
            b[0] += weight * w;
            b[1] += weight * w * x;
            b[2] += weight * w * y;
        }
    }
    return solve(n, b, fit);
}

static void store_normal(const plane *fit, double column, double row, const double *K, float *normal) {
    /* m . (col, row, 1) is the plane in image coordinates; n ~ K^T m, towards the camera. */
    const double m0 = fit->du, m1 = fit->dv, m2 = fit->value - fit->du * column - fit->dv * row;
    const double x = K[0] * m0, y = K[1] * m0 + K[4] * m1, z = K[2] * m0 + K[5] * m1 + m2;
    const double norm = sqrt(x * x + y * y + z * z);
    normal[0] = (float)(-x / norm);
    normal[1] = (float)(-y / norm);
    normal[2] = (float)(-z / norm);
}

void fit_planes(const float *inverse_depth, const float *inverse_sigma, ptrdiff_t height, ptrdiff_t width,
                const double *K, int radius, float tolerance, float *normals, float *fitted_depth) {
    double falloff[MAX_FIT_RADIUS + 1];
    for (int i = 0; i <= radius; i++) {
        const double t = (double)i / (radius + 1);
        falloff[i] = (1 - t * t) * (1 - t * t);
    }
    for (ptrdiff_t row = 0; row < height; row++) {
        for (ptrdiff_t column = 0; column < width; column++) {
            const ptrdiff_t p = row * width + column;
            const double w = inverse_depth[p];
            normals[3 * p] = normals[3 * p + 1] = normals[3 * p + 2] = fitted_depth[p] = 0;
            if (!(w > 0)) {
                continue;
            }
            /* The first round allows for a slope of the surface, the later ones for noise only. */
            plane fit = {w, 0, 0};
            const double noise = tolerance * inverse_sigma[p];
            int good = 1;
            for (int round = 0; round < ROUNDS && good; round++) {
                const double scale = round == 0 ? noise * (1 + radius) : round == 1 ? 2 * noise : noise;
                good = refit(inverse_depth, height, width, row, column, radius, falloff, scale, &fit);
            }
            if (good && fit.value > 0) {
                store_normal(&fit, (double)column, (double)row, K, normals + 3 * p);
                fitted_depth[p] = (float)(1 / fit.value);
            }
        }
    }
}
