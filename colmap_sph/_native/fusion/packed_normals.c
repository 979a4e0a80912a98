#include <math.h>
#include <string.h>

#include "fusion/fusion.h"

/* A code: the component that is left out, its sign, and by how many steps between neighbouring floats it differs
 * from what the other two say of a unit vector, plus a half. The rest of the bits tell of no vector at all. */
enum { COMPONENT = 3, NEGATIVE = 4, STEPS_SHIFT = 3, HALF_STEPS = 16, NONE = 0, NOT_PACKED = 3 };

static inline uint32_t bits_of(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

static inline float float_of(uint32_t bits) {
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline uint32_t third_of(float a, float b) {
    const double rest = 1.0 - (double)a * a - (double)b * b;
    return bits_of((float)sqrt(rest > 0 ? rest : 0));
}

static inline uint8_t code_of(const float n[3], int component, float a, float b) {
    if (bits_of(n[0]) == 0 && bits_of(n[1]) == 0 && bits_of(n[2]) == 0) {
        return NONE;
    }
    const int64_t steps = (int64_t)bits_of(fabsf(n[component])) - third_of(a, b);
    if (!(-HALF_STEPS < steps && steps < HALF_STEPS)) {
        return NOT_PACKED;
    }
    const int sign = bits_of(n[component]) >> 31 ? NEGATIVE : 0;
    return (uint8_t)(component | sign | (int)(steps + HALF_STEPS) << STEPS_SHIFT);
}

void pack_normals(const float *normals, ptrdiff_t pixels, float *pair, uint8_t *codes) {
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const float n[3] = {normals[p], normals[pixels + p], normals[2 * pixels + p]};
        const int first = fabsf(n[1]) > fabsf(n[0]);
        const int component = fabsf(n[2]) > fabsf(n[first]) ? 2 : first;
        const float a = n[component == 0], b = n[component == 2 ? 1 : 2];
        pair[p] = a;
        pair[pixels + p] = b;
        codes[p] = code_of(n, component, a, b);
    }
}

void unpack_normals(const float *pair, const uint8_t *codes, ptrdiff_t pixels, float *normals) {
    for (ptrdiff_t p = 0; p < pixels; p++) {
        const float a = pair[p], b = pair[pixels + p];
        const int code = codes[p], component = code & COMPONENT;
        float third = 0;
        if (code >> STEPS_SHIFT) {
            const uint32_t size = third_of(a, b) + (uint32_t)(code >> STEPS_SHIFT) - HALF_STEPS;
            third = float_of((size & 0x7fffffffu) | (code & NEGATIVE ? 0x80000000u : 0));
        }
        normals[p] = component == 0 ? third : a;
        normals[pixels + p] = component == 0 ? a : component == 1 ? third : b;
        normals[2 * pixels + p] = component == 2 ? third : b;
    }
}
