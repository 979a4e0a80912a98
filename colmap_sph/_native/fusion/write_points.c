#include <string.h>

#include "fusion/pixels.h"

static inline void write_vector(const double *m, double x, double y, double z, const double *offset,
                                uint8_t *place) {
    float result[3];
    for (int k = 0; k < 3; k++) {
        result[k] = (float)(m[3 * k] * x + m[3 * k + 1] * y + m[3 * k + 2] * z + offset[k]);
    }
    memcpy(place, result, sizeof result);
}

void write_points(const fused_rows *rows, const point_frame *frame, uint8_t *points, uint32_t *visibility) {
    static const double none[3] = {0, 0, 0};
    const view_maps *maps = rows->maps;
    for (ptrdiff_t row = rows->first_row; row < rows->end_row; row++) {
        for (ptrdiff_t column = 0; column < maps->width; column++) {
            const ptrdiff_t p = row * maps->width + column;
            const int views = views_of_point(rows, p);
            if (!views) {
                continue;
            }
            const double z = maps->depth[p];
            const direction n = normal_at(maps, p);
            write_vector(frame->world_from_pixel, (double)column * z, (double)row * z, z, frame->centre, points);
            write_vector(frame->world_from_camera, n.x, n.y, n.z, none, points + 12);
            const uint16_t *colour = rows->verdict->colour + 3 * p;
            for (int k = 0; k < 3; k++) {
                points[24 + k] = (uint8_t)((colour[2 - k] + views / 2) / views);
            }
            points += POINT_BYTES;
            *visibility++ = (uint32_t)views;
            *visibility++ = frame->indices[0];
            for (uint64_t bits = agreeing_at(rows, p); bits; bits &= bits - 1) {
                *visibility++ = frame->indices[1 + __builtin_ctzll(bits)];
            }
        }
    }
}
