/* A pixel of one view in another: does that see the same surface? */
#ifndef COLMAP_SPH_MEETING_H
#define COLMAP_SPH_MEETING_H

#include <math.h>

#include "fusion/pixels.h"
#include "geometry.h"

/* Where a pixel of the reference lies in the partner, and the gate that it comes to. */
typedef struct {
    fusion_gate gate;
    ptrdiff_t x, y;       /* the partner's pixel next to it */
    double du, dv;        /* and how far it is from that one's centre */
    float depth;          /* the partner's there */
    direction own, other; /* normals of both, each in its camera */
} meeting;

static inline float cosine_after(const double *m, direction from, direction to) {
    const double x = m[0] * from.x + m[1] * from.y + m[2] * from.z;
    const double y = m[3] * from.x + m[4] * from.y + m[5] * from.z;
    const double z = m[6] * from.x + m[7] * from.y + m[8] * from.z;
    return (float)(x * to.x + y * to.y + z * to.z);
}

/* A pixel's place in the partner's image, from the corner of the first pixel, so that whole numbers are pixels,
 * and its depth there. */
typedef struct {
    double u, v, depth;
} sighting;

static inline sighting sight(const fusion_transfer *transfer, double column, double row, double depth) {
    const vector seen = transform(transfer->pixel_from_reference, transfer->translation, column, row, depth);
    return (sighting){seen.x / seen.z + 0.5, seen.y / seen.z + 0.5, seen.z};
}

static inline int is_in_view(const view_maps *partner, sighting seen) {
    return seen.depth > 0 && seen.u >= 0 && seen.v >= 0 && seen.u < (double)partner->width &&
           seen.v < (double)partner->height;
}

/* Of pixel p of the reference, which the partner sights. */
static inline meeting meet(const view_maps *reference, const view_maps *partner, const fusion_transfer *transfer,
                           fusion_gates gates, ptrdiff_t p, sighting seen) {
    meeting met = {.gate = GATE_UNSEEN};
    if (!is_in_view(partner, seen)) {
        return met;
    }
    met.x = (ptrdiff_t)seen.u;
    met.y = (ptrdiff_t)seen.v;
    const ptrdiff_t q = met.y * partner->width + met.x;
    met.depth = partner->depth[q];
    if (!(met.depth > 0 && isfinite(met.depth))) {
        return met;
    }
    met.gate = GATE_DEPTH;
    met.du = seen.u - 0.5 - (double)met.x;
    met.dv = seen.v - 0.5 - (double)met.y;
    if (!(fabsf(met.depth - (float)seen.depth) <= gates.max_depth_error * met.depth)) {
        return met;
    }
    met.own = normal_at(reference, p);
    met.other = normal_at(partner, q);
    const float cosine = cosine_after(transfer->reference_from_partner, met.other, met.own);
    met.gate = cosine >= gates.min_normal_cosine ? GATE_NONE : GATE_NORMAL;
    return met;
}

#endif
