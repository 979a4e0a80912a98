/* The scalar code, with more lanes per instruction. */
#define CHECK_CONSISTENCY check_consistency_avx2
#include "consistency.inc"
