#define FIT_PLANES fit_planes_scalar
#include "normals.inc"
