#include <math.h>

#include "depth/depth.h"

/* Least share of an image's own variance that two windows differ by, whatever their score. */
static const double LEAST_DIFFERENCE = 0.02;

/* Solve A x = b for the symmetric A = (a00, a01, a02, a11, a12, a22); 0 where that is not positive definite. */
static int solve(const double *a, const double *b, double *x) {
    const double c00 = a[3] * a[5] - a[4] * a[4], c01 = a[2] * a[4] - a[1] * a[5], c02 = a[1] * a[4] - a[2] * a[3];
    const double c11 = a[0] * a[5] - a[2] * a[2], c12 = a[1] * a[2] - a[0] * a[4], c22 = a[0] * a[3] - a[1] * a[1];
    const double determinant = a[0] * c00 + a[1] * c01 + a[2] * c02;
    if (!(a[0] > 0 && c22 > 0 && determinant > 0)) {
        return 0;
    }
    x[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant;
    x[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant;
    x[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant;
    return 1;
}

void refine_planes(const float *equations, const float *sigma, ptrdiff_t pixels, float slope_sigma,
                   float *planes) {
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const double weight = equations[p], w = planes[p];
        if (!(weight > 0 && w > 0 && sigma[p] > 0)) {
            continue;
        }
        double e[PATCH_EQUATIONS];
        for (int k = 0; k < PATCH_EQUATIONS; k++) {
            e[k] = equations[k * pixels + p];
        }
        /* The variance of what is left of the difference; neighbouring taps share half of it. */
        const double variance = e[1] / weight + LEAST_DIFFERENCE, information = 0.5 / variance;
        const double slope = 1 / (slope_sigma * w);
        double a[6], step[3];
        const double b[3] = {e[3] * information, e[4] * information, e[5] * information};
        for (int k = 0; k < 6; k++) {
            a[k] = e[6 + k] * information;
        }
        a[0] += 1 / ((double)sigma[p] * sigma[p]);
        a[3] += slope * slope;
        a[5] += slope * slope;
        if (!solve(a, b, step)) {
            continue;
        }
        /* Images are linear over about a pixel: no step goes further. */
        const double parallax = fabs(step[0]) * sqrt(e[2] / weight), scale = parallax > 1 ? 1 / parallax : 1;
        const double refined = w + scale * step[0];
        const double along_x = planes[pixels + p] + scale * step[1],
                     along_y = planes[2 * pixels + p] + scale * step[2];
        if (refined > 0 && isfinite(refined) && isfinite(along_x) && isfinite(along_y)) {
            planes[p] = (float)refined;
            planes[pixels + p] = (float)along_x;
            planes[2 * pixels + p] = (float)along_y;
        }
    }
}
