#include <float.h>

#include "fusion/meeting.h"

/* Area of the surface that a pixel covers: its solid angle cuts depth^2 / (fx fy) out of a plane parallel to the
 * image, and more out of a slanted one. */
static inline float surface_area(const double *m, double column, double row, float depth, direction normal) {
    const double x = m[0] * column + m[1] * row + m[2], y = m[3] * column + m[4] * row + m[5];
    const double facing = fabs(normal.x * x + normal.y * y + normal.z), least = 1e-3;
    return (float)(m[0] * m[4] * depth * depth / (facing > least ? facing : least));
}

/* Pixels that are sighted together, and depths that are compared together, so that compilers work on several at
 * once. */
enum { BLOCK = 64, LANES = 16 };

typedef struct {
    ptrdiff_t count;
    int32_t column[BLOCK];
    double depth[BLOCK];
    sighting seen[BLOCK];
} block;

/* Those of a row's pixels from `first` on, before `end`, of which something is to be asked. */
static inline void sight_block(const float *depth, const uint8_t *covered, const fusion_transfer *transfer,
                               double row, ptrdiff_t first, ptrdiff_t end, block *k) {
    k->count = 0;
    for (ptrdiff_t column = first; column < end; column++) {
        k->column[k->count] = (int32_t)column;
        k->depth[k->count] = depth[column];
        k->count += (depth[column] > 0) & !covered[column];
    }
    for (ptrdiff_t i = 0; i < k->count; i++) {
        k->seen[i] = sight(transfer, k->column[i], row, k->depth[i]);
    }
}

/* The nearest and the farthest depth, lane by lane; FLT_MAX and 0 where none is positive. */
typedef struct {
    float nearest[LANES], farthest[LANES];
} depth_bounds;

ALWAYS_INLINE void widen_bounds(depth_bounds *bounds, const float *depth, ptrdiff_t lanes) {
    for (ptrdiff_t i = 0; i < lanes; i++) {
        const float low = depth[i] > 0 ? depth[i] : FLT_MAX, high = depth[i] > 0 ? depth[i] : 0;
        bounds->nearest[i] = low < bounds->nearest[i] ? low : bounds->nearest[i];
        bounds->farthest[i] = high > bounds->farthest[i] ? high : bounds->farthest[i];
    }
}

static inline void find_bounds(const float *depth, ptrdiff_t count, float *nearest, float *farthest) {
    depth_bounds bounds;
    for (int i = 0; i < LANES; i++) {
        bounds.nearest[i] = FLT_MAX;
        bounds.farthest[i] = 0;
    }
    ptrdiff_t first = 0;
    for (; first + LANES <= count; first += LANES) {
        widen_bounds(&bounds, depth + first, LANES);
    }
    widen_bounds(&bounds, depth + first, count - first);
    *nearest = FLT_MAX;
    *farthest = 0;
    for (int i = 0; i < LANES; i++) {
        *nearest = bounds.nearest[i] < *nearest ? bounds.nearest[i] : *nearest;
        *farthest = bounds.farthest[i] > *farthest ? bounds.farthest[i] : *farthest;
    }
}

/* Whether the partner has none of a row's pixels from `first` on, before `end`, in view. A point's depth there,
 * and its pixel times that depth, are linear along the row as along depth: what is on one side of the image, or
 * behind the camera, at the four ends of both is so in between. A pixel is left for rounding. */
static inline int is_aside(const float *depth, const fusion_transfer *transfer, const view_maps *partner,
                           double row, ptrdiff_t first, ptrdiff_t end) {
    float bounds[2];
    find_bounds(depth + first, end - first, &bounds[0], &bounds[1]);
    if (bounds[1] == 0) {
        return 1;
    }
    int behind = 1, before = 1, left = 1, right = 1, above = 1, below = 1;
    for (int corner = 0; corner < 4; corner++) {
        const double column = (double)(corner & 1 ? end - 1 : first);
        const sighting seen = sight(transfer, column, row, bounds[corner >> 1]);
        behind &= seen.depth < 0;
        before &= seen.depth > 0;
        left &= seen.u < -1;
        right &= seen.u > (double)partner->width + 1;
        above &= seen.v < -1;
        below &= seen.v > (double)partner->height + 1;
    }
    return behind | (before & (left | right | above | below));
}

/* Neighbours are looked up side by side, mostly in one line of the cache: of so many, one is fetched. */
enum { FETCHED_TOGETHER = 4 };

/* What will be looked up of a block is fetched before, all at once: fusion waits for memory. Inlined, since GCC
 * takes a function that only fetches for one without effect, and drops its calls. */
ALWAYS_INLINE void fetch(const view_maps *partner, const uint8_t *image, const block *k) {
    const ptrdiff_t plane = partner->height * partner->width;
    for (ptrdiff_t i = 0; i < k->count; i += FETCHED_TOGETHER) {
        if (is_in_view(partner, k->seen[i])) {
            const ptrdiff_t q = (ptrdiff_t)k->seen[i].v * partner->width + (ptrdiff_t)k->seen[i].u;
            __builtin_prefetch(partner->depth + q);
            for (int c = 0; c < 3; c++) {
                __builtin_prefetch(partner->normals + c * plane + q);
            }
            __builtin_prefetch(image + 3 * q);
        }
    }
}

void fuse_partner(const view_maps *reference_maps, const view_maps *partner_maps, const uint8_t *image,
                  const fusion_transfer *partner_transfer, fusion_gates gates, int bit, ptrdiff_t first_row,
                  ptrdiff_t end_row, const fusion_verdict *whole_verdict) {
    /* Of its own, or compilers read all of them anew after each byte that is written. */
    const view_maps own_maps = *reference_maps, other_maps = *partner_maps;
    const view_maps *reference = &own_maps, *partner = &other_maps;
    const fusion_transfer own_transfer = *partner_transfer, *transfer = &own_transfer;
    const fusion_verdict own_verdict = *whole_verdict, *verdict = &own_verdict;
    const double max_error_squared = (double)gates.max_reprojection_error * gates.max_reprojection_error;
    const ptrdiff_t blocks = (reference->width + BLOCK - 1) / BLOCK;
    uint8_t *agreeing = verdict->agreeing + bit / 8 * reference->height * reference->width;
    for (ptrdiff_t n = first_row * blocks; n < end_row * blocks; n++) {
        const ptrdiff_t row = n / blocks, first = n % blocks * BLOCK, left = reference->width - first;
        const ptrdiff_t start = row * reference->width, end = first + (left < BLOCK ? left : BLOCK);
        if (is_aside(reference->depth + start, transfer, partner, (double)row, first, end)) {
            continue;
        }
        block k;
        sight_block(reference->depth + start, verdict->covered + start, transfer, (double)row, first, end, &k);
        fetch(partner, image, &k);
        for (ptrdiff_t i = 0; i < k.count; i++) {
            const ptrdiff_t column = k.column[i], p = start + column;
            const meeting met = meet(reference, partner, transfer, gates, p, k.seen[i]);
            if (met.gate != GATE_NONE) {
                continue;
            }
            if (met.du * met.du + met.dv * met.dv <= max_error_squared) {
                const float area = surface_area(reference->ray_from_pixel, (double)column, (double)row,
                                                reference->depth[p], met.own);
                const float other_area =
                    surface_area(partner->ray_from_pixel, (double)met.x, (double)met.y, met.depth, met.other);
                if (other_area < area || (other_area == area && transfer->partner_wins)) {
                    verdict->covered[p] = 1;
                    continue;
                }
            }
            agreeing[p] = (uint8_t)(agreeing[p] | 1 << bit % 8);
            const uint8_t *colour = image + 3 * (met.y * partner->width + met.x);
            for (int c = 0; c < 3; c++) {
                verdict->colour[3 * p + c] = (uint16_t)(verdict->colour[3 * p + c] + colour[c]);
            }
        }
    }
}
