/* The scalar code, with more lanes per instruction. */
#define ADD_PATCH_EQUATIONS add_patch_equations_avx512
#include "refinement.inc"
