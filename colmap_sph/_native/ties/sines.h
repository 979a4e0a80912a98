/* Sine and cosine of our own: those of C libraries differ from each other in the last bit. */
#ifndef COLMAP_SPH_SINES_H
#define COLMAP_SPH_SINES_H

#include <math.h>

#include "common.h"

typedef struct {
    double sine, cosine;
} sine_pair;

/* Without branches, so that compilers can work on several. Off by three of a double's last steps at most, a
 * float's are right; not a number beyond a million. */
ALWAYS_INLINE sine_pair sines_of(double angle) {
    const int is_known = fabs(angle) <= 1e6;
    const double known = is_known ? angle : 0;
    /* A quarter turn in three parts: products of the first two with whole numbers below 2^20 are exact. */
    const double quarters = rint(known * 0x1.45f306dc9c883p-1);
    const double rest = known - quarters * 0x1.921fb54400000p+0 - quarters * 0x1.0b4611a600000p-34 -
                        quarters * 0x1.3198a2e037073p-69;
    /* Taylor's series, which reach a double's last bit up to an eighth of a turn. */
    const double q = rest * rest;
    const double s =
        q * (1.0 / 6 -
             q * (1.0 / 120 -
                  q * (1.0 / 5040 -
                       q * (1.0 / 362880 -
                            q * (1.0 / 39916800 - q * (1.0 / 6227020800 - q * (1.0 / 1307674368000 -
                                                                               q * (1.0 / 355687428096000))))))));
    const double c =
        q * (1.0 / 2 -
             q * (1.0 / 24 -
                  q * (1.0 / 720 -
                       q * (1.0 / 40320 -
                            q * (1.0 / 3628800 -
                                 q * (1.0 / 479001600 - q * (1.0 / 87178291200 - q * (1.0 / 20922789888000))))))));
    const double sine = rest - rest * s, cosine = 1 - c;
    const int turns = (int)quarters;
    const double first = turns & 1 ? cosine : sine, second = turns & 1 ? sine : cosine;
    return (sine_pair){is_known ? (turns & 2 ? -first : first) : NAN,
                       is_known ? ((turns + 1) & 2 ? -second : second) : NAN};
}

#endif
