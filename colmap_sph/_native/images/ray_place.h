/* Where a rectified pixel's ray lies in the image that it is sampled from. */
#ifndef COLMAP_SPH_RAY_PLACE_H
#define COLMAP_SPH_RAY_PLACE_H

#include "common.h"

/* Rays of length about 1 whose depth is less lie beside the camera. */
static const float LEAST_DEPTH = 1e-6f;

/* Pixel centres have whole numbers; `inside` is 1 or 0. */
typedef struct {
    float column, row;
    int32_t inside;
} ray_place;

/* The ray is `row` times `weight`, and (across, down, away). */
ALWAYS_INLINE ray_place place_of_ray(float row_x, float row_y, float row_z, float weight, float across, float down,
                                     float away, float width, float height) {
    const float z = row_z * weight + away, scale = z > LEAST_DEPTH ? 1 / z : z;
    const float u = (row_x * weight + across) * scale, v = (row_y * weight + down) * scale;
    const int32_t inside = (z > LEAST_DEPTH) & (u >= 0) & (u <= width) & (v >= 0) & (v <= height);
    /* COLMAP counts from the pixel's corner. */
    return (ray_place){u - 0.5f, v - 0.5f, inside};
}

#endif
