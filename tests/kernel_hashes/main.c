/* Runs the kernels on seeded input of odd sizes and prints a hash of what they give, a line per kernel and size.
 *
 * All versions that the processor runs must agree: exit code 1, and a line on the error output, where one differs
 * from the scalar kernels. The standard output depends on the results alone, so that those of two builds (another
 * processor, compiler or system) can be compared as files. Needs no Python:
 *
 *     cmake -S . -B build -DCOLMAP_SPH_MODULE=OFF -DCOLMAP_SPH_KERNEL_HASHES=ON
 *     cmake --build build && build/kernel_hashes
 *
 * `kernel_hashes --run VERSION KERNEL TIMES` calls one kernel so many times on a larger and calmer input, for
 * tools that count instructions, and prints the pixels of a call, or slots where it has 64 of them per pixel. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "dispatch.h"

/* ---- input ------------------------------------------------------------------------------------------------- */

typedef struct {
    ptrdiff_t height, width, target_width, depth;
} image_size;

static uint64_t seed;

/* SplitMix64 (Steele, Lea and Flood 2014). */
static uint64_t random_word(void) {
    uint64_t z = seed += UINT64_C(0x9e3779b97f4a7c15);
    z = (z ^ z >> 30) * UINT64_C(0xbf58476d1ce4e5b9);
    z = (z ^ z >> 27) * UINT64_C(0x94d049bb133111eb);
    return z ^ z >> 31;
}

/* From `least` to `most`. */
static int32_t between(int32_t least, int32_t most) {
    return (int32_t)(least + (int64_t)(random_word() % ((uint64_t)((int64_t)most - least) + 1)));
}

/* Once in so many times; never of a calm input. */
static int calm;
static int seldom(int times) { return !calm && between(1, times) == 1; }

static float real_between(float least, float most) {
    return least + (most - least) * ((float)between(0, (1 << 24) - 1) / (float)(1 << 24));
}

/* Arrays live until the kernel is done; `GUARD` bytes on both sides must stay as they are. */
enum { GUARD = 64, GUARD_BYTE = 0xa5, MAX_ARRAYS = 32 };

static struct {
    uint8_t *memory;
    size_t bytes;
} arrays[MAX_ARRAYS];
static int array_count;

static void *make(ptrdiff_t count, size_t item) {
    const size_t bytes = (size_t)count * item;
    uint8_t *memory = malloc(bytes + 2 * GUARD);
    if (!memory || array_count == MAX_ARRAYS) {
        fputs("kernel_hashes: no memory\n", stderr);
        exit(2);
    }
    memset(memory, GUARD_BYTE, bytes + 2 * GUARD);
    arrays[array_count].memory = memory;
    arrays[array_count++].bytes = bytes;
    return memory + GUARD;
}

#define MAKE(type, name, count) type *name = make(count, sizeof(type))
#define FILL(type, name, count, value) \
    MAKE(type, name, count); \
    for (ptrdiff_t i = 0, x = 0; i < (count); i++, x = i % size.width) { \
        (void)x; \
        name[i] = (type)(value); \
    }

/* False where a kernel wrote beyond an array. */
static int release(void) {
    int whole = 1;
    while (array_count > 0) {
        const uint8_t *memory = arrays[--array_count].memory, *end = memory + GUARD + arrays[array_count].bytes;
        for (int i = 0; i < GUARD; i++) {
            whole &= memory[i] == GUARD_BYTE && end[i] == GUARD_BYTE;
        }
        free(arrays[array_count].memory);
    }
    return whole;
}

static uint64_t census_word(void) { return seldom(9) ? CENSUS_INVALID : random_word() >> (64 - CENSUS_BITS); }

/* Surfaces with steps, and here and there no number that makes sense. */
static int32_t base_of(ptrdiff_t x) {
    return seldom(40) ? between(INT32_MIN, INT32_MAX) : -20 + (int32_t)(x % 30 / 5) * 2 - 40 * seldom(15);
}

static int32_t grey_of(void) { return seldom(10) ? 205 : between(100, 110); }

static float depth_of(ptrdiff_t x) { return seldom(8) ? 0 : 10 + 0.05f * (float)x + real_between(0, 0.02f); }

/* ---- results ----------------------------------------------------------------------------------------------- */

static uint64_t hash;

/* FNV-1a. */
static void add_to_hash(const void *values, ptrdiff_t count, size_t item) {
    const uint8_t *bytes = values;
    const size_t end = (size_t)count * item;
    for (size_t i = 0; i < end; i++) {
        hash = (hash ^ bytes[i]) * UINT64_C(0x100000001b3);
    }
}

#define HASH(name, count) add_to_hash(name, count, sizeof *(name))

/* Which of several numbers that are not numbers comes out, processors may choose. */
static void add_floats_to_hash(const float *values, ptrdiff_t count) {
    for (ptrdiff_t i = 0; i < count; i++) {
        const uint32_t none = 0x7fc00000;
        add_to_hash(isnan(values[i]) ? (const void *)&none : &values[i], 1, sizeof none);
    }
}

/* ---- kernels ----------------------------------------------------------------------------------------------- */

static int failed;
static int times = 1;

#define EACH_TIME for (int n = 0; n < times; n++)

#define PIXELS (size.height * size.width)
#define TARGET_PIXELS (size.height * size.target_width)
#define MATCH_SIZE ((match_size){size.height, size.width, size.target_width, size.depth, size.target_width + 3})

static void run_census(const kernel_table *k, image_size size) {
    const int32_t greys[] = {INT16_MIN, -1, 0, 31, 32, 33, 640, INT16_MAX};
    const ptrdiff_t padded_size = (size.height + 2 * CENSUS_RADIUS_Y) * (size.width + 2 * CENSUS_RADIUS_X);
    FILL(int16_t, padded, padded_size, seldom(3) ? greys[between(0, 7)] : between(0, 16320))
    FILL(uint8_t, valid, PIXELS, !seldom(9))
    MAKE(uint64_t, census, PIXELS);
    uint64_t codes[GREY_CODES];
    make_grey_codes(between(1, 200), codes);
    for (int kind = 0; kind < 4; kind++) {
        const census_image image = {padded, valid, size.height, size.width, kind & 1, kind & 2 ? codes : NULL};
        EACH_TIME k->census(image, size.width, census);
        HASH(census, PIXELS);
    }
}

static void run_cost(const kernel_table *k, image_size size) {
    FILL(uint64_t, reference, PIXELS, census_word())
    FILL(uint64_t, target, TARGET_PIXELS, census_word())
    FILL(int32_t, base, PIXELS, base_of(x))
    MAKE(uint8_t, cost, PIXELS *size.depth);
    EACH_TIME failed |= k->cost(reference, target, base, MATCH_SIZE, cost);
    HASH(cost, PIXELS * size.depth);
}

static void run_aggregation(const kernel_table *k, image_size size) {
    FILL(uint8_t, cost, PIXELS *size.depth, between(0, CENSUS_BITS))
    FILL(int32_t, base, PIXELS, base_of(x))
    FILL(uint8_t, image, PIXELS, grey_of())
    FILL(uint8_t, p2, 256, 120 - i / 3)
    MAKE(uint8_t, detours, PIXELS *size.depth);
    MAKE(uint8_t, sums, PIXELS *size.depth);
    const path_penalties penalties = {10, p2, 3};
    EACH_TIME failed |= k->aggregation(cost, base, image, MATCH_SIZE, penalties, detours, sums);
    HASH(sums, PIXELS * size.depth);
}

static void run_selection(const kernel_table *k, image_size size) {
    FILL(uint8_t, sums, PIXELS *size.depth, between(0, seldom(4) ? 30 : 255))
    FILL(int32_t, base, PIXELS, base_of(x))
    FILL(uint64_t, reference, PIXELS, census_word())
    FILL(uint64_t, target, TARGET_PIXELS, census_word())
    FILL(int32_t, columns, TARGET_PIXELS, seldom(9) ? -1 : i % size.target_width + 3 * seldom(5))
    MAKE(int32_t, offset, PIXELS);
    const left_right_check check = {2, 1};
    EACH_TIME failed |= k->selection(sums, base, reference, target, columns, MATCH_SIZE, check, offset);
    HASH(offset, PIXELS);
}

static void run_match(const kernel_table *k, image_size size) {
    FILL(uint64_t, target, TARGET_PIXELS, census_word())
    FILL(uint64_t, reference, PIXELS, seldom(9) ? census_word() : target[i * size.target_width / size.width])
    FILL(int32_t, columns, TARGET_PIXELS, i % size.target_width)
    FILL(int32_t, base, PIXELS, base_of(x))
    FILL(uint8_t, image, PIXELS, grey_of())
    FILL(uint8_t, p2, 256, 120 - i / 3)
    MAKE(uint8_t, scratch, 2 * PIXELS * size.depth);
    MAKE(int32_t, offset, PIXELS);
    const match_input input = {reference, target, columns, base, base, image, MATCH_SIZE, {10, p2, 3}, {2, 5}};
    /* In two bands, the second one first. */
    const ptrdiff_t half = size.height / 2, bytes = (ptrdiff_t)k->sweep_bytes(MATCH_SIZE);
    const row_band bands[2] = {{0, half, 0, size.height - half}, {half, size.height, half, 0}};
    MAKE(uint8_t, forward, bytes);
    MAKE(uint8_t, backward, bytes);
    EACH_TIME {
        failed |= k->sweep(&input, bands[0], 0, forward);
        failed |= k->match(&input, bands[1], forward, backward, scratch, offset + half * size.width);
        failed |= k->match(&input, bands[0], forward, backward, scratch, offset);
    }
    HASH(offset, PIXELS);
}

/* Offsets of a surface, with outliers. */
static int32_t offset_of(ptrdiff_t x) {
    return seldom(9)   ? OFFSET_INVALID
           : seldom(9) ? between(-5000, 5000)
                       : (int32_t)(37 * x % 900) + between(0, 90);
}

static void run_fit_offsets(const kernel_table *k, image_size size) {
    FILL(int32_t, offset, PIXELS, offset_of(x))
    FILL(uint64_t, reference, PIXELS, census_word())
    FILL(uint64_t, target, TARGET_PIXELS, seldom(3) ? census_word() : reference[i % PIXELS])
    MAKE(int32_t, fitted, PIXELS);
    EACH_TIME failed |= k->fit_offsets(offset, reference, target, MATCH_SIZE, fitted);
    HASH(fitted, PIXELS);
}

static void run_mean_offsets(const kernel_table *k, image_size size) {
    FILL(int32_t, offset, PIXELS, offset_of(x))
    MAKE(int32_t, mean, PIXELS);
    EACH_TIME k->mean_offsets(offset, size.height, size.width, 3, 768, mean);
    HASH(mean, PIXELS);
}

static void depth_candidates_of(const kernel_table *k, image_size size, int spherical, double flatness) {
    FILL(float, disparity, PIXELS, seldom(8) ? NAN : 8 + 0.02f * (float)x + real_between(0, 0.5f))
    MAKE(float, depth, PIXELS);
    MAKE(float, sigma, PIXELS);
    const double scale = 1.0 / 64, u = -0.5 * (double)size.width, v = -0.5 * (double)size.height;
    const pair_geometry geometry = {{scale, 0, scale * u, 0, scale, scale * v, 0.001, -0.002, 1},
                                    60,
                                    60,
                                    60 * scale * u,
                                    60 * scale * v,
                                    1.5,
                                    2,
                                    0.3,
                                    1.5,
                                    spherical,
                                    flatness,
                                    spherical};
    EACH_TIME k->depth_candidates(disparity, size.height, size.width, &geometry, 0, size.height, size.width, depth,
                                  sigma);
    add_floats_to_hash(depth, PIXELS);
    add_floats_to_hash(sigma, PIXELS);
}

static void run_depth_candidates(const kernel_table *k, image_size size) {
    depth_candidates_of(k, size, 0, 0);
    depth_candidates_of(k, size, 1, 0);
    depth_candidates_of(k, size, 1, 0.5);
}

static void run_vote_depth(const kernel_table *k, image_size size) {
    enum { PAIRS = 9 };
    FILL(float, depths, PAIRS *PIXELS, depth_of(x))
    FILL(float, sigmas, PAIRS *PIXELS, real_between(0.01f, 0.1f))
    FILL(int32_t, stations, PAIRS, i * 2 / 3)
    MAKE(float, depth, PIXELS);
    MAKE(float, sigma, PIXELS);
    MAKE(uint8_t, support, PIXELS);
    EACH_TIME failed |= k->vote_depth(depths, sigmas, stations, PAIRS, PIXELS, 3, depth, sigma, support);
    add_floats_to_hash(depth, PIXELS);
    add_floats_to_hash(sigma, PIXELS);
    HASH(support, PIXELS);
}

static void run_compare_depths(const kernel_table *k, image_size size) {
    FILL(float, depth, PIXELS, depth_of(x))
    FILL(float, sigma, PIXELS, real_between(0.01f, 0.1f))
    FILL(float, partner_depth, PIXELS, depth_of(x))
    FILL(float, partner_sigma, PIXELS, real_between(0.01f, 0.1f))
    FILL(uint8_t, support, PIXELS, between(0, 4))
    FILL(uint8_t, counts, 3 * PIXELS, between(0, 255))
    FILL(float, sums, 2 * PIXELS, real_between(-1, 1))
    const depth_map reference = {depth, sigma, support, size.height, size.width};
    const depth_map partner = {partner_depth, partner_sigma, support, size.height, size.width};
    const view_transfer transfer = {{1, 0.001, 0.1, -0.001, 1, 0.2, 0, 0, 1},
                                    {-15, 2, 0.1},
                                    {1, -0.001, -0.1, 0.001, 1, -0.2, 0, 0, 1},
                                    {15, -2, -0.1}};
    const consistency_gates gates = {2, 4.5f, 2, 0};
    const consistency_sums verdict = {counts, counts + PIXELS, counts + 2 * PIXELS, sums, sums + PIXELS};
    EACH_TIME k->compare_depths(&reference, &partner, &transfer, gates, &verdict);
    HASH(counts, 3 * PIXELS);
    add_floats_to_hash(sums, 2 * PIXELS);
}

static void run_fit_planes(const kernel_table *k, image_size size) {
    FILL(float, inverse, PIXELS, seldom(8) ? 0 : 1 / depth_of(x))
    FILL(float, sigma, PIXELS, real_between(1e-4f, 1e-3f))
    FILL(uint8_t, support, PIXELS, between(0, 4))
    MAKE(float, normals, 3 * PIXELS);
    MAKE(float, fitted, PIXELS);
    const double K[9] = {60, 0, 0.5 * (double)size.width, 0, 61, 0.5 * (double)size.height, 0, 0, 1};
    const plane_fit fit = {3, 3, 2, 3, 0.2f, 3};
    EACH_TIME failed |= k->fit_planes(inverse, sigma, support, size.height, size.width, K, &fit, normals, fitted);
    add_floats_to_hash(normals, 3 * PIXELS);
    add_floats_to_hash(fitted, PIXELS);
}

static void run_add_patch_equations(const kernel_table *k, image_size size) {
    FILL(uint8_t, grey, PIXELS, 7 * i + between(0, 60))
    FILL(uint8_t, source, PIXELS, 7 * i + between(0, 60))
    FILL(uint16_t, pairs, PIXELS - size.width, source[i] | source[i + size.width] << 8)
    FILL(float, planes, 3 * PIXELS, i < PIXELS ? (seldom(8) ? 0 : 1 / depth_of(x)) : real_between(-1e-4f, 1e-4f))
    FILL(float, equations, PATCH_EQUATIONS *PIXELS, 0)
    const grey_image reference = {grey, size.height, size.width};
    const patch_source sources[2] = {
        {{pairs, size.height - 1, size.width}, {1, 0.01, 0.1, -0.01, 1, 0.2, 0, 0, 1}, {15, 2, 0.1}},
        {{pairs, size.height - 1, size.width}, {1, 0, 0, 0, 1, 0, 0, 0, 1}, {-9, -2, 0}}};
    const patch_rows rows = {0, 1, size.height};
    const patch_options options = {20, -1};
    FILL(uint32_t, used, (size.width + PATCH_TILE - 1) / PATCH_TILE, 3 - seldom(3))
    EACH_TIME k->add_patch_equations(&reference, sources, 2, used, planes, rows, options, equations);
    add_floats_to_hash(equations, PATCH_EQUATIONS * PIXELS);
}

#include "single.h"

/* ---- all of them ------------------------------------------------------------------------------------------- */

typedef struct {
    const char *name;
    void (*run)(const kernel_table *kernels, image_size size);
    int has_depth; /* its work grows with `depth` */
} kernel;

#define KERNEL(name, has_depth) {#name, run_##name, has_depth}
static const kernel kernels[] = {KERNEL(census, 0),
                                 KERNEL(cost, 1),
                                 KERNEL(aggregation, 1),
                                 KERNEL(selection, 1),
                                 KERNEL(match, 1),
                                 KERNEL(fit_offsets, 0),
                                 KERNEL(mean_offsets, 0),
                                 KERNEL(depth_candidates, 0),
                                 KERNEL(vote_depth, 0),
                                 KERNEL(compare_depths, 0),
                                 KERNEL(fit_planes, 0),
                                 KERNEL(add_patch_equations, 0),
                                 KERNEL(transfer_disparity, 0),
                                 KERNEL(place_windows, 0),
                                 KERNEL(make_templates, 0),
                                 KERNEL(planes_and_maps, 0),
                                 KERNEL(fusion, 0),
                                 KERNEL(draw_heights, 0)};
enum { KERNELS = sizeof kernels / sizeof *kernels };

static const image_size sizes[] = {{1, 1, 1, 32},      {1, 31, 40, 64},   {3, 33, 33, 32},  {5, 7, 9, 96},
                                   {2, 65, 1, 128},    {7, 32, 30, 64},   {4, 50, 61, 160}, {9, 17, 17, 192},
                                   {13, 129, 120, 64}, {11, 261, 300, 32}};
enum { SIZES = sizeof sizes / sizeof *sizes };

/* The hash of what one version gives. */
static uint64_t run(const kernel *which, const kernel_table *version, image_size size) {
    seed = 1;
    hash = UINT64_C(0xcbf29ce484222325);
    failed = 0;
    which->run(version, size);
    const int whole = release();
    if (failed || !whole) {
        fprintf(stderr, "%s: %s %s\n", version->name, which->name, failed ? "failed" : "wrote beyond its arrays");
        exit(1);
    }
    return hash;
}

static int compare_versions(void) {
    int different = 0;
    const kernel_table *scalar = kernels_by_name("scalar");
    for (int k = 0; k < KERNELS; k++) {
        for (int s = 0; s < SIZES; s++) {
            const uint64_t expected = run(&kernels[k], scalar, sizes[s]);
            printf("%s %d %d %d %d %08lx%08lx\n", kernels[k].name, (int)sizes[s].height, (int)sizes[s].width,
                   (int)sizes[s].target_width, (int)sizes[s].depth, (unsigned long)(expected >> 32),
                   (unsigned long)(expected & 0xffffffff));
            for (const char *const *name = kernel_names; *name; name++) {
                const kernel_table *version = kernels_by_name(*name);
                if (version && run(&kernels[k], version, sizes[s]) != expected) {
                    fprintf(stderr, "%s: %s of %d x %d differs from scalar\n", *name, kernels[k].name,
                            (int)sizes[s].height, (int)sizes[s].width);
                    different = 1;
                }
            }
        }
    }
    return different;
}

static int run_one(const char *version, const char *name) {
    const image_size size = {48, 512, 500, 64};
    const kernel_table *table = kernels_by_name(version);
    for (int k = 0; k < KERNELS && table; k++) {
        if (strcmp(kernels[k].name, name) == 0) {
            run(&kernels[k], table, size);
            printf("%d\n", (int)(size.height * size.width * (kernels[k].has_depth ? size.depth : 1)));
            return 0;
        }
    }
    fprintf(stderr, "kernel_hashes: no %s of version %s\n", name, version);
    return 2;
}

int main(int argc, char **argv) {
    if (argc == 5 && strcmp(argv[1], "--run") == 0) {
        calm = 1;
        times = atoi(argv[4]);
        return run_one(argv[2], argv[3]);
    }
    for (const char *const *name = kernel_names; *name; name++) {
        if (kernels_by_name(*name)) {
            fprintf(stderr, "kernels: %s\n", *name);
        }
    }
    return compare_versions();
}
