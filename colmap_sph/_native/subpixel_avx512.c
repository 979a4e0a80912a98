/* The scalar code, with the processor's own count of bits. */
#define REFINE_OFFSETS refine_offsets_avx512
#include "subpixel.inc"
