/* The arctangent of our own: those of C libraries differ from each other in the last bit. */
#ifndef COLMAP_SPH_ARCTANGENT_H
#define COLMAP_SPH_ARCTANGENT_H

#include <math.h>

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

#endif
