#define CHECK_CONSISTENCY check_consistency_scalar
#include "consistency.inc"
