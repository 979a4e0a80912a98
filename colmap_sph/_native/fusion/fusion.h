/* Kernels of fusion: from depth maps to points. One version each, so that the result never depends on the
 * processor. */
#ifndef COLMAP_SPH_FUSION_H
#define COLMAP_SPH_FUSION_H

#include "common.h"

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
    uint8_t *covered;  /* 1: a partner sees the same piece of surface with a finer pixel */
    uint8_t *agreeing; /* a bit for each partner that sees the same surface: eight of them a plane */
    uint16_t *colour;  /* (..., 3) sums over these */
    ptrdiff_t planes;
} fusion_verdict;

/* What keeps a partner from agreeing with a pixel: it has the point not in view or no depth there, its depth or
 * its normal differs by too much, or nothing does. In the order in which they are asked. */
typedef enum { GATE_UNSEEN, GATE_DEPTH, GATE_NORMAL, GATE_NONE } fusion_gate;

/* The gate that so many pixels of the reference, each by its row and column, come to in a partner; and the
 * distance, in pixels, of their projections from the centre of the partner's pixel, 0 where it is unseen. Of the
 * gates' reprojection error nothing is asked: what is farther away agrees all the same. */
void find_gates(const view_maps *reference, const view_maps *partner, const fusion_transfer *transfer,
                fusion_gates gates, const int32_t *rows, const int32_t *columns, ptrdiff_t count, uint8_t *gate,
                float *distance);

/* Adds the verdict of the partner with this bit, whose `image` has three channels, on some rows of the reference.
 * Pixels that are covered already are passed over. */
void fuse_partner(const view_maps *reference, const view_maps *partner, const uint8_t *image,
                  const fusion_transfer *transfer, fusion_gates gates, int bit, ptrdiff_t first_row,
                  ptrdiff_t end_row, const fusion_verdict *verdict);

/* Unit vectors (three planes) as two of their components (two planes) and a code, and back to the same bits. Of
 * each pixel the largest component is left out; (0, 0, 0) is none. Code 3: it cannot be packed. */
void pack_normals(const float *normals, ptrdiff_t pixels, float *pair, uint8_t *codes);
void unpack_normals(const float *pair, const uint8_t *codes, ptrdiff_t pixels, float *normals);

/* Rows of a view's pixels that are to become points: not covered, and seen from this many stations, its own among
 * them. Partners of one station have bits beside each other. */
typedef struct {
    const view_maps *maps;
    const fusion_verdict *verdict; /* which is only read */
    ptrdiff_t first_row, end_row;
    int min_stations;
    uint64_t elsewhere; /* bits of the partners that are not of the view's own station */
    uint64_t last;      /* the last bit of each station, and all bits without a partner */
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
