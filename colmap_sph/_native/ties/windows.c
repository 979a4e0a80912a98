/* The least squares between windows of the two images of a pair; see ties.h. */
#include <math.h>

#include "ties/ties.h"

enum { LANES = 8 };

/* Sums in LANES parts, so that they are made side by side, in the same order everywhere. */
static float sum_of(const float *a, ptrdiff_t pixels) {
    float parts[LANES] = {0}, sum = 0;
    ptrdiff_t k = 0;
    for (; k + LANES <= pixels; k += LANES) {
        for (int l = 0; l < LANES; l++) {
            parts[l] += a[k + l];
        }
    }
    for (int l = 0; l < LANES; l++) {
        sum += parts[l];
    }
    for (; k < pixels; k++) {
        sum += a[k];
    }
    return sum;
}

static float dot(const float *a, const float *b, ptrdiff_t pixels) {
    float parts[LANES] = {0}, sum = 0;
    ptrdiff_t k = 0;
    for (; k + LANES <= pixels; k += LANES) {
        for (int l = 0; l < LANES; l++) {
            parts[l] += a[k + l] * b[k + l];
        }
    }
    for (int l = 0; l < LANES; l++) {
        sum += parts[l];
    }
    for (; k < pixels; k++) {
        sum += a[k] * b[k];
    }
    return sum;
}

static void subtract_mean(float *values, ptrdiff_t pixels) {
    const float mean = sum_of(values, pixels) / (float)pixels;
    for (ptrdiff_t k = 0; k < pixels; k++) {
        values[k] -= mean;
    }
}

/* Makes values with mean 0 and standard deviation 1; the one that they had, and `least_contrast`. */
static float normalise(float *values, ptrdiff_t pixels, float least_contrast) {
    subtract_mean(values, pixels);
    const float scale = sqrtf(dot(values, values, pixels) / (float)pixels) + least_contrast;
    for (ptrdiff_t k = 0; k < pixels; k++) {
        values[k] /= scale;
    }
    return scale;
}

static void copy_inner(const float *window, ptrdiff_t height, ptrdiff_t width, float *inner) {
    for (ptrdiff_t y = 0; y < height; y++) {
        for (ptrdiff_t x = 0; x < width; x++) {
            inner[y * width + x] = window[(y + 1) * (width + 2) + x + 1];
        }
    }
}

static void differentiate(const float *window, ptrdiff_t height, ptrdiff_t width, float scale, float *jacobian) {
    const ptrdiff_t stride = width + 2, pixels = height * width;
    for (ptrdiff_t y = 0; y < height; y++) {
        const float j = (float)(y - height / 2);
        for (ptrdiff_t x = 0; x < width; x++) {
            const float i = (float)(x - width / 2), *at = window + (y + 1) * stride + x + 1;
            const float along = (at[1] - at[-1]) / (2 * scale), across = (at[stride] - at[-stride]) / (2 * scale);
            float *out = jacobian + y * width + x;
            out[0] = along;
            out[pixels] = across;
            out[2 * pixels] = along * i;
            out[3 * pixels] = along * j;
        }
    }
}

void make_templates(const float *windows, ptrdiff_t count, ptrdiff_t height, ptrdiff_t width, float least_contrast,
                    float *values, float *jacobian, float *normal) {
    const ptrdiff_t pixels = height * width;
    for (ptrdiff_t p = 0; p < count; p++) {
        const float *window = windows + p * (height + 2) * (width + 2);
        float *own = jacobian + p * PARAMETERS * pixels, *products = normal + p * PARAMETERS * PARAMETERS;
        copy_inner(window, height, width, values + p * pixels);
        const float scale = normalise(values + p * pixels, pixels, least_contrast);
        differentiate(window, height, width, scale, own);
        for (int k = 0; k < PARAMETERS; k++) {
            subtract_mean(own + k * pixels, pixels);
            for (int l = 0; l <= k; l++) {
                const float product = dot(own + k * pixels, own + l * pixels, pixels);
                products[PARAMETERS * k + l] = products[PARAMETERS * l + k] = product;
            }
        }
    }
}

static void step_window(const template_windows *input, ptrdiff_t p, float *move, float *correlation,
                        float *variance) {
    const ptrdiff_t pixels = input->pixels;
    const float *values = input->values + p * pixels, *jacobian = input->jacobian + p * PARAMETERS * pixels;
    const float *inverse = input->inverse + p * PARAMETERS * PARAMETERS;
    float window[MAX_WINDOW], sides[PARAMETERS];
    for (ptrdiff_t k = 0; k < pixels; k++) {
        window[k] = input->windows[p * pixels + k];
    }
    normalise(window, pixels, input->least_contrast);
    *correlation = dot(window, values, pixels) / (float)pixels;
    for (ptrdiff_t k = 0; k < pixels; k++) {
        window[k] -= values[k];
    }
    *variance = dot(window, window, pixels) / (float)pixels;
    for (int k = 0; k < PARAMETERS; k++) {
        sides[k] = dot(window, jacobian + k * pixels, pixels);
    }
    for (int k = 0; k < PARAMETERS; k++) {
        move[k] = dot(inverse + PARAMETERS * k, sides, PARAMETERS);
    }
}

void step_windows(template_windows input, float *move, float *correlation, float *variance) {
    for (ptrdiff_t p = 0; p < input.count; p++) {
        step_window(&input, p, move + PARAMETERS * p, correlation + p, variance + p);
    }
}
