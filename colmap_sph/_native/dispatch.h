/* The versions of kernels, one table per instruction set. */
#ifndef COLMAP_SPH_DISPATCH_H
#define COLMAP_SPH_DISPATCH_H

#include "depth/depth.h"
#include "images/images.h"
#include "matching/matching.h"
#include "ties/ties.h"

typedef struct {
    const char *name;
    census_fn *census;
    cost_fn *cost;
    aggregation_fn *aggregation;
    selection_fn *selection;
    match_fn *match;
    sweep_bytes_fn *sweep_bytes;
    sweep_fn *sweep;
    fit_offsets_fn *fit_offsets;
    mean_offsets_fn *mean_offsets;
    upsample_offsets_fn *upsample_offsets;
    source_pixels_fn *source_pixels;
    resample_fn *resample;
    sharpen_fn *sharpen;
    place_windows_fn *place_windows;
    depth_candidates_fn *depth_candidates;
    vote_depth_fn *vote_depth;
    compare_depths_fn *compare_depths;
    fit_planes_fn *fit_planes;
    add_patch_equations_fn *add_patch_equations;
} kernel_table;

/* The names of all tables, fastest first; NULL ends them. */
extern const char *const kernel_names[];

/* The names of tables that a build for this kind of processor can have and this one has not, as its compiler knows
 * no such instructions or was taken for one of another processor; NULL ends them. */
extern const char *const missing_kernels[];

/* The table of this name, NULL when the processor or the build has no such version. */
const kernel_table *kernels_by_name(const char *name);

#endif
