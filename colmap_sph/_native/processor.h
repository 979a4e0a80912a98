/* What the processor and the operating system run. */
#ifndef COLMAP_SPH_PROCESSOR_H
#define COLMAP_SPH_PROCESSOR_H

/* Whether the kernels compiled for AVX2, or AVX-512, run here; each asks for all extensions that CMakeLists.txt
 * lets the compiler use. */
int processor_has_avx2(void);
int processor_has_avx512bw(void);
int processor_has_avx512(void);

#endif
