/* Memory for vectors. */
#ifndef COLMAP_SPH_ALIGNED_MEMORY_H
#define COLMAP_SPH_ALIGNED_MEMORY_H

#include <stdlib.h>

#ifdef _WIN32
#include <malloc.h>
#endif

/* `size` bytes at a multiple of `alignment`, a power of two of at least the size of a pointer; NULL where there
 * are none. Ended by free_aligned alone: Windows keeps such memory apart from malloc's. */
static inline void *allocate_aligned(size_t alignment, size_t size) {
#ifdef _WIN32
    return _aligned_malloc(size, alignment);
#else
    const size_t whole = (size + alignment - 1) / alignment * alignment; /* C11 asks for a multiple */
    return whole < size ? NULL : aligned_alloc(alignment, whole);
#endif
}

static inline void free_aligned(void *memory) {
#ifdef _WIN32
    _aligned_free(memory);
#else
    free(memory);
#endif
}

#endif
