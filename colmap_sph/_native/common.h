/* What all kernels share. They are plain C on plain arrays: no Python, no global state, no threads.
 *
 * All images are row-major and contiguous. Sizes are checked before a kernel is called (boundary.h). A kernel that
 * returns int gives 0, or -1 when it cannot allocate its scratch memory. */
#ifndef COLMAP_SPH_COMMON_H
#define COLMAP_SPH_COMMON_H

#include <stddef.h>
#include <stdint.h>

#define ALWAYS_INLINE static inline __attribute__((always_inline))

/* The nearest of 0 to end - 1. */
ALWAYS_INLINE ptrdiff_t within(ptrdiff_t value, ptrdiff_t end) {
    return value < 0 ? 0 : value < end ? value : end - 1;
}

#endif
