/* The scalar code, with the processor's own count of bits. */
#define REFINE_OFFSETS refine_offsets_avx2
#include "subpixel.inc"
