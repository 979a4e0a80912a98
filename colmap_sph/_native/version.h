/* For kernels that CMake compiles once per instruction set, with VERSION as its name. */
#ifndef COLMAP_SPH_VERSION_H
#define COLMAP_SPH_VERSION_H

/* VERSION_OF(fit_planes) is fit_planes_avx2 in the file's AVX2 version. */
#define VERSION_OF(kernel) VERSION_PASTE(kernel, VERSION)
#define VERSION_PASTE(kernel, version) VERSION_JOIN(kernel, version)
#define VERSION_JOIN(kernel, version) kernel##_##version

#endif
