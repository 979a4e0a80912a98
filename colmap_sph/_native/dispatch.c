#include "dispatch.h"

#include <string.h>

#include "matching/rows.h"
#include "processor.h"

/* The kernels on whole images that are made of row kernels. */
#define WHOLE_IMAGES(version) \
    static const row_kernels rows_##version = {cost_row_##version, sweep_begin_##version, sweep_rows_##version, \
                                               selection_row_##version}; \
    static int cost_##version(const uint64_t *reference, const uint64_t *target, const int32_t *base, \
                              match_size size, uint8_t *cost) { \
        return cost_of_rows(&rows_##version, reference, target, base, size, cost); \
    } \
    static int aggregation_##version(const uint8_t *cost, const int32_t *base, const uint8_t *image, \
                                     match_size size, path_penalties penalties, uint8_t *detours, \
                                     uint8_t *aggregated) { \
        return aggregate_rows(&rows_##version, cost, base, image, size, penalties, detours, aggregated); \
    } \
    static int selection_##version(const uint8_t *aggregated, const int32_t *base, const uint64_t *reference, \
                                   const uint64_t *target, const int32_t *columns, match_size size, \
                                   left_right_check check, int32_t *offset) { \
        return select_rows(&rows_##version, aggregated, base, reference, target, columns, size, check, \
                           offset); \
    } \
    static int sweep_##version(const match_input *input, row_band band, int backward, uint8_t *state) { \
        return sweep_over_rows(&rows_##version, input, band, backward, state); \
    } \
    static int match_##version(const match_input *input, row_band band, uint8_t *forward, uint8_t *backward, \
                                    uint8_t *scratch, int32_t *offset) { \
        return match_rows(&rows_##version, input, band, forward, backward, scratch, offset); \
    }

#define TABLE(version) \
    {#version, \
     census_##version, \
     cost_##version, \
     aggregation_##version, \
     selection_##version, \
     match_##version, \
     sweep_bytes_##version, \
     sweep_##version, \
     fit_offsets_##version, \
     mean_offsets_##version, \
     upsample_offsets_##version, \
     source_pixels_##version, \
     resample_##version, \
     sharpen_##version, \
     place_windows_##version, \
     depth_candidates_##version, \
     vote_depth_##version, \
     compare_depths_##version, \
     fit_planes_##version, \
     add_patch_equations_##version}

WHOLE_IMAGES(scalar)
static const kernel_table scalar_kernels = TABLE(scalar);

#ifdef COLMAP_SPH_HAVE_AVX2
WHOLE_IMAGES(avx2)
static const kernel_table avx2_kernels = TABLE(avx2);
#endif

#ifdef COLMAP_SPH_HAVE_AVX512BW
/* These instructions alone do not match faster than AVX2's. */
#define cost_avx512bw cost_avx2
#define aggregation_avx512bw aggregation_avx2
#define selection_avx512bw selection_avx2
#define match_avx512bw match_avx2
#define sweep_bytes_avx512bw sweep_bytes_avx2
#define sweep_avx512bw sweep_avx2
static const kernel_table avx512bw_kernels = TABLE(avx512bw);
#endif

#ifdef COLMAP_SPH_HAVE_AVX512
WHOLE_IMAGES(avx512)
static const kernel_table avx512_kernels = TABLE(avx512);
#endif

#ifdef COLMAP_SPH_HAVE_NEON
/* Every aarch64 processor has NEON, which compilers use for the scalar versions, too. */
#define fit_offsets_neon fit_offsets_scalar
#define mean_offsets_neon mean_offsets_scalar
#define upsample_offsets_neon upsample_offsets_scalar
#define source_pixels_neon source_pixels_scalar
#define resample_neon resample_scalar
#define sharpen_neon sharpen_scalar
#define place_windows_neon place_windows_scalar
#define depth_candidates_neon depth_candidates_scalar
#define vote_depth_neon vote_depth_scalar
#define compare_depths_neon compare_depths_scalar
#define fit_planes_neon fit_planes_scalar
#define add_patch_equations_neon add_patch_equations_scalar
WHOLE_IMAGES(neon)
static const kernel_table neon_kernels = TABLE(neon);
#endif

const char *const kernel_names[] = {"avx512", "avx512bw", "avx2", "neon", "scalar", NULL};

const char *const missing_kernels[] = {
#if defined(__x86_64__) && !defined(COLMAP_SPH_HAVE_AVX512)
    "avx512",
#endif
#if defined(__x86_64__) && !defined(COLMAP_SPH_HAVE_AVX512BW)
    "avx512bw",
#endif
#if defined(__x86_64__) && !defined(COLMAP_SPH_HAVE_AVX2)
    "avx2",
#endif
#if defined(__aarch64__) && !defined(COLMAP_SPH_HAVE_NEON)
    "neon",
#endif
    NULL};

const kernel_table *kernels_by_name(const char *name) {
    if (strcmp(name, "scalar") == 0) {
        return &scalar_kernels;
    }
#ifdef COLMAP_SPH_HAVE_NEON
    if (strcmp(name, "neon") == 0) {
        return &neon_kernels;
    }
#endif
#ifdef COLMAP_SPH_HAVE_AVX2
    if (strcmp(name, "avx2") == 0 && processor_has_avx2()) {
        return &avx2_kernels;
    }
#endif
#ifdef COLMAP_SPH_HAVE_AVX512BW
    if (strcmp(name, "avx512bw") == 0 && processor_has_avx512bw()) {
        return &avx512bw_kernels;
    }
#endif
#ifdef COLMAP_SPH_HAVE_AVX512
    if (strcmp(name, "avx512") == 0 && processor_has_avx512()) {
        return &avx512_kernels;
    }
#endif
    return NULL;
}
