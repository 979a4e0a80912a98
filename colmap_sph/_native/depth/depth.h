/* Kernels of depth: from disparities to depth maps, their check against each other, normals and refinement. */
#ifndef COLMAP_SPH_DEPTH_H
#define COLMAP_SPH_DEPTH_H

#include "common.h"

/* ---- kernels with versions per instruction set, equal to the bit ------------------------------------------- */

/* How to read a rectified pair's disparity along the rays of one of its images. */
typedef struct {
    double rectified_from_pixel[9]; /* pixel (col, row, 1) to its ray, of depth 1, in the rectified frame */
    double columns_per_radian, rows_per_radian; /* sphere; focal length in pixels for the planar model */
    double column_origin, row_origin;           /* what steps are equal of, times scale, at array coordinate 0 */
    double disparity_origin;                    /* added to a disparity before it is turned into a parallax */
    double baseline;
    double disparity_sigma; /* standard deviation of a disparity, pixels */
    double max_disparity_step;
    int spherical;   /* 1: sphere, 0: plane */
    double flatness; /* columns of the sphere are equal steps of tan(flatness * angle) / flatness, 0: of angles */
    int is_left;     /* the rays belong to the left image */
} pair_geometry;

/* z-depth and its standard deviation for rows [first_row, first_row + rows) of a depth map; 0 = none. */
typedef void depth_candidates_fn(const float *disparity, ptrdiff_t map_height, ptrdiff_t map_width,
                                 const pair_geometry *geometry, ptrdiff_t first_row, ptrdiff_t rows,
                                 ptrdiff_t columns, float *depth, float *sigma);

/* The largest mutually consistent cluster of `count` candidates per pixel, its weighted mean and size. Candidates
 * of one station count as one; `stations` has the number of each candidate's, ascending. */
typedef int vote_depth_fn(const float *depths, const float *sigmas, const int32_t *stations, ptrdiff_t count,
                          ptrdiff_t pixels, float tolerance, float *depth, float *sigma, uint8_t *support);

enum { MAX_FIT_RADIUS = 16 };

typedef struct {
    int radius;
    float tolerance;   /* standard deviations from the plane within which a neighbour counts */
    float max_shift;   /* most that a depth may differ from its plane's: pixel sizes, or its changes per pixel
                          where these are more, and ... */
    float shift_sigma; /* ... standard deviations; both must be exceeded to drop it */
    float min_cosine;  /* of the angle between ray and normal */
    int supported;     /* all three only where less than this support the depth */
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

/* Each pixel (the lower byte) with the one below it; a row less than the image has. */
typedef struct {
    const uint16_t *values;
    ptrdiff_t height, width;
} paired_image;

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
    paired_image image;
    double matrix[9], translation[3];
} patch_source;

enum { MAX_PATCH_SOURCES = 32 }; /* in one call */

/* Every so many rows of an image, from the first. */
typedef struct {
    ptrdiff_t first, step, count;
} patch_rows;

enum { PATCH_TILE = 32 }; /* columns that are matched in the same sources */

/* Adds the normal equations of matching a reference's pixels in each of the sources that its tile of columns uses:
 * bit k of `used`, of which there is one per tile, stands for source k. `planes` (3 arrays of inverse depth, 0 =
 * none, and its change along x and y) and `equations` belong to that many rows of the reference. */
typedef void add_patch_equations_fn(const grey_image *reference, const patch_source *sources, ptrdiff_t count,
                                    const uint32_t *used, const float *planes, patch_rows rows,
                                    patch_options options, float *equations);

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
    int silence_counts;           /* whether a partner observes a point where it has no depth */
} consistency_gates;

/* Of the partners so far, per pixel: how many observe the point, and see nothing in front of it, agree, and
 * contradict; and the running sums of weights, and of how much, so weighted, their inverse depths, carried to the
 * pixel's ray, exceed its own. */
typedef struct {
    uint8_t *observing, *agreeing, *contradicting;
    float *weighted_shift, *weight;
} consistency_sums;

/* Adds the partner's verdict on every pixel of the reference. */
typedef void compare_depths_fn(const depth_map *reference, const depth_map *partner, const view_transfer *transfer,
                               consistency_gates gates, const consistency_sums *sums);

depth_candidates_fn depth_candidates_scalar, depth_candidates_avx2, depth_candidates_avx512bw,
    depth_candidates_avx512;
vote_depth_fn vote_depth_scalar, vote_depth_avx2, vote_depth_avx512bw, vote_depth_avx512;
compare_depths_fn compare_depths_scalar, compare_depths_avx2, compare_depths_avx512bw, compare_depths_avx512;
fit_planes_fn fit_planes_scalar, fit_planes_avx2, fit_planes_avx512bw, fit_planes_avx512;
add_patch_equations_fn add_patch_equations_scalar, add_patch_equations_avx2, add_patch_equations_avx512bw,
    add_patch_equations_avx512;

/* ---- kernels of one version, so that the result never depends on the processor ----------------------------- */

/* Carry a disparity map from the left image's columns to the right image's, row by row (NaN = none). */
void transfer_disparity(const float *left, ptrdiff_t height, ptrdiff_t left_width, ptrdiff_t right_width,
                        float max_step, float *right);

enum { SURFACE_RADIUS = 2 };

typedef struct {
    int min_consistent;      /* views that must agree, or all that see the point's place, one at least; 0: none */
    int may_miss;            /* so many fewer are enough on a surface that none looks through */
    float max_contradiction; /* most that look through it, per agreeing view */
    float min_surface;       /* least share of the window that must be on the surface where one view agrees */
    float steepest;          /* largest relative change of depth per pixel there */
} confirmation;

/* Turns the verdicts of all partners into the geometric map, in place: `weighted_shift` becomes depth, `weight`
 * its standard deviation, `agreeing` its support; zeros where the depth is not confirmed. `contradicting` is
 * spoilt. */
void confirm_depth(const float *depth, const float *sigma, ptrdiff_t height, ptrdiff_t width,
                   const confirmation *options, const uint8_t *observing, uint8_t *agreeing,
                   uint8_t *contradicting, float *weighted_shift, float *weight);

/* Moves the depths of fitted planes towards those they were fitted to, where neighbouring planes bend by more than
 * the depths' standard deviation tells: by the mean by which the 3 x 3 depths around lie off their planes, no
 * farther than to the pixel's own depth. What has no depth stays. */
int add_relief(const float *depth, const float *sigma, ptrdiff_t height, ptrdiff_t width, float *fitted);

/* The planes (see `add_patch_equations_fn`) of normals (interleaved x, y, z) and depths of some rows of a map;
 * zeros where there is none. */
void planes_of_maps(const float *normals, const float *depth, ptrdiff_t width, const double *inverse_K,
                    patch_rows rows, float *planes);

/* And back, into so many rows of the maps from `first_row` on. */
void maps_of_planes(const float *planes, ptrdiff_t rows, ptrdiff_t width, const double *K, ptrdiff_t first_row,
                    float *normals, float *depth);

/* Moves planes by the solution of their equations: of the inverse depth with standard deviation `sigma`, of its
 * change per pixel with `slope_sigma` times the inverse depth. Planes without equations stay. */
void refine_planes(const float *equations, const float *sigma, ptrdiff_t pixels, float slope_sigma, float *planes);

#endif
