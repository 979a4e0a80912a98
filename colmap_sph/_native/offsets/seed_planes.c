/* What sparse points tell of the places between them. */
#include <float.h>

#include "offsets/offsets.h"

enum { BLOCK = 64 };

/* The seeds around a place, nearest first; of those as near as each other, that with the lower number. */
typedef struct {
    int count;
    ptrdiff_t seed[MAX_NEIGHBOURS];
    double distance_squared[MAX_NEIGHBOURS];
} nearest_seeds;

static double distance_squared_to(seed_list seeds, ptrdiff_t s, double x, double y) {
    const double dx = seeds.columns[s] - x, dy = seeds.rows[s] - y;
    return dx * dx + dy * dy;
}

/* Adds a seed that is near enough, unless it is there. */
static void add_seed(nearest_seeds *near, int neighbours, ptrdiff_t seed, double distance_squared) {
    int place = near->count;
    while (place > 0 &&
           (near->distance_squared[place - 1] > distance_squared ||
            (near->distance_squared[place - 1] == distance_squared && near->seed[place - 1] > seed))) {
        place--;
    }
    if (place == neighbours || (place > 0 && near->seed[place - 1] == seed)) {
        return;
    }
    near->count += near->count < neighbours;
    for (int i = near->count - 1; i > place; i--) {
        near->seed[i] = near->seed[i - 1];
        near->distance_squared[i] = near->distance_squared[i - 1];
    }
    near->seed[place] = seed;
    near->distance_squared[place] = distance_squared;
}

/* From those near the place before, which most often are near this one, too: what is farther than all of them is
 * soon passed over. */
static nearest_seeds seeds_near(seed_list seeds, int neighbours, double x, double y, const nearest_seeds *before) {
    nearest_seeds near = {.count = 0};
    for (int i = 0; i < before->count; i++) {
        add_seed(&near, neighbours, before->seed[i], distance_squared_to(seeds, before->seed[i], x, y));
    }
    for (ptrdiff_t first = 0; first < seeds.count; first += BLOCK) {
        const ptrdiff_t left = seeds.count - first, count = left < BLOCK ? left : BLOCK;
        double distance_squared[BLOCK];
        for (ptrdiff_t i = 0; i < count; i++) {
            distance_squared[i] = distance_squared_to(seeds, first + i, x, y);
        }
        for (ptrdiff_t i = 0; i < count; i++) {
            const double farthest = near.count < neighbours ? DBL_MAX : near.distance_squared[neighbours - 1];
            if (distance_squared[i] <= farthest) {
                add_seed(&near, neighbours, first + i, distance_squared[i]);
            }
        }
    }
    return near;
}

/* The value at (x, y) of the plane through the seeds near it, by least squares. */
static double plane_at(seed_list seeds, seed_weights weights, double x, double y, const nearest_seeds *near) {
    if (near->count == 0) { /* numbers beyond all bounds */
        return 0;
    }
    double n = 0, sx = 0, sy = 0, sxx = 0, sxy = 0, syy = 0, b0 = 0, b1 = 0, b2 = 0;
    for (int i = 0; i < near->count; i++) {
        const double dx = seeds.columns[near->seed[i]] - x, dy = seeds.rows[near->seed[i]] - y;
        const double weight = 1 / (near->distance_squared[i] + weights.alike * weights.alike);
        const double value = weight * seeds.values[near->seed[i]];
        n += weight;
        sx += weight * dx;
        sy += weight * dy;
        sxx += weight * dx * dx;
        sxy += weight * dx * dy;
        syy += weight * dy * dy;
        b0 += value;
        b1 += value * dx;
        b2 += value * dy;
    }
    const double ridge = n * (weights.stiffness * weights.alike * weights.alike +
                              weights.unknown_stiffness * near->distance_squared[0]);
    sxx += ridge;
    syy += ridge;
    const double c0 = sxx * syy - sxy * sxy, c1 = sy * sxy - sx * syy, c2 = sx * sxy - sy * sxx;
    return (c0 * b0 + c1 * b1 + c2 * b2) / (n * c0 + sx * c1 + sy * c2);
}

void seed_planes(seed_list seeds, seed_weights weights, ptrdiff_t cell, ptrdiff_t height, ptrdiff_t width,
                 float *values) {
    nearest_seeds near = {.count = 0};
    for (ptrdiff_t y = 0; y < height; y++) {
        for (ptrdiff_t x = 0; x < width; x++) {
            const double column = ((double)x + 0.5) * (double)cell - 0.5;
            const double row = ((double)y + 0.5) * (double)cell - 0.5;
            near = seeds_near(seeds, weights.neighbours, column, row, &near);
            values[y * width + x] = (float)plane_at(seeds, weights, column, row, &near);
        }
    }
}
