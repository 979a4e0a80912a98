/* The Python face of the kernels. Python allocates every array; here sizes and bounds are checked and the GIL is
 * released around the work. */
#include "arrays.h"

#include <string.h>

#include "dispatch.h"
#include "fusion/fusion.h"

#define F32 'f', (Py_ssize_t)sizeof(float)
#define F64 'f', (Py_ssize_t)sizeof(double)
#define U8 'u', (Py_ssize_t)1
#define I16 'i', (Py_ssize_t)2
#define U16 'u', (Py_ssize_t)2
#define U32 'u', (Py_ssize_t)4
#define U64 'u', (Py_ssize_t)8
#define I32 'i', (Py_ssize_t)4

enum { READ = 0, WRITE = 1 };

/* Ends a function: releases the arrays; None, or NULL with MemoryError (status -1) or the error already set. */
static PyObject *finish(array_set *arrays, int status) {
    arrays_release(arrays);
    if (PyErr_Occurred()) {
        return NULL;
    }
    if (status) {
        return PyErr_NoMemory();
    }
    Py_RETURN_NONE;
}

static const kernel_table *table_or_error(const char *name) {
    const kernel_table *table = kernels_by_name(name);
    if (!table) {
        PyErr_Format(PyExc_ValueError, "no kernels named '%s' on this processor", name);
    }
    return table;
}

static int check(int condition, const char *message) {
    if (!condition) {
        PyErr_SetString(PyExc_ValueError, message);
    }
    return condition;
}

static int check_depth(Py_ssize_t depth) {
    return check(depth > 0 && depth <= MAX_DEPTH && depth % DEPTH_STEP == 0,
                 "the number of disparities must be a multiple of 32, at most 1024");
}

static int check_width(Py_ssize_t width) { return check(width <= 65535, "rows are limited to 65535 columns"); }

static PyObject *py_backends(PyObject *self, PyObject *args) {
    (void)self;
    (void)args;
    PyObject *names = PyList_New(0);
    const char *known[] = {"avx512", "avx2", "scalar"};
    for (size_t k = 0; names && k < sizeof known / sizeof *known; k++) {
        PyObject *name = kernels_by_name(known[k]) ? PyUnicode_FromString(known[k]) : NULL;
        if (name && PyList_Append(names, name)) {
            Py_CLEAR(names);
        }
        Py_XDECREF(name);
    }
    return names;
}

static PyObject *py_census(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[3];
    if (!PyArg_ParseTuple(args, "sOOO", &backend, &o[0], &o[1], &o[2])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    array_set arrays = {.count = 0};
    Py_ssize_t shape[2] = {-1, -1};
    const uint8_t *valid = table ? array_get(&arrays, o[1], "valid", U8, 2, READ, shape) : NULL;
    Py_ssize_t padded_shape[2] = {shape[0] + 2 * CENSUS_RADIUS_Y, shape[1] + 2 * CENSUS_RADIUS_X};
    const int16_t *padded = valid ? array_get(&arrays, o[0], "padded", I16, 2, READ, padded_shape) : NULL;
    uint64_t *census = padded ? array_get(&arrays, o[2], "census", U64, 2, WRITE, shape) : NULL;
    if (census && arrays_disjoint(&arrays)) {
        Py_BEGIN_ALLOW_THREADS;
        table->census(padded, valid, shape[0], shape[1], census);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

static PyObject *py_matching_cost(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[4];
    if (!PyArg_ParseTuple(args, "sOOOO", &backend, &o[0], &o[1], &o[2], &o[3])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    array_set arrays = {.count = 0};
    int status = 0;
    Py_ssize_t shape[3] = {-1, -1, -1};
    const uint64_t *reference = table ? array_get(&arrays, o[0], "reference", U64, 2, READ, shape) : NULL;
    Py_ssize_t target_shape[2] = {shape[0], -1};
    const uint64_t *target = reference ? array_get(&arrays, o[1], "target", U64, 2, READ, target_shape) : NULL;
    const int32_t *base = target ? array_get(&arrays, o[2], "base", I32, 2, READ, shape) : NULL;
    uint8_t *cost = base ? array_get(&arrays, o[3], "cost", U8, 3, WRITE, shape) : NULL;
    if (cost && check_depth(shape[2]) && check_width(shape[1]) && check_width(target_shape[1]) &&
        arrays_disjoint(&arrays)) {
        const match_size size = {shape[0], shape[1], target_shape[1], shape[2]};
        Py_BEGIN_ALLOW_THREADS;
        status = table->cost(reference, target, base, size, cost);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, status);
}

static int check_penalties(int p1, const uint8_t *p2) {
    for (int k = 0; k < 256; k++) {
        if (!check(p1 >= 0 && p1 <= MAX_P1 && p1 <= p2[k] && p2[k] <= MAX_P2,
                   "penalties must keep 0 <= P1 <= 63, P1 <= P2 <= 127")) {
            return 0;
        }
    }
    return 1;
}

static int check_left_right(left_right_check limits) {
    return check(limits.max_difference >= 0, "the left-right difference must not be negative") &&
           check(limits.max_excess >= 0, "the excess must not be negative");
}

static PyObject *py_aggregation(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[6];
    int p1, max_slant;
    if (!PyArg_ParseTuple(args, "sOOOiOiOO", &backend, &o[0], &o[1], &o[2], &p1, &o[3], &max_slant, &o[4],
                          &o[5])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    array_set arrays = {.count = 0};
    int status = 0;
    Py_ssize_t shape[3] = {-1, -1, -1}, lut_shape[1] = {256};
    const uint8_t *cost = table ? array_get(&arrays, o[0], "cost", U8, 3, READ, shape) : NULL;
    const int32_t *base = cost ? array_get(&arrays, o[1], "base", I32, 2, READ, shape) : NULL;
    const uint8_t *image = base ? array_get(&arrays, o[2], "image", U8, 2, READ, shape) : NULL;
    const uint8_t *p2 = image ? array_get(&arrays, o[3], "p2", U8, 1, READ, lut_shape) : NULL;
    uint8_t *detours = p2 ? array_get(&arrays, o[4], "detours", U8, 3, WRITE, shape) : NULL;
    uint8_t *aggregated = detours ? array_get(&arrays, o[5], "aggregated", U8, 3, WRITE, shape) : NULL;
    if (aggregated && check_depth(shape[2]) && check_width(shape[1]) && check_penalties(p1, p2) &&
        check(max_slant >= 0, "the slant must not be negative") && arrays_disjoint(&arrays)) {
        const match_size size = {shape[0], shape[1], 0, shape[2]};
        const path_penalties penalties = {(uint8_t)p1, p2, max_slant};
        Py_BEGIN_ALLOW_THREADS;
        status = table->aggregation(cost, base, image, size, penalties, detours, aggregated);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, status);
}

static PyObject *py_selection(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[5];
    left_right_check limits;
    if (!PyArg_ParseTuple(args, "sOOOOiiO", &backend, &o[0], &o[1], &o[2], &o[3], &limits.max_difference,
                          &limits.max_excess, &o[4])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    array_set arrays = {.count = 0};
    int status = 0;
    Py_ssize_t shape[3] = {-1, -1, -1};
    const uint8_t *aggregated = table ? array_get(&arrays, o[0], "aggregated", U8, 3, READ, shape) : NULL;
    const int32_t *base = aggregated ? array_get(&arrays, o[1], "base", I32, 2, READ, shape) : NULL;
    const uint64_t *reference = base ? array_get(&arrays, o[2], "reference", U64, 2, READ, shape) : NULL;
    Py_ssize_t target_shape[2] = {shape[0], -1};
    const uint64_t *target = reference ? array_get(&arrays, o[3], "target", U64, 2, READ, target_shape) : NULL;
    int32_t *offset = target ? array_get(&arrays, o[4], "offset", I32, 2, WRITE, shape) : NULL;
    if (offset && check_depth(shape[2]) && check_width(shape[1]) && check_width(target_shape[1]) &&
        check_left_right(limits) && arrays_disjoint(&arrays)) {
        const match_size size = {shape[0], shape[1], target_shape[1], shape[2]};
        Py_BEGIN_ALLOW_THREADS;
        status = table->selection(aggregated, base, reference, target, size, limits, offset);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, status);
}

static PyObject *py_match(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[7];
    int p1, max_slant;
    left_right_check limits;
    if (!PyArg_ParseTuple(args, "sOOOOiOiiiOO", &backend, &o[0], &o[1], &o[2], &o[3], &p1, &o[4], &max_slant,
                          &limits.max_difference, &limits.max_excess, &o[5], &o[6])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    array_set arrays = {.count = 0};
    int status = 0;
    Py_ssize_t shape[2] = {-1, -1}, lut_shape[1] = {256}, scratch_shape[3] = {2, -1, -1};
    const uint64_t *reference = table ? array_get(&arrays, o[0], "reference", U64, 2, READ, shape) : NULL;
    Py_ssize_t target_shape[2] = {shape[0], -1};
    const uint64_t *target = reference ? array_get(&arrays, o[1], "target", U64, 2, READ, target_shape) : NULL;
    const int32_t *base = target ? array_get(&arrays, o[2], "base", I32, 2, READ, shape) : NULL;
    const uint8_t *image = base ? array_get(&arrays, o[3], "image", U8, 2, READ, shape) : NULL;
    const uint8_t *p2 = image ? array_get(&arrays, o[4], "p2", U8, 1, READ, lut_shape) : NULL;
    uint8_t *scratch = p2 ? array_get(&arrays, o[5], "scratch", U8, 3, WRITE, scratch_shape) : NULL;
    int32_t *offset = scratch ? array_get(&arrays, o[6], "offset", I32, 2, WRITE, shape) : NULL;
    if (offset && check_depth(scratch_shape[2]) && check_width(shape[1]) && check_width(target_shape[1]) &&
        check(scratch_shape[1] > 0 && (shape[1] == 0 || scratch_shape[1] % shape[1] == 0),
              "scratch must have the size (2, pixels of one row or more, disparities)") &&
        check_penalties(p1, p2) && check(max_slant >= 0, "the slant must not be negative") &&
        check_left_right(limits) && arrays_disjoint(&arrays)) {
        const match_input input = {reference,
                                   target,
                                   base,
                                   image,
                                   {shape[0], shape[1], target_shape[1], scratch_shape[2]},
                                   {(uint8_t)p1, p2, max_slant},
                                   limits};
        const Py_ssize_t band_rows = shape[1] > 0 ? scratch_shape[1] / shape[1] : shape[0] + 1;
        Py_BEGIN_ALLOW_THREADS;
        status = table->match(&input, band_rows, scratch, offset);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, status);
}

static PyObject *py_refine_offsets(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[4];
    if (!PyArg_ParseTuple(args, "sOOOO", &backend, &o[0], &o[1], &o[2], &o[3])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    int status = 0;
    array_set arrays = {.count = 0};
    Py_ssize_t shape[2] = {-1, -1};
    const int32_t *offset = table ? array_get(&arrays, o[0], "offset", I32, 2, READ, shape) : NULL;
    const uint64_t *reference = offset ? array_get(&arrays, o[1], "reference", U64, 2, READ, shape) : NULL;
    Py_ssize_t target_shape[2] = {shape[0], -1};
    const uint64_t *target = reference ? array_get(&arrays, o[2], "target", U64, 2, READ, target_shape) : NULL;
    int32_t *refined = target ? array_get(&arrays, o[3], "refined", I32, 2, WRITE, shape) : NULL;
    if (refined && check_width(shape[1]) && check_width(target_shape[1]) && arrays_disjoint(&arrays)) {
        const match_size size = {shape[0], shape[1], target_shape[1], 0};
        Py_BEGIN_ALLOW_THREADS;
        status = table->refine_offsets(offset, reference, target, size, refined);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, status);
}

static PyObject *py_transfer_disparity(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *o[2];
    float max_step;
    if (!PyArg_ParseTuple(args, "OfO", &o[0], &max_step, &o[1])) {
        return NULL;
    }
    array_set arrays = {.count = 0};
    Py_ssize_t shape[2] = {-1, -1};
    const float *left = array_get(&arrays, o[0], "left", F32, 2, READ, shape);
    Py_ssize_t right_shape[2] = {shape[0], -1};
    float *right = left ? array_get(&arrays, o[1], "right", F32, 2, WRITE, right_shape) : NULL;
    if (right && arrays_disjoint(&arrays)) {
        Py_BEGIN_ALLOW_THREADS;
        transfer_disparity(left, shape[0], shape[1], right_shape[1], max_step, right);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

static PyObject *py_depth_candidates(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[4];
    pair_geometry g;
    Py_ssize_t first_row;
    if (!PyArg_ParseTuple(args, "sOO(dd)(dd)ddddppnOO", &backend, &o[0], &o[1], &g.columns_per_radian,
                          &g.rows_per_radian, &g.column_origin, &g.row_origin, &g.disparity_origin, &g.baseline,
                          &g.disparity_sigma, &g.max_disparity_step, &g.spherical, &g.is_left, &first_row, &o[2],
                          &o[3])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    array_set arrays = {.count = 0};
    Py_ssize_t map_shape[2] = {-1, -1}, matrix_shape[2] = {3, 3}, shape[2] = {-1, -1};
    const float *disparity = table ? array_get(&arrays, o[0], "disparity", F32, 2, READ, map_shape) : NULL;
    const double *m =
        disparity ? array_get(&arrays, o[1], "rectified_from_pixel", F64, 2, READ, matrix_shape) : NULL;
    float *depth = m ? array_get(&arrays, o[2], "depth", F32, 2, WRITE, shape) : NULL;
    float *sigma = depth ? array_get(&arrays, o[3], "sigma", F32, 2, WRITE, shape) : NULL;
    if (sigma && arrays_disjoint(&arrays)) {
        for (int k = 0; k < 9; k++) {
            g.rectified_from_pixel[k] = m[k];
        }
        Py_BEGIN_ALLOW_THREADS;
        table->depth_candidates(disparity, map_shape[0], map_shape[1], &g, first_row, shape[0], shape[1], depth,
                                sigma);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

static PyObject *py_vote_depth(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *o[5];
    float tolerance;
    if (!PyArg_ParseTuple(args, "OOfOOO", &o[0], &o[1], &tolerance, &o[2], &o[3], &o[4])) {
        return NULL;
    }
    array_set arrays = {.count = 0};
    Py_ssize_t shape[3] = {-1, -1, -1};
    const float *depths = array_get(&arrays, o[0], "depths", F32, 3, READ, shape);
    const float *sigmas = depths ? array_get(&arrays, o[1], "sigmas", F32, 3, READ, shape) : NULL;
    float *depth = sigmas ? array_get(&arrays, o[2], "depth", F32, 2, WRITE, shape + 1) : NULL;
    float *sigma = depth ? array_get(&arrays, o[3], "sigma", F32, 2, WRITE, shape + 1) : NULL;
    uint8_t *support = sigma ? array_get(&arrays, o[4], "support", U8, 2, WRITE, shape + 1) : NULL;
    if (support && arrays_disjoint(&arrays)) {
        Py_BEGIN_ALLOW_THREADS;
        vote_depth(depths, sigmas, shape[0], shape[1] * shape[2], tolerance, depth, sigma, support);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

/* [A | a], row by row, as A and a. */
static void split_transfer(const double *matrix, double *left, double *last) {
    for (int r = 0; r < 3; r++) {
        memcpy(left + 3 * r, matrix + 4 * r, 3 * sizeof *left);
        last[r] = matrix[4 * r + 3];
    }
}

static int copy_transfer(array_set *arrays, PyObject *forward, PyObject *back, view_transfer *transfer) {
    Py_ssize_t shape[2] = {3, 4};
    const double *f = array_get(arrays, forward, "partner_from_reference", F64, 2, READ, shape);
    const double *b = f ? array_get(arrays, back, "reference_from_partner", F64, 2, READ, shape) : NULL;
    if (!b) {
        return 0;
    }
    split_transfer(f, transfer->pixel_from_reference, transfer->translation);
    split_transfer(b, transfer->reference_from_pixel, transfer->back_translation);
    return 1;
}

/* Depth, normals and their size of a view, from two objects. */
static int get_planes(array_set *arrays, PyObject *const *objects, view_maps *maps) {
    Py_ssize_t shape[2] = {-1, -1};
    maps->depth = array_get(arrays, objects[0], "depth", F32, 2, READ, shape);
    Py_ssize_t normals_shape[3] = {3, shape[0], shape[1]};
    maps->normals = maps->depth ? array_get(arrays, objects[1], "normals", F32, 3, READ, normals_shape) : NULL;
    maps->height = shape[0];
    maps->width = shape[1];
    return maps->normals != NULL;
}

/* The same, and K^-1, from three objects. */
static int get_maps(array_set *arrays, PyObject *const *objects, view_maps *maps) {
    Py_ssize_t shape[2] = {3, 3};
    const double *inverse = get_planes(arrays, objects, maps)
                                ? array_get(arrays, objects[2], "ray_from_pixel", F64, 2, READ, shape)
                                : NULL;
    if (inverse) {
        memcpy(maps->ray_from_pixel, inverse, sizeof maps->ray_from_pixel);
    }
    return inverse != NULL;
}

/* A depth map and its standard deviations; `map->sigma` is NULL, with an error set, where they are not accepted.
 */
static void get_depth_map(array_set *arrays, PyObject *depth, const char *depth_name, PyObject *sigma,
                          const char *sigma_name, depth_map *map) {
    Py_ssize_t shape[2] = {-1, -1};
    map->depth = array_get(arrays, depth, depth_name, F32, 2, READ, shape);
    map->sigma = map->depth && check(shape[0] <= INT32_MAX && shape[1] <= INT32_MAX,
                                     "maps are limited to 2^31 - 1 rows and columns")
                     ? array_get(arrays, sigma, sigma_name, F32, 2, READ, shape)
                     : NULL;
    map->height = shape[0];
    map->width = shape[1];
}

static PyObject *py_check_consistency(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[12];
    consistency_gates gates;
    if (!PyArg_ParseTuple(args, "sOOOOOOOffiOOOOO", &backend, &o[0], &o[1], &o[2], &o[3], &o[4], &o[5], &o[6],
                          &gates.max_reprojection_error, &gates.tolerance, &gates.min_support, &o[7], &o[8], &o[9],
                          &o[10], &o[11])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    array_set arrays = {.count = 0};
    depth_map reference = {.sigma = NULL}, partner = {.sigma = NULL};
    view_transfer transfer;
    consistency_sums sums;
    if (table) {
        get_depth_map(&arrays, o[0], "depth", o[1], "sigma", &reference);
    }
    if (reference.sigma) {
        get_depth_map(&arrays, o[2], "partner_depth", o[3], "partner_sigma", &partner);
    }
    Py_ssize_t partner_shape[2] = {partner.height, partner.width};
    partner.support =
        partner.sigma ? array_get(&arrays, o[4], "partner_support", U8, 2, READ, partner_shape) : NULL;
    const int ready = partner.support && copy_transfer(&arrays, o[5], o[6], &transfer);
    Py_ssize_t shape[2] = {reference.height, reference.width};
    sums.observing = ready ? array_get(&arrays, o[7], "observing", U8, 2, WRITE, shape) : NULL;
    sums.agreeing = sums.observing ? array_get(&arrays, o[8], "agreeing", U8, 2, WRITE, shape) : NULL;
    sums.contradicting = sums.agreeing ? array_get(&arrays, o[9], "contradicting", U8, 2, WRITE, shape) : NULL;
    sums.weighted_depth =
        sums.contradicting ? array_get(&arrays, o[10], "weighted_depth", F32, 2, WRITE, shape) : NULL;
    sums.weight = sums.weighted_depth ? array_get(&arrays, o[11], "weight", F32, 2, WRITE, shape) : NULL;
    if (sums.weight && arrays_disjoint(&arrays)) {
        Py_BEGIN_ALLOW_THREADS;
        table->check_consistency(&reference, &partner, &transfer, gates, &sums);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

static PyObject *py_fuse_partner(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *o[12];
    fusion_transfer transfer;
    fusion_gates gates;
    int bit;
    if (!PyArg_ParseTuple(args, "OOOOOOOOOfffpiOOO", &o[0], &o[1], &o[2], &o[3], &o[4], &o[5], &o[6], &o[7], &o[8],
                          &gates.max_reprojection_error, &gates.max_depth_error, &gates.min_normal_cosine,
                          &transfer.partner_wins, &bit, &o[9], &o[10], &o[11])) {
        return NULL;
    }
    array_set arrays = {.count = 0};
    view_maps reference, partner;
    Py_ssize_t image_shape[3] = {-1, -1, 3}, forward_shape[2] = {3, 4}, matrix_shape[2] = {3, 3};
    const int ready = get_maps(&arrays, o, &reference) && get_maps(&arrays, o + 3, &partner);
    image_shape[0] = ready ? partner.height : -1;
    image_shape[1] = ready ? partner.width : -1;
    Py_ssize_t shape[3] = {ready ? reference.height : -1, ready ? reference.width : -1, 3};
    const uint8_t *image = ready ? array_get(&arrays, o[6], "partner_image", U8, 3, READ, image_shape) : NULL;
    const double *forward =
        image ? array_get(&arrays, o[7], "partner_from_reference", F64, 2, READ, forward_shape) : NULL;
    const double *back =
        forward ? array_get(&arrays, o[8], "normal_from_partner", F64, 2, READ, matrix_shape) : NULL;
    fusion_verdict verdict = {0};
    verdict.covered = back ? array_get(&arrays, o[9], "covered", U8, 2, WRITE, shape) : NULL;
    verdict.agreeing = verdict.covered ? array_get(&arrays, o[10], "agreeing", U64, 2, WRITE, shape) : NULL;
    verdict.colour = verdict.agreeing ? array_get(&arrays, o[11], "colour", U16, 3, WRITE, shape) : NULL;
    if (verdict.colour && check(bit >= 0 && bit < MAX_FUSION_PARTNERS, "the partner's bit must lie in 0..63") &&
        arrays_disjoint(&arrays)) {
        split_transfer(forward, transfer.pixel_from_reference, transfer.translation);
        memcpy(transfer.reference_from_partner, back, sizeof transfer.reference_from_partner);
        Py_BEGIN_ALLOW_THREADS;
        fuse_partner(&reference, &partner, image, &transfer, gates, bit, &verdict);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

/* Maps and verdict of a view from five objects, and rows of them; 0 with an error set. */
static int get_fused_rows(array_set *arrays, PyObject *const *objects, view_maps *maps, fusion_verdict *verdict,
                          fused_rows *rows) {
    const int ready = get_planes(arrays, objects, maps);
    Py_ssize_t shape[3] = {maps->height, maps->width, 3};
    verdict->covered = ready ? array_get(arrays, objects[2], "covered", U8, 2, READ, shape) : NULL;
    verdict->agreeing = verdict->covered ? array_get(arrays, objects[3], "agreeing", U64, 2, READ, shape) : NULL;
    verdict->colour = verdict->agreeing ? array_get(arrays, objects[4], "colour", U16, 3, READ, shape) : NULL;
    rows->maps = maps;
    rows->verdict = verdict;
    return verdict->colour &&
           check(0 <= rows->first_row && rows->first_row <= rows->end_row && rows->end_row <= maps->height,
                 "the rows must lie in the map");
}

static PyObject *py_count_points(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *o[5];
    fused_rows rows;
    if (!PyArg_ParseTuple(args, "OOOOOinn", &o[0], &o[1], &o[2], &o[3], &o[4], &rows.min_views, &rows.first_row,
                          &rows.end_row)) {
        return NULL;
    }
    array_set arrays = {.count = 0};
    view_maps maps;
    fusion_verdict verdict;
    ptrdiff_t points = 0, words = 0;
    if (get_fused_rows(&arrays, o, &maps, &verdict, &rows)) {
        Py_BEGIN_ALLOW_THREADS;
        count_points(&rows, &points, &words);
        Py_END_ALLOW_THREADS;
    }
    arrays_release(&arrays);
    return PyErr_Occurred() ? NULL : Py_BuildValue("nn", (Py_ssize_t)points, (Py_ssize_t)words);
}

static PyObject *py_write_points(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *o[11];
    fused_rows rows;
    if (!PyArg_ParseTuple(args, "OOOOOinnOOOOOO", &o[0], &o[1], &o[2], &o[3], &o[4], &rows.min_views,
                          &rows.first_row, &rows.end_row, &o[5], &o[6], &o[7], &o[8], &o[9], &o[10])) {
        return NULL;
    }
    array_set arrays = {.count = 0};
    view_maps maps;
    fusion_verdict verdict;
    point_frame frame;
    ptrdiff_t num_points = 0, num_words = 0;
    Py_ssize_t matrix_shape[2] = {3, 3}, vector_shape[1] = {3}, indices_shape[1] = {1 + MAX_FUSION_PARTNERS};
    const int ready = get_fused_rows(&arrays, o, &maps, &verdict, &rows);
    const double *pixel = ready ? array_get(&arrays, o[5], "world_from_pixel", F64, 2, READ, matrix_shape) : NULL;
    const double *camera =
        pixel ? array_get(&arrays, o[6], "world_from_camera", F64, 2, READ, matrix_shape) : NULL;
    const double *centre = camera ? array_get(&arrays, o[7], "centre", F64, 1, READ, vector_shape) : NULL;
    frame.indices = centre ? array_get(&arrays, o[8], "indices", U32, 1, READ, indices_shape) : NULL;
    if (frame.indices) {
        /* The arrays must hold what will be written, and nothing may change it meanwhile: counted here again. */
        count_points(&rows, &num_points, &num_words);
    }
    Py_ssize_t points_shape[2] = {num_points, POINT_BYTES}, words_shape[1] = {num_words};
    uint8_t *points = frame.indices ? array_get(&arrays, o[9], "points", U8, 2, WRITE, points_shape) : NULL;
    uint32_t *visibility = points ? array_get(&arrays, o[10], "visibility", U32, 1, WRITE, words_shape) : NULL;
    if (visibility && arrays_disjoint(&arrays)) {
        memcpy(frame.world_from_pixel, pixel, sizeof frame.world_from_pixel);
        memcpy(frame.world_from_camera, camera, sizeof frame.world_from_camera);
        memcpy(frame.centre, centre, sizeof frame.centre);
        Py_BEGIN_ALLOW_THREADS;
        write_points(&rows, &frame, points, visibility);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

static PyObject *py_confirm_depth(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *o[7];
    confirmation options;
    if (!PyArg_ParseTuple(args, "OOifffOOOOO", &o[0], &o[1], &options.min_consistent, &options.max_contradiction,
                          &options.min_surface, &options.steepest, &o[2], &o[3], &o[4], &o[5], &o[6])) {
        return NULL;
    }
    array_set arrays = {.count = 0};
    Py_ssize_t shape[2] = {-1, -1};
    const float *depth = array_get(&arrays, o[0], "depth", F32, 2, READ, shape);
    const float *sigma = depth ? array_get(&arrays, o[1], "sigma", F32, 2, READ, shape) : NULL;
    const uint8_t *observing = sigma ? array_get(&arrays, o[2], "observing", U8, 2, READ, shape) : NULL;
    uint8_t *agreeing = observing ? array_get(&arrays, o[3], "agreeing", U8, 2, WRITE, shape) : NULL;
    uint8_t *contradicting = agreeing ? array_get(&arrays, o[4], "contradicting", U8, 2, WRITE, shape) : NULL;
    float *weighted = contradicting ? array_get(&arrays, o[5], "weighted_depth", F32, 2, WRITE, shape) : NULL;
    float *weight = weighted ? array_get(&arrays, o[6], "weight", F32, 2, WRITE, shape) : NULL;
    if (weight && arrays_disjoint(&arrays)) {
        Py_BEGIN_ALLOW_THREADS;
        confirm_depth(depth, sigma, shape[0], shape[1], &options, observing, agreeing, contradicting, weighted,
                      weight);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

static PyObject *py_fit_planes(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[6];
    plane_fit fit;
    if (!PyArg_ParseTuple(args, "sOOOOiffffiOO", &backend, &o[0], &o[1], &o[2], &o[3], &fit.radius, &fit.tolerance,
                          &fit.max_shift, &fit.shift_sigma, &fit.min_cosine, &fit.supported, &o[4], &o[5])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    int status = 0;
    array_set arrays = {.count = 0};
    Py_ssize_t shape[3] = {-1, -1, 3}, matrix_shape[2] = {3, 3};
    const float *inverse = table ? array_get(&arrays, o[0], "inverse_depth", F32, 2, READ, shape) : NULL;
    const float *sigma = inverse ? array_get(&arrays, o[1], "inverse_sigma", F32, 2, READ, shape) : NULL;
    const uint8_t *support = sigma ? array_get(&arrays, o[2], "support", U8, 2, READ, shape) : NULL;
    const double *K = support ? array_get(&arrays, o[3], "K", F64, 2, READ, matrix_shape) : NULL;
    float *normals = K ? array_get(&arrays, o[4], "normals", F32, 3, WRITE, shape) : NULL;
    float *fitted = normals ? array_get(&arrays, o[5], "fitted_depth", F32, 2, WRITE, shape) : NULL;
    if (fitted && check(fit.radius >= 1 && fit.radius <= MAX_FIT_RADIUS, "the window radius must lie in 1..16") &&
        arrays_disjoint(&arrays)) {
        Py_BEGIN_ALLOW_THREADS;
        status = table->fit_planes(inverse, sigma, support, shape[0], shape[1], K, &fit, normals, fitted);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, status);
}

/* Fills in `sources`, one for each image of a tuple; false with an error set. */
static int get_sources(array_set *arrays, PyObject *images, PyObject *transfers, patch_source *sources) {
    const Py_ssize_t count = PyTuple_Size(images);
    if (!check(count >= 1 && count <= MAX_PATCH_SOURCES, "the number of sources must lie in 1..32")) {
        return 0;
    }
    Py_ssize_t shape[3] = {count, 3, 4};
    const double *matrix = array_get(arrays, transfers, "sources_from_reference", F64, 3, READ, shape);
    for (Py_ssize_t k = 0; matrix && k < count; k++) {
        Py_ssize_t size[2] = {-1, -1};
        grey_image *image = &sources[k].image;
        image->values = array_get(arrays, PyTuple_GetItem(images, k), "source", U8, 2, READ, size);
        if (!image->values || !check_width(size[1]) ||
            !check(size[0] < 16384 || size[0] * size[1] < 1 << 30, "a source is limited to 2^30 pixels")) {
            return 0;
        }
        image->height = size[0];
        image->width = size[1];
        split_transfer(matrix + 12 * k, sources[k].matrix, sources[k].translation);
    }
    return matrix != NULL;
}

/* Whether every `step`-th of so many rows are at least `count`. */
static int rows_fit(Py_ssize_t rows, Py_ssize_t step, Py_ssize_t count) {
    return count == 0 || (rows > 0 && count - 1 <= (rows - 1) / step);
}

static PyObject *py_add_patch_equations(PyObject *self, PyObject *args) {
    (void)self;
    const char *backend;
    PyObject *o[5];
    Py_ssize_t first_row, row_step;
    patch_options options;
    if (!PyArg_ParseTuple(args, "sOO!OOnnffO", &backend, &o[0], &PyTuple_Type, &o[1], &o[2], &o[3], &first_row,
                          &row_step, &options.contrast, &options.min_score, &o[4])) {
        return NULL;
    }
    const kernel_table *table = table_or_error(backend);
    array_set arrays = {.count = 0};
    Py_ssize_t shape[2] = {-1, -1};
    patch_source sources[MAX_PATCH_SOURCES];
    const uint8_t *image = table ? array_get(&arrays, o[0], "image", U8, 2, READ, shape) : NULL;
    const int ready = image && get_sources(&arrays, o[1], o[2], sources);
    Py_ssize_t planes_shape[3] = {3, -1, shape[1]};
    const float *planes = ready ? array_get(&arrays, o[3], "planes", F32, 3, READ, planes_shape) : NULL;
    Py_ssize_t equations_shape[3] = {PATCH_EQUATIONS, planes_shape[1], shape[1]};
    float *equations = planes ? array_get(&arrays, o[4], "equations", F32, 3, WRITE, equations_shape) : NULL;
    if (equations &&
        check(first_row >= 0 && row_step >= 1 && rows_fit(shape[0] - first_row, row_step, planes_shape[1]),
              "the rows must lie in the image") &&
        arrays_disjoint(&arrays)) {
        const grey_image reference = {image, shape[0], shape[1]};
        const Py_ssize_t count = PyTuple_Size(o[1]);
        Py_BEGIN_ALLOW_THREADS;
        const patch_rows rows = {first_row, row_step, planes_shape[1]};
        table->add_patch_equations(&reference, sources, count, planes, rows, options, equations);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

static PyObject *py_refine_planes(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *o[3];
    float slope_sigma;
    if (!PyArg_ParseTuple(args, "OOfO", &o[0], &o[1], &slope_sigma, &o[2])) {
        return NULL;
    }
    array_set arrays = {.count = 0};
    Py_ssize_t shape[3] = {PATCH_EQUATIONS, -1, -1};
    const float *equations = array_get(&arrays, o[0], "equations", F32, 3, READ, shape);
    const float *sigma = equations ? array_get(&arrays, o[1], "sigma", F32, 2, READ, shape + 1) : NULL;
    Py_ssize_t planes_shape[3] = {3, shape[1], shape[2]};
    float *planes = sigma ? array_get(&arrays, o[2], "planes", F32, 3, WRITE, planes_shape) : NULL;
    if (planes && arrays_disjoint(&arrays)) {
        Py_BEGIN_ALLOW_THREADS;
        refine_planes(equations, sigma, shape[1] * shape[2], slope_sigma, planes);
        Py_END_ALLOW_THREADS;
    }
    return finish(&arrays, 0);
}

static PyMethodDef methods[] = {
    {"backends", py_backends, METH_NOARGS, "Names of the kernel versions this processor runs, fastest first."},
    {"census", py_census, METH_VARARGS, "census(backend, padded, valid, census)"},
    {"matching_cost", py_matching_cost, METH_VARARGS, "matching_cost(backend, reference, target, base, cost)"},
    {"aggregation", py_aggregation, METH_VARARGS,
     "aggregation(backend, cost, base, image, p1, p2, max_slant, detours, aggregated)"},
    {"selection", py_selection, METH_VARARGS,
     "selection(backend, aggregated, base, reference, target, max_difference, max_excess, offset)"},
    {"match", py_match, METH_VARARGS,
     "match(backend, reference, target, base, image, p1, p2, max_slant, max_difference, max_excess, "
     "scratch, offset)"},
    {"refine_offsets", py_refine_offsets, METH_VARARGS,
     "refine_offsets(backend, offset, reference, target, refined)"},
    {"transfer_disparity", py_transfer_disparity, METH_VARARGS, "transfer_disparity(left, max_step, right)"},
    {"depth_candidates", py_depth_candidates, METH_VARARGS,
     "depth_candidates(backend, disparity, rectified_from_pixel, (columns_per_radian, rows_per_radian), "
     "(column_origin, row_origin), disparity_origin, baseline, disparity_sigma, max_disparity_step, spherical, "
     "is_left, first_row, depth, sigma)"},
    {"vote_depth", py_vote_depth, METH_VARARGS, "vote_depth(depths, sigmas, tolerance, depth, sigma, support)"},
    {"check_consistency", py_check_consistency, METH_VARARGS,
     "check_consistency(backend, depth, sigma, partner_depth, partner_sigma, partner_support, "
     "partner_from_reference, reference_from_partner, max_reprojection_error, tolerance, min_support, observing, "
     "agreeing, contradicting, weighted_depth, weight)"},
    {"confirm_depth", py_confirm_depth, METH_VARARGS,
     "confirm_depth(depth, sigma, min_consistent, max_contradiction, min_surface, steepest, observing, "
     "agreeing, contradicting, weighted_depth, weight)"},
    {"fuse_partner", py_fuse_partner, METH_VARARGS,
     "fuse_partner(depth, normals, ray_from_pixel, partner_depth, partner_normals, partner_ray_from_pixel, "
     "partner_image, partner_from_reference, normal_from_partner, max_reprojection_error, max_depth_error, "
     "min_normal_cosine, partner_wins, bit, covered, agreeing, colour)"},
    {"count_points", py_count_points, METH_VARARGS,
     "count_points(depth, normals, covered, agreeing, colour, min_views, first_row, end_row) -> (points, words)"},
    {"write_points", py_write_points, METH_VARARGS,
     "write_points(depth, normals, covered, agreeing, colour, min_views, first_row, end_row, world_from_pixel, "
     "world_from_camera, centre, indices, points, visibility)"},
    {"fit_planes", py_fit_planes, METH_VARARGS,
     "fit_planes(backend, inverse_depth, inverse_sigma, support, K, radius, tolerance, max_shift, shift_sigma, "
     "min_cosine, supported, normals, fitted_depth)"},
    {"add_patch_equations", py_add_patch_equations, METH_VARARGS,
     "add_patch_equations(backend, image, sources, sources_from_reference, planes, first_row, row_step, "
     "contrast, min_score, equations)"},
    {"refine_planes", py_refine_planes, METH_VARARGS, "refine_planes(equations, sigma, slope_sigma, planes)"},
    {NULL, NULL, 0, NULL}};

static PyModuleDef_Slot slots[] = {{0, NULL}};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, .m_name = "_native",
                                        .m_doc = "Kernels of colmap_sph.", .m_methods = methods, .m_slots = slots};

PyMODINIT_FUNC PyInit__native(void) { return PyModuleDef_Init(&definition); }
