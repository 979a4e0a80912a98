/* The kernels of fusion as Python's functions. */
#include "boundary.h"

#include <string.h>

#include "fusion/fusion.h"
#include "geometry.h"

_Static_assert(POINT_BYTES == 27 && 1 + MAX_FUSION_PARTNERS == 65, "tables below");

#define FUSE_PARTNER(X) \
    X(IN, float32, depth, H, W) \
    X(IN, float32, normals, 3, H, W) \
    X(IN, float64, ray_from_pixel, 3, 3) \
    X(IN, float32, partner_depth, PARTNER_H, PARTNER_W) \
    X(IN, float32, partner_normals, 3, PARTNER_H, PARTNER_W) \
    X(IN, float64, partner_ray_from_pixel, 3, 3) \
    X(IN, uint8, partner_image, PARTNER_H, PARTNER_W, 3) \
    X(IN, float64, partner_from_reference, 3, 4) \
    X(IN, float64, normal_from_partner, 3, 3) \
    X(VALUE, float, max_reprojection_error) \
    X(VALUE, float, max_depth_error) \
    X(VALUE, float, min_normal_cosine) \
    X(VALUE, flag, partner_wins) \
    X(VALUE, int, bit) \
    X(VALUE, ptrdiff, first_row) \
    X(VALUE, ptrdiff, end_row) \
    X(OUT, uint8, covered, H, W) \
    X(OUT, uint8, agreeing, BYTES, H, W) \
    X(OUT, uint16, colour, H, W, 3)
ARGUMENTS(fuse_partner, FUSE_PARTNER);

static int check_rows(ptrdiff_t first_row, ptrdiff_t end_row, ptrdiff_t height) {
    return check(0 <= first_row && first_row <= end_row && end_row <= height, "the rows must lie in the map");
}

static int check_fuse_partner(const void *arguments) {
    const fuse_partner_arguments *a = arguments;
    return check(a->bit >= 0 && a->bit / 8 < a->size.BYTES, "the partner's bit must be one of a pixel's") &&
           check_rows(a->first_row, a->end_row, a->size.H);
}

static view_maps maps_with_rays(const float *depth, const float *normals, ptrdiff_t height, ptrdiff_t width,
                                const double *ray_from_pixel) {
    view_maps maps = {.depth = depth, .normals = normals, .height = height, .width = width};
    memcpy(maps.ray_from_pixel, ray_from_pixel, sizeof maps.ray_from_pixel);
    return maps;
}

static int run_fuse_partner(void *arguments) {
    const fuse_partner_arguments *a = arguments;
    const view_maps reference = maps_with_rays(a->depth, a->normals, a->size.H, a->size.W, a->ray_from_pixel);
    const view_maps partner = maps_with_rays(a->partner_depth, a->partner_normals, a->size.PARTNER_H,
                                             a->size.PARTNER_W, a->partner_ray_from_pixel);
    const fusion_gates gates = {a->max_reprojection_error, a->max_depth_error, a->min_normal_cosine};
    const fusion_verdict verdict = {a->covered, a->agreeing, a->colour, a->size.BYTES};
    fusion_transfer transfer = {.partner_wins = a->partner_wins};
    split_transfer(a->partner_from_reference, transfer.pixel_from_reference, transfer.translation);
    memcpy(transfer.reference_from_partner, a->normal_from_partner, sizeof transfer.reference_from_partner);
    fuse_partner(&reference, &partner, a->partner_image, &transfer, gates, a->bit, a->first_row, a->end_row,
                 &verdict);
    return 0;
}

FUNCTION(fuse_partner, FUSE_PARTNER, check_fuse_partner,
         "Add a partner's verdict on the pixels of a view's rows: covered by a finer pixel, or seen by it, too.");

#define FIND_GATES(X) \
    X(IN, float32, depth, H, W) \
    X(IN, float32, normals, 3, H, W) \
    X(IN, float32, partner_depth, PARTNER_H, PARTNER_W) \
    X(IN, float32, partner_normals, 3, PARTNER_H, PARTNER_W) \
    X(IN, float64, partner_from_reference, 3, 4) \
    X(IN, float64, normal_from_partner, 3, 3) \
    X(VALUE, float, max_depth_error) \
    X(VALUE, float, min_normal_cosine) \
    X(IN, int32, rows, POINTS) \
    X(IN, int32, columns, POINTS) \
    X(OUT, uint8, gate, POINTS) \
    X(OUT, float32, distance, POINTS)
ARGUMENTS(find_gates, FIND_GATES);

static int check_find_gates(const void *arguments) {
    const find_gates_arguments *a = arguments;
    int inside = 1;
    for (ptrdiff_t k = 0; k < a->size.POINTS; k++) {
        inside &= 0 <= a->rows[k] && a->rows[k] < a->size.H && 0 <= a->columns[k] && a->columns[k] < a->size.W;
    }
    return check(inside, "the rows and columns must lie in the map");
}

static int run_find_gates(void *arguments) {
    const find_gates_arguments *a = arguments;
    const view_maps reference = {a->depth, a->normals, a->size.H, a->size.W, {0}};
    const view_maps partner = {a->partner_depth, a->partner_normals, a->size.PARTNER_H, a->size.PARTNER_W, {0}};
    const fusion_gates gates = {0, a->max_depth_error, a->min_normal_cosine};
    fusion_transfer transfer = {.partner_wins = 0};
    split_transfer(a->partner_from_reference, transfer.pixel_from_reference, transfer.translation);
    memcpy(transfer.reference_from_partner, a->normal_from_partner, sizeof transfer.reference_from_partner);
    find_gates(&reference, &partner, &transfer, gates, a->rows, a->columns, a->size.POINTS, a->gate, a->distance);
    return 0;
}

FUNCTION(
    find_gates, FIND_GATES, check_find_gates,
    "What keeps a partner from agreeing with pixels: 0 unseen, 1 depth, 2 normal, 3 nothing; and the distance of\n"
    "their projections from the centre of the partner's pixel.");

/* ---- less memory ------------------------------------------------------------------------------------------- */

#define PACK_NORMALS(X) \
    X(IN, float32, normals, 3, H, W) \
    X(OUT, float32, pair, 2, H, W) \
    X(OUT, uint8, codes, H, W)
#define UNPACK_NORMALS(X) \
    X(IN, float32, pair, 2, H, W) \
    X(IN, uint8, codes, H, W) \
    X(OUT, float32, normals, 3, H, W)
ARGUMENTS(pack_normals, PACK_NORMALS);
ARGUMENTS(unpack_normals, UNPACK_NORMALS);

static int run_pack_normals(void *arguments) {
    const pack_normals_arguments *a = arguments;
    pack_normals(a->normals, a->size.H * a->size.W, a->pair, a->codes);
    return 0;
}

static int run_unpack_normals(void *arguments) {
    const unpack_normals_arguments *a = arguments;
    unpack_normals(a->pair, a->codes, a->size.H * a->size.W, a->normals);
    return 0;
}

FUNCTION(
    pack_normals, PACK_NORMALS, any,
    "Two components of each unit vector, and a code from which the largest follows to the bit; code 3: it does\n"
    "not.");
FUNCTION(unpack_normals, UNPACK_NORMALS, any, "What was packed.");

/* ---- points ------------------------------------------------------------------------------------------------ */

#define FUSED_ROWS(X) \
    X(IN, float32, depth, H, W) \
    X(IN, float32, normals, 3, H, W) \
    X(IN, uint8, covered, H, W) \
    X(IN, uint8, agreeing, BYTES, H, W) \
    X(IN, uint16, colour, H, W, 3) \
    X(VALUE, int, min_stations) \
    X(IN, uint64, stations, 2) \
    X(VALUE, ptrdiff, first_row) \
    X(VALUE, ptrdiff, end_row)

#define COUNT_POINTS(X) \
    FUSED_ROWS(X) \
    X(RESULT, points) \
    X(RESULT, words)

#define WRITE_POINTS(X) \
    FUSED_ROWS(X) \
    X(IN, float64, world_from_pixel, 3, 3) \
    X(IN, float64, world_from_camera, 3, 3) \
    X(IN, float64, centre, 3) \
    X(IN, uint32, indices, 65) \
    X(OUT, uint8, points, POINTS, 27) \
    X(OUT, uint32, visibility, WORDS)
ARGUMENTS(count_points, COUNT_POINTS);
ARGUMENTS(write_points, WRITE_POINTS);

static int check_fused_rows(ptrdiff_t first_row, ptrdiff_t end_row, const sizes *size) {
    return check(size->BYTES <= MAX_FUSION_PARTNERS / 8, "a pixel must have no more than 64 bits") &&
           check_rows(first_row, end_row, size->H);
}

/* Both have these arguments. */
#define FUSED_ROWS_OF(a) \
    {&(view_maps){(a)->depth, (a)->normals, (a)->size.H, (a)->size.W, {0}}, \
     &(fusion_verdict){(uint8_t *)(a)->covered, (uint8_t *)(a)->agreeing, (uint16_t *)(a)->colour, \
                       (a)->size.BYTES}, \
     (a)->first_row, (a)->end_row, (a)->min_stations, (a)->stations[0], (a)->stations[1]}

static int check_count_points(const void *arguments) {
    const count_points_arguments *a = arguments;
    return check_fused_rows(a->first_row, a->end_row, &a->size);
}

static int run_count_points(void *arguments) {
    count_points_arguments *a = arguments;
    const fused_rows rows = FUSED_ROWS_OF(a);
    count_points(&rows, &a->points, &a->words);
    return 0;
}

FUNCTION(count_points, COUNT_POINTS, check_count_points,
         "Points that the rows of a view become, and words that name the views which see them.");

static int check_write_points(const void *arguments) {
    const write_points_arguments *a = arguments;
    if (!check_fused_rows(a->first_row, a->end_row, &a->size)) {
        return 0;
    }
    /* The arrays must hold what will be written, and nothing may change it meanwhile: counted here again. */
    const fused_rows rows = FUSED_ROWS_OF(a);
    ptrdiff_t points, words;
    count_points(&rows, &points, &words);
    return check_size("points", 0, a->size.POINTS, points) && check_size("visibility", 0, a->size.WORDS, words);
}

static int run_write_points(void *arguments) {
    const write_points_arguments *a = arguments;
    const fused_rows rows = FUSED_ROWS_OF(a);
    point_frame frame = {.indices = a->indices};
    memcpy(frame.world_from_pixel, a->world_from_pixel, sizeof frame.world_from_pixel);
    memcpy(frame.world_from_camera, a->world_from_camera, sizeof frame.world_from_camera);
    memcpy(frame.centre, a->centre, sizeof frame.centre);
    write_points(&rows, &frame, a->points, a->visibility);
    return 0;
}

FUNCTION(write_points, WRITE_POINTS, check_write_points,
         "Points as in a PLY file: position and normal as float32, red, green, blue; and for each the number of\n"
         "views that see it, and their indices. POINTS and WORDS are what count_points returns.");

native_function *const fusion_functions[] = {&fuse_partner_function,
                                             &find_gates_function,
                                             &pack_normals_function,
                                             &unpack_normals_function,
                                             &count_points_function,
                                             &write_points_function,
                                             NULL};
