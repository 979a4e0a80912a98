#include <string.h>

#include "kernels.h"

static const kernel_table scalar_kernels = {"scalar",
                                            census_scalar,
                                            cost_scalar,
                                            aggregation_scalar,
                                            selection_scalar,
                                            refine_offsets_scalar,
                                            depth_candidates_scalar,
                                            fit_planes_scalar};

#ifdef COLMAP_SPH_HAVE_AVX2
static const kernel_table avx2_kernels = {"avx2",
                                          census_avx2,
                                          cost_avx2,
                                          aggregation_avx2,
                                          selection_avx2,
                                          refine_offsets_avx2,
                                          depth_candidates_avx2,
                                          fit_planes_avx2};

static int has_avx2(void) {
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("popcnt");
}
#endif

const kernel_table *kernels_by_name(const char *name) {
    if (strcmp(name, "scalar") == 0) {
        return &scalar_kernels;
    }
#ifdef COLMAP_SPH_HAVE_AVX2
    if (strcmp(name, "avx2") == 0 && has_avx2()) {
        return &avx2_kernels;
    }
#endif
    return NULL;
}

const kernel_table *kernels_best(void) {
    const kernel_table *table = kernels_by_name("avx2");
    return table ? table : &scalar_kernels;
}
