/* The kernels of colmap_sph: plain C on plain arrays, no Python, no global state, re-entrant.
 *
 * All images are row-major and contiguous. Matching kernels compare a reference image with a target image of the
 * same height: slot `i` of reference pixel (y, x) stands for the target pixel (y, x + base[y, x] + i),
 * 0 <= i < depth. `depth` is a multiple of 32. Sizes are checked by the caller (module.c).
 * A kernel that returns int gives 0, or -1 when it cannot allocate its scratch memory. */
#ifndef COLMAP_SPH_KERNELS_H
#define COLMAP_SPH_KERNELS_H

#include <stddef.h>
#include <stdint.h>

enum {
    CENSUS_RADIUS_X = 4, /* 9 x 7 window, 62 comparisons */
    CENSUS_RADIUS_Y = 3,
    CENSUS_BITS = 62,
    COST_UNSEEN = 32, /* target pixel outside its image: as bad as a random match (62 / 2), no worse */
    /* A path cost is at most CENSUS_BITS + P2, which NO_SLOT exceeds. NO_SLOT + P1 and 2 P2 fit in 8 bits. */
    MAX_P1 = 63,
    MAX_P2 = 127,
    NO_SLOT = 192,
    DEPTH_STEP = 32,
    MAX_DEPTH = 1024,
    MAX_FIT_RADIUS = 16,
    MAX_OFFSET_STEP = 512, /* 1/256 pixel: neighbours whose offsets differ by more are not one surface */
    MAX_REFINEMENT = 256   /* 1/256 pixel */
};

/* Census images come in 1/64 grey value (_CENSUS_STEPS in matching.py); a difference up to half a grey value,
 * which may be rounding, counts as none. */
enum { CENSUS_MARGIN = 32 };

/* Bit 63 of a census word marks a pixel without image content. */
#define CENSUS_INVALID (UINT64_C(1) << 63)
#define OFFSET_INVALID INT32_MIN

typedef struct {
    ptrdiff_t height, width, target_width, depth;
} match_size;

/* ---- kernels with versions per instruction set, equal to the bit ------------------------------------------- */

/* `padded` is the image with a border of CENSUS_RADIUS_{Y,X}; bit set where the neighbour is darker by more than
 * CENSUS_MARGIN. */
typedef void census_fn(const int16_t *padded, const uint8_t *valid, ptrdiff_t height, ptrdiff_t width,
                       uint64_t *census);

typedef int cost_fn(const uint64_t *reference, const uint64_t *target, const int32_t *base, match_size size,
                    uint8_t *cost);

typedef struct {
    uint8_t p1;
    const uint8_t *p2; /* by absolute intensity difference; p1 <= p2 <= MAX_P2, p1 <= MAX_P1 */
    /* Bases of neighbours that differ by at most this are taken for the slope of one surface, which then costs
     * nothing to follow. */
    int32_t max_slant;
} path_penalties;

/* Half of the sum over 8 paths, rounded up, and on the way what the first four add to the costs; see
 * aggregation_scalar.c. */
typedef int aggregation_fn(const uint8_t *cost, const int32_t *base, const uint8_t *image, match_size size,
                           path_penalties penalties, uint8_t *detours, uint8_t *aggregated);

/* Of all sums that point at a winner's target pixel there is a least one. The winner passes the check if its own
 * sum is larger by at most `max_excess`, or if one of the least is at most `max_difference` columns from it. */
typedef struct {
    int32_t max_difference, max_excess;
} left_right_check;

/* Winner, left-right check from the same volume, sub-pixel offset in 1/256 pixel or OFFSET_INVALID. */
typedef int selection_fn(const uint8_t *aggregated, const int32_t *base, const uint64_t *reference,
                         const uint64_t *target, match_size size, left_right_check check, int32_t *offset);

typedef struct {
    const uint64_t *reference, *target;
    const int32_t *base;
    const uint8_t *image;
    match_size size;
    path_penalties penalties;
    left_right_check check;
} match_input;

/* Cost, aggregation and selection in one. `scratch` has room for 2 bytes per slot of `band_rows` rows; the result
 * does not depend on their number, but with fewer rows than the image has, half of the sweeps are done twice. */
typedef int match_fn(const match_input *input, ptrdiff_t band_rows, uint8_t *scratch, int32_t *offset);

/* Offsets fitted to the raw costs of a window around each pixel; `size.depth` is not used. */
typedef int refine_offsets_fn(const int32_t *offset, const uint64_t *reference, const uint64_t *target,
                              match_size size, int32_t *refined);

/* How to read a rectified pair's disparity along the rays of one of its images. */
typedef struct {
    double rectified_from_pixel[9]; /* pixel (col, row, 1) to its ray, of depth 1, in the rectified frame */
    double columns_per_radian, rows_per_radian; /* sphere; focal length in pixels for the planar model */
    double column_origin, row_origin;           /* angle (or tangent) times scale, at array coordinate 0 */
    double disparity_origin;                    /* added to a disparity before it is turned into a parallax */
    double baseline;
    double disparity_sigma; /* standard deviation of a disparity, pixels */
    double max_disparity_step;
    int spherical; /* 1: sphere, 0: plane */
    int is_left;   /* the rays belong to the left image */
} pair_geometry;

/* z-depth and its standard deviation for rows [first_row, first_row + rows) of a depth map; 0 = none. */
typedef void depth_candidates_fn(const float *disparity, ptrdiff_t map_height, ptrdiff_t map_width,
                                 const pair_geometry *geometry, ptrdiff_t first_row, ptrdiff_t rows,
                                 ptrdiff_t columns, float *depth, float *sigma);

typedef struct {
    int radius;
    float tolerance;   /* standard deviations from the plane within which a neighbour counts */
    float max_shift;   /* most that a depth may differ from its plane's: pixel sizes, or its changes per pixel
                          where these are more, and ... */
    float shift_sigma; /* ... standard deviations; both must be exceeded to drop it */
    float min_cosine;  /* of the angle between ray and normal, where ... */
    int supported;     /* ... less than this support the depth */
} plane_fit;

/* Normals (camera frame, unit, towards the camera; interleaved x, y, z) from robust local planes in inverse
 * depth, and the depth of each plane at its centre; zeros where no plane fits. */
typedef int fit_planes_fn(const float *inverse_depth, const float *inverse_sigma, const uint8_t *support,
                          ptrdiff_t height, ptrdiff_t width, const double *K, const plane_fit *fit, float *normals,
                          float *fitted_depth);

typedef struct {
    const uint8_t *values;
    ptrdiff_t height, width;
} grey_image;

typedef struct {
    float contrast;  /* grey values: pixels that differ by more from the middle of a window hardly count */
    float min_score; /* windows that correlate less do not count */
} patch_options;

/* Per pixel, one plane of an array each: weight; weighted squared difference; weighted squared parallax per
 * inverse depth; right side (3) and upper triangle (6) of the normal equations. */
enum { PATCH_EQUATIONS = 12 };

/* An image to match in: a pixel (x, y, 1) of the reference with inverse depth w lies at
 * matrix (x, y, 1) + w translation. */
typedef struct {
    grey_image image;
    double matrix[9], translation[3];
} patch_source;

enum { MAX_PATCH_SOURCES = 32 }; /* in one call */

/* Every so many rows of an image, from the first. */
typedef struct {
    ptrdiff_t first, step, count;
} patch_rows;

/* Adds the normal equations of matching a reference's pixels in each of the sources. `planes` (3 arrays of inverse
 * depth, 0 = none, and its change along x and y) and `equations` belong to that many rows of the reference. */
typedef void add_patch_equations_fn(const grey_image *reference, const patch_source *sources, ptrdiff_t count,
                                    const float *planes, patch_rows rows, patch_options options, float *equations);

/* A view's depth (0 = none), its standard deviation, and how many pairs are behind it (of a reference nobody
 * asks); fewer than 2^31 rows and columns. */
typedef struct {
    const float *depth, *sigma;
    const uint8_t *support;
    ptrdiff_t height, width;
} depth_map;

typedef struct {
    double pixel_from_reference[9]; /* partner's K R K_ref^-1 */
    double translation[3];          /* partner's K t */
    double reference_from_pixel[9]; /* and back */
    double back_translation[3];
} view_transfer;

typedef struct {
    float max_reprojection_error; /* pixels */
    float tolerance;              /* standard deviations that depths may differ by */
    int min_support;              /* pairs behind a depth that contradicts */
} consistency_gates;

/* Of the partners so far, per pixel: how many have the point in view and see nothing in front of it, agree, and
 * contradict; and the running weighted sums of their depths, carried to the pixel's ray, less its own. */
typedef struct {
    uint8_t *observing, *agreeing, *contradicting;
    float *weighted_depth, *weight;
} consistency_sums;

/* Adds the partner's verdict on every pixel of the reference. */
typedef void check_consistency_fn(const depth_map *reference, const depth_map *partner,
                                  const view_transfer *transfer, consistency_gates gates,
                                  const consistency_sums *sums);

typedef struct {
    const char *name;
    census_fn *census;
    cost_fn *cost;
    aggregation_fn *aggregation;
    selection_fn *selection;
    match_fn *match;
    refine_offsets_fn *refine_offsets;
    depth_candidates_fn *depth_candidates;
    check_consistency_fn *check_consistency;
    fit_planes_fn *fit_planes;
    add_patch_equations_fn *add_patch_equations;
} kernel_table;

census_fn census_scalar, census_avx2;
refine_offsets_fn refine_offsets_scalar, refine_offsets_avx2, refine_offsets_avx512;
depth_candidates_fn depth_candidates_scalar, depth_candidates_avx2;
check_consistency_fn check_consistency_scalar, check_consistency_avx2;
fit_planes_fn fit_planes_scalar, fit_planes_avx2, fit_planes_avx512;
add_patch_equations_fn add_patch_equations_scalar, add_patch_equations_avx2, add_patch_equations_avx512;

/* The table of this name, NULL when the processor or the build has no such version. */
const kernel_table *kernels_by_name(const char *name);

/* ---- floating-point kernels: one version, so that the result never depends on the processor ---------------- */

/* Carry a disparity map from the left image's columns to the right image's, row by row (NaN = none). */
void transfer_disparity(const float *left, ptrdiff_t height, ptrdiff_t left_width, ptrdiff_t right_width,
                        float max_step, float *right);

/* The largest mutually consistent cluster of `count` candidates per pixel, its weighted mean and size. */
void vote_depth(const float *depths, const float *sigmas, ptrdiff_t count, ptrdiff_t pixels, float tolerance,
                float *depth, float *sigma, uint8_t *support);

enum { SURFACE_RADIUS = 3 };

typedef struct {
    int min_consistent;      /* views that must agree, or all that have the point in view; one at least */
    float max_contradiction; /* most that look through it, per agreeing view */
    float min_surface;       /* least share of the window that must be on the surface where one view agrees */
    float steepest;          /* largest relative change of depth per pixel there */
} confirmation;

/* Turns the verdicts of all partners into the geometric map, in place: `weighted_depth` becomes depth, `weight`
 * its standard deviation, `agreeing` its support; zeros where the depth is not confirmed. `contradicting` is
 * spoilt. */
void confirm_depth(const float *depth, const float *sigma, ptrdiff_t height, ptrdiff_t width,
                   const confirmation *options, const uint8_t *observing, uint8_t *agreeing,
                   uint8_t *contradicting, float *weighted_depth, float *weight);

/* Moves planes by the solution of their equations: of the inverse depth with standard deviation `sigma`, of its
 * change per pixel with `slope_sigma` times the inverse depth. Planes without equations stay. */
void refine_planes(const float *equations, const float *sigma, ptrdiff_t pixels, float slope_sigma, float *planes);

enum { MAX_FUSION_PARTNERS = 64 }; /* a bit for each of them */

/* A view's depth map, its normals (three planes) and K^-1. */
typedef struct {
    const float *depth, *normals;
    ptrdiff_t height, width;
    double ray_from_pixel[9];
} view_maps;

/* From one view to another: its pixel ~ A (column, row, 1) depth + a; and how to turn its normals back. */
typedef struct {
    double pixel_from_reference[9];
    double translation[3];
    double reference_from_partner[9];
    int partner_wins; /* where both see a point equally well */
} fusion_transfer;

typedef struct {
    float max_reprojection_error, max_depth_error, min_normal_cosine;
} fusion_gates;

/* What the partners say of each pixel of the reference. */
typedef struct {
    uint8_t *covered;   /* 1: a partner sees the same piece of surface with a finer pixel */
    uint64_t *agreeing; /* a bit for each partner that sees the same surface */
    uint16_t *colour;   /* (..., 3) sums over these */
} fusion_verdict;

/* Adds the verdict of the partner with this bit, whose `image` has three channels. Pixels that are covered already
 * are passed over. */
void fuse_partner(const view_maps *reference, const view_maps *partner, const uint8_t *image,
                  const fusion_transfer *transfer, fusion_gates gates, int bit, const fusion_verdict *verdict);

/* Rows of a view's pixels that are to become points: not covered, and seen by this many views, itself among them.
 */
typedef struct {
    const view_maps *maps;
    const fusion_verdict *verdict;
    ptrdiff_t first_row, end_row;
    int min_views;
} fused_rows;

enum { POINT_BYTES = 6 * 4 + 3 };

typedef struct {
    double world_from_pixel[9];  /* R^T K^-1 */
    double world_from_camera[9]; /* R^T */
    double centre[3];
    const uint32_t *indices; /* 1 + number of partners: of the view, and of the partner with each bit */
} point_frame;

/* The number of points, and of words that name the views which see them. */
void count_points(const fused_rows *rows, ptrdiff_t *points, ptrdiff_t *words);

/* Points as in a PLY file (position and normal as float32, red, green, blue); for each its number of views and
 * their indices. */
void write_points(const fused_rows *rows, const point_frame *frame, uint8_t *points, uint32_t *visibility);

#endif
