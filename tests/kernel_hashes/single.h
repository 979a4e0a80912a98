/* Part of main.c: kernels of one version, where compilers and C libraries could differ all the same. */
#include "fusion/fusion.h"
#include "surface/surface.h"
#include "ties/ties.h"

static void run_transfer_disparity(const kernel_table *k, image_size size) {
    (void)k;
    FILL(float, left, PIXELS,
         seldom(8)   ? NAN
         : seldom(8) ? real_between(-1e10f, 1e10f)
                     : x / 9 + real_between(0, 1))
    MAKE(float, right, TARGET_PIXELS);
    transfer_disparity(left, size.height, size.width, size.target_width, 0.7f, right);
    add_floats_to_hash(right, TARGET_PIXELS);
}

static void run_place_windows(const kernel_table *k, image_size size) {
    FILL(double, places, 2 * PIXELS, real_between(-4000, 4000))
    FILL(double, slopes, 2 * PIXELS, 1 + real_between(-0.5f, 0.5f))
    const double matrix[] = {700, 3, 320, -2, 690, 240, 0.01, -0.02, 1};
    enum { WINDOW = 9 * 7 };
    MAKE(float, columns, WINDOW *PIXELS);
    MAKE(float, rows, WINDOW *PIXELS);
    const double flatness[] = {0, 0, 0.5}; /* a plane, a sphere, one with flat columns */
    for (int kind = 0; kind < 3; kind++) {
        for (int scale = 6; scale <= 600; scale *= 10) { /* wide and narrow windows have sines of two kinds */
            const rectified_camera camera = {matrix, 20.5, -3.5, scale, scale + 1, kind > 0, flatness[kind]};
            k->place_windows(places, slopes, camera, PIXELS, 7, 9, columns, rows);
            add_floats_to_hash(columns, WINDOW * PIXELS);
            add_floats_to_hash(rows, WINDOW * PIXELS);
        }
    }
}

static void run_make_templates(const kernel_table *k, image_size size) {
    (void)k;
    enum { SIDE = 9, WINDOW = SIDE * SIDE };
    FILL(float, windows, PIXELS *(SIDE + 2) * (SIDE + 2), grey_of())
    MAKE(float, values, PIXELS *WINDOW);
    MAKE(float, jacobian, PIXELS * PARAMETERS * WINDOW);
    MAKE(float, normal, PIXELS * PARAMETERS * PARAMETERS);
    make_templates(windows, PIXELS, SIDE, SIDE, 2, values, jacobian, normal);
    add_floats_to_hash(values, PIXELS * WINDOW);
    add_floats_to_hash(jacobian, PIXELS * PARAMETERS * WINDOW);
    add_floats_to_hash(normal, PIXELS * PARAMETERS * PARAMETERS);
}

static void run_planes_and_maps(const kernel_table *k, image_size size) {
    (void)k;
    const double K[] = {300, 0, 20, 0, 310, 5, 0, 0, 1},
                 inverse[] = {1 / 300.0, 0, -20 / 300.0, 0, 1 / 310.0, -5 / 310.0, 0, 0, 1};
    FILL(float, normals, 3 * PIXELS, i % 3 == 2 ? -1 : real_between(-0.6f, 0.6f))
    FILL(float, depth, PIXELS, depth_of(x))
    FILL(float, equations, PATCH_EQUATIONS *PIXELS, real_between(0.1f, 2))
    FILL(float, sigma, PIXELS, real_between(0.001f, 0.1f))
    MAKE(float, planes, 3 * PIXELS);
    planes_of_maps(normals, depth, size.width, inverse, (patch_rows){0, 1, size.height}, planes);
    refine_planes(equations, sigma, PIXELS, 0.02f, planes);
    add_floats_to_hash(planes, 3 * PIXELS);
    maps_of_planes(planes, size.height, size.width, K, 0, normals, depth);
    add_floats_to_hash(normals, 3 * PIXELS);
    add_floats_to_hash(depth, PIXELS);
    FILL(float, confirmed, PIXELS, depth_of(x) * real_between(0.99f, 1.01f))
    add_relief(confirmed, sigma, size.height, size.width, depth);
    add_floats_to_hash(depth, PIXELS);
}

static void run_fusion(const kernel_table *k, image_size size) {
    (void)k;
    FILL(float, depth, PIXELS, depth_of(x))
    FILL(float, normals, 3 * PIXELS, i < 2 * PIXELS ? real_between(-0.2f, 0.2f) : -1)
    FILL(int32_t, rows, PIXELS, i / size.width)
    FILL(int32_t, columns, PIXELS, x)
    FILL(uint8_t, image, 3 * PIXELS, random_word())
    FILL(uint8_t, covered, PIXELS, 0)
    FILL(uint8_t, agreeing, PIXELS, 0)
    FILL(uint16_t, colour, 3 * PIXELS, 0)
    MAKE(uint8_t, gate, PIXELS);
    MAKE(float, distance, PIXELS);
    MAKE(float, pair, 2 * PIXELS);
    MAKE(uint8_t, codes, PIXELS);
    const view_maps maps = {depth, normals, size.height, size.width, {.01, 0, 0, 0, .01, 0, 0, 0, 1}};
    const fusion_transfer transfer = {
        {1, .001, .3, -.001, 1, .2, 0, 0, 1}, {2, 1, .01}, {1, .01, 0, -.01, 1, 0, 0, 0, 1}, 1};
    const fusion_verdict verdict = {covered, agreeing, colour, 1};
    find_gates(&maps, &maps, &transfer, (fusion_gates){2, .01f, .95f}, rows, columns, PIXELS, gate, distance);
    fuse_partner(&maps, &maps, image, &transfer, (fusion_gates){2, .01f, .95f}, 5, 0, size.height, &verdict);
    pack_normals(normals, PIXELS, pair, codes);
    HASH(gate, PIXELS);
    add_floats_to_hash(distance, PIXELS);
    HASH(covered, PIXELS);
    HASH(agreeing, PIXELS);
    HASH(colour, 3 * PIXELS);
    add_floats_to_hash(pair, 2 * PIXELS);
    HASH(codes, PIXELS);
}

static void run_draw_heights(const kernel_table *k, image_size size) {
    (void)k;
    FILL(float, depth, PIXELS, depth_of(x))
    FILL(float, normals, 3 * PIXELS, i < 2 * PIXELS ? real_between(-0.2f, 0.2f) : -1)
    FILL(float, raster, TARGET_PIXELS, -1000)
    const drawn_view view = {depth,
                             normals,
                             size.height,
                             size.width,
                             {.01, 0, 0, 0, .01, 0, 0, 0, 1},
                             {11, .1, 0, -.1, 11, 0, .1, .2, -1},
                             {.3, .2, 40}};
    draw_heights(&view, 0.5, 1.5, raster, size.height, size.target_width);
    add_floats_to_hash(raster, TARGET_PIXELS);
}
