/* The scalar code, with more pixels per instruction and the processor's own count of bits. */
#define REFINE_OFFSETS refine_offsets_avx512
#include "subpixel.inc"
