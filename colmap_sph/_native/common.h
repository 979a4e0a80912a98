/* What all kernels share. They are plain C on plain arrays: no Python, no global state, no threads.
 *
 * All images are row-major and contiguous. Sizes are checked before a kernel is called (boundary.h). A kernel that
 * returns int gives 0, or -1 when it cannot allocate its scratch memory. */
#ifndef COLMAP_SPH_COMMON_H
#define COLMAP_SPH_COMMON_H

#include <stddef.h>
#include <stdint.h>

#define ALWAYS_INLINE static inline __attribute__((always_inline))

#endif
