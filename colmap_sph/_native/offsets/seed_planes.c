/* What sparse points tell of the places between them. */
#include <float.h>
#include <math.h>

#include "offsets/offsets.h"

/* Cells of a tile's side: what may be near one of them is found for all of a tile at once. */
enum { TILE = 4 };

typedef struct {
    int count, seed[MAX_SEEDS];
} seed_numbers;

/* Seeds around a place, nearest first; of those as near as each other, that with the lower number. */
typedef struct {
    int count, seed[MAX_NEIGHBOURS];
    double distance_squared[MAX_NEIGHBOURS];
} nearest_seeds;

static void find_distances(seed_list seeds, const seed_numbers *listed, double x, double y,
                           double *distance_squared) {
    for (int i = 0; i < listed->count; i++) {
        const double dx = seeds.columns[listed->seed[i]] - x, dy = seeds.rows[listed->seed[i]] - y;
        distance_squared[i] = dx * dx + dy * dy;
    }
}

/* Adds a seed if it is among the nearest `most`. */
ALWAYS_INLINE void add_seed(nearest_seeds *near, int most, int seed, double distance_squared) {
    int place = near->count;
    while (place > 0 &&
           (near->distance_squared[place - 1] > distance_squared ||
            (near->distance_squared[place - 1] == distance_squared && near->seed[place - 1] > seed))) {
        place--;
    }
    if (place == most) {
        return;
    }
    near->count += near->count < most;
    for (int i = near->count - 1; i > place; i--) {
        near->seed[i] = near->seed[i - 1];
        near->distance_squared[i] = near->distance_squared[i - 1];
    }
    near->seed[place] = seed;
    near->distance_squared[place] = distance_squared;
}

/* Of those listed the nearest `most` to a place. */
static void find_near(seed_list seeds, const seed_numbers *listed, double x, double y, int most,
                      nearest_seeds *near) {
    double distance_squared[MAX_SEEDS];
    find_distances(seeds, listed, x, y, distance_squared);
    near->count = 0;
    for (int i = 0; i < listed->count; i++) {
        const double farthest = near->count < most ? DBL_MAX : near->distance_squared[most - 1];
        if (distance_squared[i] <= farthest) {
            add_seed(near, most, listed->seed[i], distance_squared[i]);
        }
    }
}

/* Of all seeds those within a distance of a place. */
static void list_near(seed_list seeds, const seed_numbers *all, double x, double y, double max_squared,
                      seed_numbers *listed) {
    double distance_squared[MAX_SEEDS];
    find_distances(seeds, all, x, y, distance_squared);
    listed->count = 0;
    for (int i = 0; i < all->count; i++) {
        listed->seed[listed->count] = all->seed[i];
        listed->count += distance_squared[i] <= max_squared;
    }
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

static double centre_of(ptrdiff_t cells, ptrdiff_t cell) { return ((double)cells + 0.5) * (double)cell - 0.5; }

void seed_planes(seed_list seeds, seed_weights weights, ptrdiff_t cell, ptrdiff_t height, ptrdiff_t width,
                 float *values) {
    /* What is near a cell is no farther from its tile's middle than the farthest of as many that are near that,
     * and two ways from there to the cell; a little is left for rounding. */
    const double ways = (double)cell * (TILE - 1) * sqrt(2), middle = 0.5 * (double)cell * (TILE - 1);
    const double enough = 1 + 1e-9;
    const int most = weights.neighbours;
    seed_numbers all = {.count = (int)seeds.count}, listed;
    for (int s = 0; s < all.count; s++) {
        all.seed[s] = s;
    }
    nearest_seeds near;
    for (ptrdiff_t top = 0; top < height; top += TILE) {
        for (ptrdiff_t left = 0; left < width; left += TILE) {
            const double column = centre_of(left, cell) + middle, row = centre_of(top, cell) + middle;
            find_near(seeds, &all, column, row, most, &near);
            double reach = DBL_MAX;
            if (near.count == most) {
                reach = (sqrt(near.distance_squared[most - 1]) + ways) * enough;
                reach *= reach;
            }
            list_near(seeds, &all, column, row, reach, &listed);
            for (ptrdiff_t y = top; y < top + TILE && y < height; y++) {
                for (ptrdiff_t x = left; x < left + TILE && x < width; x++) {
                    const double at_column = centre_of(x, cell), at_row = centre_of(y, cell);
                    find_near(seeds, &listed, at_column, at_row, most, &near);
                    values[y * width + x] = (float)plane_at(seeds, weights, at_column, at_row, &near);
                }
            }
        }
    }
}
