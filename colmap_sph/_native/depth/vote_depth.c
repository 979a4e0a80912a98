#include "depth/depth.h"

enum { MAX_CANDIDATES = 255 };

typedef struct {
    float depth[MAX_CANDIDATES], variance[MAX_CANDIDATES];
    int32_t station[MAX_CANDIDATES]; /* ascending */
    int count;
} candidates;

static inline int agree(const candidates *c, int a, int b, float tolerance_squared) {
    const float difference = c->depth[a] - c->depth[b];
    return difference * difference <= tolerance_squared * (c->variance[a] + c->variance[b]);
}

/* The candidate with which most stations agree; among equals, the one with the smallest variance. */
static int cluster_centre(const candidates *c, float tolerance_squared) {
    int best = 0, best_count = 0;
    for (int a = 0; a < c->count; a++) {
        int count = 0, counted = 0;
        for (int b = 0; b < c->count; b++) {
            counted = b > 0 && c->station[b] == c->station[b - 1] ? counted : 0;
            const int found = agree(c, a, b, tolerance_squared);
            count += found && !counted;
            counted |= found;
        }
        if (count > best_count || (count == best_count && c->variance[a] < c->variance[best])) {
            best = a;
            best_count = count;
        }
    }
    return best;
}

/* Weighted sum of the depths less the centre's, and of the weights, of what agrees with it; and of how many
 * stations. Each of these has the mean weight of its candidates. */
static int sum_cluster(const candidates *c, int centre, float tolerance_squared, float *sum, float *weights) {
    int stations = 0;
    for (int b = 0; b < c->count;) {
        const int32_t station = c->station[b];
        float own_sum = 0, own_weights = 0;
        int members = 0;
        for (; b < c->count && c->station[b] == station; b++) {
            if (agree(c, centre, b, tolerance_squared)) {
                own_sum += (c->depth[b] - c->depth[centre]) / c->variance[b];
                own_weights += 1 / c->variance[b];
                members++;
            }
        }
        if (members) {
            *sum += own_sum / (float)members;
            *weights += own_weights / (float)members;
            stations++;
        }
    }
    return stations;
}

void vote_depth(const float *depths, const float *sigmas, const int32_t *stations, ptrdiff_t count,
                ptrdiff_t pixels, float tolerance, float *depth, float *sigma, uint8_t *support) {
    const float tolerance_squared = tolerance * tolerance;
    candidates c;
    for (ptrdiff_t p = 0; p < pixels; p++) {
        c.count = 0;
        for (ptrdiff_t k = 0; k < count && c.count < MAX_CANDIDATES; k++) {
            const float s = sigmas[k * pixels + p];
            if (depths[k * pixels + p] > 0) {
                c.depth[c.count] = depths[k * pixels + p];
                c.station[c.count] = stations[k];
                c.variance[c.count++] = s * s;
            }
        }
        depth[p] = sigma[p] = 0;
        support[p] = 0;
        if (c.count == 0) {
            continue;
        }
        const int centre = cluster_centre(&c, tolerance_squared);
        float sum = 0, weights = 0;
        support[p] = (uint8_t)sum_cluster(&c, centre, tolerance_squared, &sum, &weights);
        depth[p] = c.depth[centre] + sum / weights;
        sigma[p] = __builtin_sqrtf(1 / weights);
    }
}
