#include "kernels.h"

int match_scalar(const uint64_t *reference, const uint64_t *target, const int32_t *base, const uint8_t *image,
                 match_size size, path_penalties penalties, int32_t max_left_right_difference, uint16_t *scratch,
                 int32_t *offset) {
    const ptrdiff_t slots = size.height * size.width * size.depth;
    uint8_t *cost = (uint8_t *)(scratch + slots);
    if (cost_scalar(reference, target, base, size, cost) ||
        aggregation_scalar(cost, base, image, size, penalties, scratch)) {
        return -1;
    }
    return selection_scalar(scratch, base, reference, target, size, max_left_right_difference, offset);
}
