#define ADD_PATCH_EQUATIONS add_patch_equations_scalar
#include "refinement.inc"
