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

/* Number of views that see this pixel's point; 0: it does not become one. */
static inline int views_of_point(const fused_rows *rows, ptrdiff_t pixel) {
    const int views = 1 + __builtin_popcountll(rows->verdict->agreeing[pixel]);
    const int is_point = rows->maps->depth[pixel] > 0 && !rows->verdict->covered[pixel];
    return is_point && views >= rows->min_views ? views : 0;
}

#endif
