/* The scalar code, with more pixels per instruction and the processor's own count of bits. */
#define REFINE_OFFSETS refine_offsets_avx2
#include "subpixel.inc"
