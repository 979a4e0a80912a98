/* Pixels worked on side by side, each in a lane of its own, so that their number cannot change a result. */
#ifndef COLMAP_SPH_LANES_H
#define COLMAP_SPH_LANES_H

#include <stdint.h>
#include <string.h>

/* As many as a register has: gcc does not divide larger vectors well. */
#ifdef __AVX512F__
enum { LANES = 16 };
#elif defined(__AVX2__)
enum { LANES = 8 };
#else /* SSE2 of every x86-64, NEON of every aarch64 */
enum { LANES = 4 };
#endif

/* GCC's and Clang's vectors, whose comparisons give 0 or -1. */
typedef float float_lanes __attribute__((vector_size(4 * LANES)));
typedef double double_lanes __attribute__((vector_size(8 * LANES)));
typedef int32_t int_lanes __attribute__((vector_size(4 * LANES)));
typedef uint32_t unsigned_lanes __attribute__((vector_size(4 * LANES)));

static inline float_lanes load_floats(const float *values) {
    float_lanes loaded;
    memcpy(&loaded, values, sizeof loaded);
    return loaded;
}

static inline int_lanes load_ints(const void *values) {
    int_lanes loaded;
    memcpy(&loaded, values, sizeof loaded);
    return loaded;
}

#endif
