/* The scalar code, with more lanes per instruction. */
#define FIT_PLANES fit_planes_avx512
#include "normals.inc"
