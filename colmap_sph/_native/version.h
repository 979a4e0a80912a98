/* For kernels that CMake compiles once per instruction set, with VERSION as its name. */
#ifndef COLMAP_SPH_VERSION_H
#define COLMAP_SPH_VERSION_H

/* VERSION_OF(fit_planes) is fit_planes_avx2 in the file's AVX2 version. */
#define VERSION_OF(kernel) VERSION_PASTE(kernel, VERSION)
#define VERSION_PASTE(kernel, version) VERSION_JOIN(kernel, version)
#define VERSION_JOIN(kernel, version) kernel##_##version

/* Pixels side by side, as many as a register has: gcc does not divide larger vectors well. Each has a lane of its
 * own, so that their number cannot change a result. */
#ifdef __AVX512F__
enum { LANES = 16 };
#elif defined(__AVX2__)
enum { LANES = 8 };
#else /* SSE2 of every x86-64, NEON of every aarch64 */
enum { LANES = 4 };
#endif

#endif
