/* The scalar code, with more lanes per instruction. */
#define DEPTH_CANDIDATES depth_candidates_avx2
#include "candidates.inc"
