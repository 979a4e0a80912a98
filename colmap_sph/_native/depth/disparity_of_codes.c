#include <math.h>

#include "depth/depth.h"

void disparity_of_codes(const uint16_t *codes, ptrdiff_t pixels, float least, float step, float *disparity) {
    for (ptrdiff_t i = 0; i < pixels; i++) {
        const float value = ((float)codes[i] - 1) * step + least;
        disparity[i] = codes[i] ? value : NAN;
    }
}
