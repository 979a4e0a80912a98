#define DEPTH_CANDIDATES depth_candidates_scalar
#include "candidates.inc"
