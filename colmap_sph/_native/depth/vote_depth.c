/* The vote of a pixel's candidates. Neighbouring pixels are worked on side by side, each in a lane of its own, so
 * that vector widths cannot change a result. */
#include <math.h>
#include <string.h>

#include "aligned_memory.h"
#include "depth/depth.h"
#include "lanes.h"
#include "version.h"

enum { MAX_CANDIDATES = 255 };

/* A pair's candidates for the pixels of a block. */
typedef struct {
    float_lanes depth, variance;
    int_lanes there;  /* -1, or 0 where it has none */
    int ends_station; /* no later one of the block is of its station */
} candidates;

/* Where most stations agree. */
typedef struct {
    float_lanes depth, variance;
    int_lanes stations;
} cluster;

static inline float_lanes chosen(int_lanes mask, float_lanes value, float_lanes otherwise) {
    return (float_lanes)((mask & (int_lanes)value) | (~mask & (int_lanes)otherwise));
}

static inline int any(int_lanes mask) {
    int32_t found = 0;
    for (int l = 0; l < LANES; l++) {
        found |= mask[l];
    }
    return found != 0;
}

static inline int_lanes agree(const candidates *c, float_lanes depth, float_lanes variance,
                              float tolerance_squared) {
    const float_lanes difference = depth - c->depth;
    return c->there & (int_lanes)(difference * difference <= tolerance_squared * (variance + c->variance));
}

/* The candidates of `count` pixels from `first` on, of the pairs that have any there, at most MAX_CANDIDATES of a
 * pixel; returns how many pairs. */
static inline ptrdiff_t collect(const float *depths, const float *sigmas, const int32_t *stations, ptrdiff_t pairs,
                                ptrdiff_t pixels, ptrdiff_t first, ptrdiff_t count, candidates *found) {
    ptrdiff_t number = 0;
    int32_t station = 0;
    int_lanes before = {0};
    for (ptrdiff_t k = 0; k < pairs; k++) {
        float_lanes depth = {0}, sigma = {0};
        memcpy(&depth, depths + k * pixels + first, (size_t)count * sizeof *depths);
        memcpy(&sigma, sigmas + k * pixels + first, (size_t)count * sizeof *sigmas);
        const int_lanes there = (int_lanes)(depth > 0) & (before < MAX_CANDIDATES);
        if (!any(there)) {
            continue;
        }
        before -= there;
        if (number > 0) {
            found[number - 1].ends_station = stations[k] != station;
        }
        found[number++] = (candidates){depth, sigma * sigma, there, 1};
        station = stations[k];
    }
    return number;
}

/* The candidate with which most stations agree; among equals, the one with the smallest variance. */
static inline cluster largest_cluster(const candidates *found, ptrdiff_t number, float tolerance_squared) {
    cluster best;
    int_lanes begun = {0};
    memset(&best, 0, sizeof best);
    for (ptrdiff_t a = 0; a < number; a++) {
        int_lanes stations = {0}, counted = {0};
        for (ptrdiff_t b = 0; b < number; b++) {
            counted |= agree(&found[b], found[a].depth, found[a].variance, tolerance_squared);
            if (found[b].ends_station) {
                stations -= counted;
                counted = (int_lanes){0};
            }
        }
        const int_lanes surer = (stations == best.stations) & (int_lanes)(found[a].variance < best.variance);
        const int_lanes better = found[a].there & (~begun | (stations > best.stations) | surer);
        best.depth = chosen(better, found[a].depth, best.depth);
        best.variance = chosen(better, found[a].variance, best.variance);
        best.stations = (better & stations) | (~better & best.stations);
        begun |= found[a].there;
    }
    return best;
}

/* Weighted mean of what agrees with the centre of the cluster, and its variance; each station has the mean weight
 * of its candidates. The centre's stations are counted anew: as many. */
static inline void mean_of_cluster(const candidates *found, ptrdiff_t number, const cluster *centre,
                                   float tolerance_squared, float_lanes *mean, float_lanes *variance) {
    const float_lanes none = {0};
    float_lanes sum = none, weights = none, own_sum = none, own_weights = none, members = none;
    for (ptrdiff_t b = 0; b < number; b++) {
        const candidates *c = &found[b];
        const int_lanes counts = agree(c, centre->depth, centre->variance, tolerance_squared);
        own_sum += chosen(counts, (c->depth - centre->depth) / c->variance, none);
        own_weights += chosen(counts, 1 / c->variance, none);
        members += chosen(counts, none + 1, none);
        if (c->ends_station) {
            const int_lanes some = (int_lanes)(members > 0);
            sum += chosen(some, own_sum / members, none);
            weights += chosen(some, own_weights / members, none);
            own_sum = own_weights = members = none;
        }
    }
    *mean = centre->depth + sum / weights;
    *variance = 1 / weights;
}

int VERSION_OF(vote_depth)(const float *depths, const float *sigmas, const int32_t *stations, ptrdiff_t pairs,
                           ptrdiff_t pixels, float tolerance, float *depth, float *sigma, uint8_t *support) {
    const float tolerance_squared = tolerance * tolerance;
    candidates *found = allocate_aligned(sizeof(float_lanes), (size_t)(pairs + 1) * sizeof *found);
    if (!found) {
        return -1;
    }
    for (ptrdiff_t first = 0; first < pixels; first += LANES) {
        const ptrdiff_t count = pixels - first < LANES ? pixels - first : LANES;
        const ptrdiff_t number = collect(depths, sigmas, stations, pairs, pixels, first, count, found);
        if (number == 0) {
            memset(depth + first, 0, (size_t)count * sizeof *depth);
            memset(sigma + first, 0, (size_t)count * sizeof *sigma);
            memset(support + first, 0, (size_t)count);
            continue;
        }
        const cluster best = largest_cluster(found, number, tolerance_squared);
        float_lanes mean, variance;
        mean_of_cluster(found, number, &best, tolerance_squared, &mean, &variance);
        for (ptrdiff_t l = 0; l < count; l++) {
            const int there = best.depth[l] > 0;
            depth[first + l] = there ? mean[l] : 0;
            sigma[first + l] = there ? sqrtf(variance[l]) : 0;
            support[first + l] = (uint8_t)best.stations[l];
        }
    }
    free_aligned(found);
    return 0;
}
