/* Windows of the two images of a pair, and the least squares between them; see ties.h. */
#include <math.h>

#include "arctangent.h"
#include "ties/sines.h"
#include "ties/ties.h"

enum { LANES = 8 };
/* Angles from a window's middle up to this have sines by their series, right to the last bit of a float. */
static const double SMALL_ANGLE = 0.25;

/* ---- places ------------------------------------------------------------------------------------------------ */

/* Sine and cosine of an angle and of a sum of angles. */
typedef struct {
    float sine, cosine;
} direction;

static direction direction_of(double angle) {
    const sine_pair sines = sines_of(angle);
    return (direction){(float)sines.sine, (float)sines.cosine};
}

ALWAYS_INLINE direction turned(direction d, float angle) {
    const float square = angle * angle;
    const float sine = angle * (1 - square * (1.0f / 6) * (1 - square * (1.0f / 20)));
    const float cosine = 1 - square * 0.5f * (1 - square * (1.0f / 12) * (1 - square * (1.0f / 30)));
    return (direction){d.sine * cosine + d.cosine * sine, d.cosine * cosine - d.sine * sine};
}

/* A window's row in the image: pixel i's ray is `along` its direction, and what the row has in common. */
typedef struct {
    double middle, step;    /* what columns are equal steps of: at the middle pixel, and from pixel to pixel */
    double flatness;        /* of the sphere's columns */
    float along[3], row[3]; /* homogeneous pixel = along · sine + row · cosine */
} window_row;

ALWAYS_INLINE void project(const window_row *row, direction d, float *column, float *image_row) {
    const float x = row->along[0] * d.sine + row->row[0] * d.cosine;
    const float y = row->along[1] * d.sine + row->row[1] * d.cosine;
    const float z = row->along[2] * d.sine + row->row[2] * d.cosine;
    /* COLMAP counts from the pixel's corner, cv2.remap from its centre. */
    *column = (z > 0 ? x / z : -1) - 0.5f;
    *image_row = (z > 0 ? y / z : -1) - 0.5f;
}

/* Angle of a column of the sphere. */
static double angle_of(const window_row *row, double along) {
    return row->flatness > 0 ? arctangent2(row->flatness * along, 1) / row->flatness : along;
}

/* Angle, if small, from the row's middle to a column so far from it: arctan b - arctan a is the arctangent of
 * (b - a) / (1 + a b). */
ALWAYS_INLINE float angle_from_middle(const window_row *row, float flatness, float away) {
    if (flatness > 0) {
        const float a = flatness * (float)row->middle, x = flatness * away / (1 + a * (a + flatness * away));
        const float square = x * x;
        return x * (1 - square * (1.0f / 3 - square * (1.0f / 5 - square * (1.0f / 7)))) / flatness;
    }
    return away;
}

static void place_row(const window_row *row, int spherical, ptrdiff_t width, float *columns, float *rows) {
    const int first = -(int)(width / 2);
    if (!spherical) {
        for (int i = 0; i < (int)width; i++) {
            const direction d = {(float)(row->middle + row->step * (first + i)), 1};
            project(row, d, columns + i, rows + i);
        }
    } else if (fabs(row->step) * (double)width <= SMALL_ANGLE) {
        const direction middle = direction_of(angle_of(row, row->middle));
        const float step = (float)row->step, flatness = (float)row->flatness;
        for (int i = 0; i < (int)width; i++) {
            const float angle = angle_from_middle(row, flatness, step * (float)(first + i));
            project(row, turned(middle, angle), columns + i, rows + i);
        }
    } else {
        for (int i = 0; i < (int)width; i++) {
            const double angle = angle_of(row, row->middle + row->step * (first + i));
            project(row, direction_of(angle), columns + i, rows + i);
        }
    }
}

void place_windows(const double *places, const double *slopes, rectified_camera camera, ptrdiff_t count,
                   ptrdiff_t height, ptrdiff_t width, float *columns, float *rows) {
    const double *matrix = camera.pixel_from_ray;
    for (ptrdiff_t p = 0; p < count; p++) {
        for (ptrdiff_t y = 0; y < height; y++) {
            const double j = (double)(y - height / 2);
            const double across = (places[2 * p + 1] + j + camera.row_origin) / camera.row_scale;
            const sine_pair sines = sines_of(camera.spherical ? across : 0);
            const double down = camera.spherical ? sines.sine : across, ahead = sines.cosine;
            const double column = places[2 * p] + slopes[2 * p + 1] * j + camera.column_origin;
            window_row row = {
                column / camera.column_scale, slopes[2 * p] / camera.column_scale, camera.flatness, {0}, {0}};
            for (int k = 0; k < 3; k++) {
                row.along[k] = (float)matrix[3 * k];
                row.row[k] = (float)(matrix[3 * k + 1] * down + matrix[3 * k + 2] * ahead);
            }
            const ptrdiff_t out = (p * height + y) * width;
            place_row(&row, camera.spherical, width, columns + out, rows + out);
        }
    }
}

/* ---- least squares ----------------------------------------------------------------------------------------- */

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
