/* What is known of a view's pixel. */
#ifndef COLMAP_SPH_PIXELS_H
#define COLMAP_SPH_PIXELS_H

#include "fusion/fusion.h"

typedef struct {
    float x, y, z;
} direction;

static inline direction normal_at(const view_maps *maps, ptrdiff_t pixel) {
    const ptrdiff_t plane = maps->height * maps->width;
    const float *n = maps->normals + pixel;
    return (direction){n[0], n[plane], n[2 * plane]};
}

/* A bit for each partner that sees the same surface as this pixel. */
static inline uint64_t agreeing_at(const fused_rows *rows, ptrdiff_t pixel) {
    const ptrdiff_t plane = rows->maps->height * rows->maps->width;
    uint64_t bits = 0;
    for (ptrdiff_t k = 0; k < rows->verdict->planes; k++) {
        bits |= (uint64_t)rows->verdict->agreeing[k * plane + pixel] << (8 * k);
    }
    return bits;
}

/* Number of stations, other than the view's own, with an agreeing partner. Where any bit of a station is set below
 * its last, adding ones at all bits below carries into the last. */
static inline int other_stations(const fused_rows *rows, uint64_t agreeing) {
    const uint64_t bits = agreeing & rows->elsewhere, last = rows->last;
    return __builtin_popcountll((((bits & ~last) + ~last) | bits) & last);
}

/* Number of views that see this pixel's point; 0: it does not become one. */
static inline int views_of_point(const fused_rows *rows, ptrdiff_t pixel) {
    const uint64_t agreeing = agreeing_at(rows, pixel);
    const int is_point = rows->maps->depth[pixel] > 0 && !rows->verdict->covered[pixel];
    const int is_seen = 1 + other_stations(rows, agreeing) >= rows->min_stations;
    return is_point && is_seen ? 1 + __builtin_popcountll(agreeing) : 0;
}

#endif
