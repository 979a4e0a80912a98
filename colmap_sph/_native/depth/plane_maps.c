/* Between maps of depth and normals and the planes that refinement moves. Blocks of fixed size in plain loops, so
 * that the compiler vectorises all but the reading and writing of normals. */
#include <math.h>

#include "depth/depth.h"

enum { BLOCK = 64 };

/* Pixels of one row: a normal each, and a plane. */
typedef struct {
    float x[BLOCK], y[BLOCK], z[BLOCK], depth[BLOCK];
    float inverse[BLOCK], along_x[BLOCK], along_y[BLOCK];
} block;

static ptrdiff_t count_from(ptrdiff_t first, ptrdiff_t end) { return end - first < BLOCK ? end - first : BLOCK; }

/* On a plane n . x = d the inverse depth of pixel p is K^-T n . p / d. */
static void planes_of_block(const double *inverse_K, float first_column, float row, block *k) {
    const float a = (float)inverse_K[0], b = (float)inverse_K[1], c = (float)inverse_K[2];
    const float d = (float)inverse_K[4], e = (float)inverse_K[5];
    for (int i = 0; i < BLOCK; i++) {
        const float along_x = k->x[i] * a, along_y = k->x[i] * b + k->y[i] * d;
        const float inverse = 1 / k->depth[i], constant = k->x[i] * c + k->y[i] * e + k->z[i];
        const float scale = inverse / (along_x * (first_column + (float)i) + along_y * row + constant);
        const float scaled_x = along_x * scale, scaled_y = along_y * scale;
        const int there = (k->depth[i] > 0) & (fabsf(inverse) < INFINITY) & (fabsf(scaled_x) < INFINITY) &
                          (fabsf(scaled_y) < INFINITY);
        k->inverse[i] = there ? inverse : 0;
        k->along_x[i] = there ? scaled_x : 0;
        k->along_y[i] = there ? scaled_y : 0;
    }
}

void planes_of_maps(const float *normals, const float *depth, ptrdiff_t width, const double *inverse_K,
                    patch_rows rows, float *planes) {
    const ptrdiff_t stride = rows.count * width;
    block k = {0};
    for (ptrdiff_t y = 0; y < rows.count; y++) {
        const ptrdiff_t row = rows.first + y * rows.step;
        for (ptrdiff_t start = 0; start < width; start += BLOCK) {
            const ptrdiff_t count = count_from(start, width);
            const float *normal = normals + 3 * (row * width + start), *z = depth + row * width + start;
            float *plane = planes + y * width + start;
            for (ptrdiff_t i = 0; i < count; i++) {
                k.x[i] = normal[3 * i];
                k.y[i] = normal[3 * i + 1];
                k.z[i] = normal[3 * i + 2];
                k.depth[i] = z[i];
            }
            planes_of_block(inverse_K, (float)start, (float)row, &k);
            for (ptrdiff_t i = 0; i < count; i++) {
                plane[i] = k.inverse[i];
                plane[stride + i] = k.along_x[i];
                plane[2 * stride + i] = k.along_y[i];
            }
        }
    }
}

static void maps_of_block(const double *K, float first_column, float row, block *k) {
    const float a = (float)K[0], b = (float)K[1], c = (float)K[2], d = (float)K[4], e = (float)K[5];
    for (int i = 0; i < BLOCK; i++) {
        const float inverse = k->inverse[i], along_x = k->along_x[i], along_y = k->along_y[i];
        const float constant = inverse - along_x * (first_column + (float)i) - along_y * row;
        const float x = along_x * -a, y = -(along_x * b + along_y * d),
                    z = -(along_x * c + along_y * e + constant);
        const float norm = sqrtf(x * x + y * y + z * z);
        const int there = inverse > 0;
        k->x[i] = there ? x / norm : 0;
        k->y[i] = there ? y / norm : 0;
        k->z[i] = there ? z / norm : 0;
        k->depth[i] = there ? 1 / inverse : 0;
    }
}

void maps_of_planes(const float *planes, ptrdiff_t rows, ptrdiff_t width, const double *K, ptrdiff_t first_row,
                    float *normals, float *depth) {
    const ptrdiff_t stride = rows * width;
    block k = {0};
    for (ptrdiff_t y = 0; y < rows; y++) {
        const ptrdiff_t row = first_row + y;
        for (ptrdiff_t start = 0; start < width; start += BLOCK) {
            const ptrdiff_t count = count_from(start, width);
            const float *plane = planes + y * width + start;
            float *normal = normals + 3 * (row * width + start), *z = depth + row * width + start;
            for (ptrdiff_t i = 0; i < count; i++) {
                k.inverse[i] = plane[i];
                k.along_x[i] = plane[stride + i];
                k.along_y[i] = plane[2 * stride + i];
            }
            maps_of_block(K, (float)start, (float)row, &k);
            for (ptrdiff_t i = 0; i < count; i++) {
                normal[3 * i] = k.x[i];
                normal[3 * i + 1] = k.y[i];
                normal[3 * i + 2] = k.z[i];
                z[i] = k.depth[i];
            }
        }
    }
}
