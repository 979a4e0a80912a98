#define REFINE_OFFSETS refine_offsets_scalar
#include "subpixel.inc"
