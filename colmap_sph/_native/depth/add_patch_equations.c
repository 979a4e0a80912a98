/* Least-squares matching of small planes.
 *
 * The plane of a reference pixel carries the window around it into a source image. Both windows are brought to
 * mean 0 and variance 1; what is left of their difference is linear in small changes of the plane's inverse depth
 * w + wx dx + wy dy, and gives normal equations for these three. Neighbouring pixels are worked on side by side,
 * each in a lane of its own, so that vector widths cannot change a result; block by block in all sources, so that
 * what depends on the reference alone is found once.
 *
 * The maps' pixels are corners between four pixels of the image: windows have an even side, and every tap is a
 * pixel of the reference. */
#include <math.h>
#include <string.h>

#ifdef __AVX2__
#include <immintrin.h>
#endif

#include "depth/depth.h"
#include "lanes.h"
#include "version.h"

enum { SIDE = 6 };

/* Where a window may lie around its centre in the source; also what makes positions positive, so that cutting off
 * their fraction rounds down. */
#define REACH 32
/* Variance, in grey values, of noise and rounding: windows of less contrast hardly match. */
#define NOISE_VARIANCE 4.0f

/* Taps weigh by a Gaussian of three pixels, exp(-(dx^2 + dy^2) / 18), here for distances of 1/2, 3/2 and 5/2: C
 * libraries differ in expf. */
static const float QUARTER_OF_WEIGHTS[SIDE / 2][SIDE / 2] = {
    {0x1.f1f936p-1f, 0x1.bd9b34p-1f, 0x1.64d048p-1f},
    {0x1.bd9b34p-1f, 0x1.8ebefap-1f, 0x1.3f4a74p-1f},
    {0x1.64d048p-1f, 0x1.3f4a74p-1f, 0x1.ff5612p-2f},
};

/* How many rings of taps lie between a row or column of a window and its middle. */
static int ring(int place) { return place < SIDE / 2 ? SIDE / 2 - 1 - place : place - SIDE / 2; }

/* The pixels of a block, as all sources need them: where they are, and their planes; values r and weights w of
 * the taps of their windows, and weighted sums over these. */
typedef struct {
    double row, column[LANES], plane[3][LANES], there[LANES]; /* there: 1, or 0 without a plane */
    float_lanes r[SIDE][SIDE], w[SIDE][SIDE];
    float_lanes sum_w, sum_r, sum_rr;
} block_windows;

/* Where the pixels of a block lie in the source, each by its affine map there. */
typedef struct {
    float u[LANES], v[LANES];                         /* relative to `base`, which is REACH before it */
    float ux[LANES], uy[LANES], vx[LANES], vy[LANES]; /* by a pixel of the reference */
    float uw[LANES], vw[LANES];                       /* by inverse depth */
    float inside[LANES];                              /* 1 or 0 */
    int32_t base[LANES];
} block_place;

/* Weighted sums over the taps of a block: of source s, and with reference r, and the source's derivative g by
 * inverse depth, times 1, dx, dy (and dx dx, dx dy, dy dy). */
typedef struct {
    float_lanes s, ss, rs;
    float_lanes g[3], gr[3], gs[3], gg[6];
} block_sums;

/* The same of fewer values, and back. Most often it is a whole block, of which compilers know how long it is. */
static inline float_lanes load_some(const float *values, ptrdiff_t count) {
    float_lanes loaded = {0};
    if (count == LANES) {
        return load_floats(values);
    }
    memcpy(&loaded, values, (size_t)count * sizeof *values);
    return loaded;
}

static inline void store_some(float *values, float_lanes stored, ptrdiff_t count) {
    if (count == LANES) {
        memcpy(values, &stored, sizeof stored);
    } else {
        memcpy(values, &stored, (size_t)count * sizeof *values);
    }
}

/* False where no pixel has a plane. */
static inline int read_planes(const float *planes, ptrdiff_t stride, ptrdiff_t column, ptrdiff_t row,
                              ptrdiff_t count, block_windows *k) {
    int any = 0;
    for (int i = 0; i < 3; i++) {
        const float_lanes plane = load_some(planes + i * stride, count);
        for (int l = 0; l < LANES; l++) {
            k->plane[i][l] = plane[l];
        }
    }
    k->row = (double)row;
    for (int l = 0; l < LANES; l++) {
        k->column[l] = (double)(column + l);
        k->there[l] = k->plane[0][l] > 0 ? 1 : 0;
        any |= k->plane[0][l] > 0;
    }
    return any;
}

/* The taps of a block whose first pixel is at `corner` of the reference. */
static inline void read_taps(const uint8_t *corner, ptrdiff_t width, ptrdiff_t count, float near[SIDE][SIDE],
                             float scale, block_windows *k) {
    float_lanes centre;
    enum { TAPS = (SIDE - 1 + LANES + LANES - 1) / LANES * LANES };
    uint8_t taps[TAPS] = {0};
    float row[TAPS];
    for (ptrdiff_t l = 0; l < LANES; l++) {
        const uint8_t *c = corner + (l < count ? l : 0);
        centre[l] = 0.25f * (float)(c[0] + c[-1] + c[-width] + c[-width - 1]);
    }
    memset(&k->sum_w, 0, sizeof k->sum_w);
    memset(&k->sum_r, 0, sizeof k->sum_r);
    memset(&k->sum_rr, 0, sizeof k->sum_rr);
    for (int j = 0; j < SIDE; j++) {
        const uint8_t *first = corner + (j - SIDE / 2) * width - SIDE / 2;
        if (count == LANES) {
            memcpy(taps, first, SIDE - 1 + LANES);
        } else {
            memcpy(taps, first, (size_t)(SIDE - 1 + count));
        }
        for (int l = 0; l < TAPS; l++) {
            row[l] = (float)taps[l];
        }
        for (int i = 0; i < SIDE; i++) {
            const float_lanes r = load_floats(row + i), edge = (r - centre) * scale;
            const float_lanes w = near[j][i] / (1 + edge * edge), wr = w * r;
            k->r[j][i] = r;
            k->w[j][i] = w;
            k->sum_w += w;
            k->sum_r += wr;
            k->sum_rr += wr * r;
        }
    }
}

/* Straight loops over doubles, without branches, so that the compiler vectorises them; false where no window lies
 * in the source. */
static inline int locate(const block_windows *windows, const patch_source *source, block_place *k) {
    const double *m = source->matrix, *t = source->translation, y = windows->row, half = 0.5 * (SIDE - 1);
    const double last_u = (double)(source->image.width - 1), last_v = (double)(source->image.height - 1);
    const int32_t width = (int32_t)source->image.width;
    double u[LANES], v[LANES];
    for (int l = 0; l < LANES; l++) {
        const double x = windows->column[l], w = windows->plane[0][l], wx = windows->plane[1][l],
                     wy = windows->plane[2][l];
        const double z = m[6] * x + m[7] * y + m[8] + w * t[2], scale = 1 / (z > 1e-9 ? z : 1e-9);
        const double pu = (m[0] * x + m[1] * y + m[2] + w * t[0]) * scale;
        const double pv = (m[3] * x + m[4] * y + m[5] + w * t[1]) * scale;
        const double ux = (m[0] + wx * t[0] - pu * (m[6] + wx * t[2])) * scale;
        const double uy = (m[1] + wy * t[0] - pu * (m[7] + wy * t[2])) * scale;
        const double vx = (m[3] + wx * t[1] - pv * (m[6] + wx * t[2])) * scale;
        const double vy = (m[4] + wy * t[1] - pv * (m[7] + wy * t[2])) * scale;
        /* From COLMAP's coordinates to those of the array, where pixel 0 is at 0. */
        const double cu = pu - 0.5, cv = pv - 0.5;
        const double du = half * (fabs(ux) + fabs(uy)) + 0.01, dv = half * (fabs(vx) + fabs(vy)) + 0.01;
        /* False for NaN. */
        const int in = (windows->there[l] > 0) & (z > 1e-9) & (du < REACH - 1) & (dv < REACH - 1) & (cu >= du) &
                       (cv >= dv) & (cu + du < last_u) & (cv + dv < last_v);
        u[l] = in ? cu : 0;
        v[l] = in ? cv : 0;
        k->inside[l] = in ? 1.0f : 0.0f;
        k->ux[l] = in ? (float)ux : 0;
        k->uy[l] = in ? (float)uy : 0;
        k->vx[l] = in ? (float)vx : 0;
        k->vy[l] = in ? (float)vy : 0;
        k->uw[l] = in ? (float)((t[0] - (cu + 0.5) * t[2]) * scale) : 0;
        k->vw[l] = in ? (float)((t[1] - (cv + 0.5) * t[2]) * scale) : 0;
    }
    for (int l = 0; l < LANES; l++) {
        const int32_t column = (int32_t)u[l], row = (int32_t)v[l];
        k->u[l] = (float)(u[l] - column) + REACH;
        k->v[l] = (float)(v[l] - row) + REACH;
        k->base[l] = (row - REACH) * width + column - REACH;
    }
    float any = 0;
    for (int l = 0; l < LANES; l++) {
        any += k->inside[l];
    }
    return any > 0;
}

/* The two pairs of pixels at each of the offsets: bytes of a pixel, the one below, those right of these two. */
static inline int_lanes load_pairs(const uint16_t *values, int_lanes offset) {
#ifdef __AVX512F__
    return (int_lanes)_mm512_i32gather_epi32((__m512i)offset, values, 2);
#elif defined(__AVX2__)
    return (int_lanes)_mm256_i32gather_epi32((const int *)(const void *)values, (__m256i)offset, 2);
#else
    /* In bytes, below 2^31 as sources have fewer than 2^30 pixels; compilers add such offsets to an address at no
     * cost. */
    const uint8_t *bytes = (const uint8_t *)values;
    const unsigned_lanes at = (unsigned_lanes)(offset + offset);
    int_lanes words;
    for (int l = 0; l < LANES; l++) {
        int32_t word;
        memcpy(&word, bytes + at[l], sizeof word);
        words[l] = word;
    }
    return words;
#endif
}

/* A source, and where the taps of a block lie in it: those of a row through the middles of the windows, and how
 * far a row below is from there. */
typedef struct {
    const uint16_t *values;
    int32_t width;
    float_lanes u[SIDE], v[SIDE];
    float_lanes uy, vy, uw, vw;
    int_lanes base;
} block_taps;

static inline void place_taps(const paired_image *source, const block_place *place, block_taps *taps) {
    const float_lanes u = load_floats(place->u), v = load_floats(place->v), ux = load_floats(place->ux),
                      vx = load_floats(place->vx);
    for (int i = 0; i < SIDE; i++) {
        const float dx = (float)i - 0.5f * (SIDE - 1);
        taps->u[i] = u + ux * dx;
        taps->v[i] = v + vx * dx;
    }
    taps->values = source->values;
    taps->width = (int32_t)source->width;
    taps->uy = load_floats(place->uy);
    taps->vy = load_floats(place->vy);
    taps->uw = load_floats(place->uw);
    taps->vw = load_floats(place->vw);
    memcpy(&taps->base, place->base, sizeof taps->base);
}

/* Value of the source at (u, v) and its derivative by inverse depth, bilinear between four pixels. */
static inline float_lanes sample(const block_taps *k, float_lanes u, float_lanes v, float_lanes *slope) {
    const int_lanes x = __builtin_convertvector(u, int_lanes), y = __builtin_convertvector(v, int_lanes);
    const float_lanes fu = u - __builtin_convertvector(x, float_lanes),
                      fv = v - __builtin_convertvector(y, float_lanes);
    const int_lanes offset = k->base + y * k->width + x;
    const int_lanes four = load_pairs(k->values, offset), a = four & 255, c = four >> 8 & 255;
    /* Differences of integers are exact as well, and leave the units of floating-point numbers free. */
    const float_lanes across = __builtin_convertvector((four >> 16 & 255) - a, float_lanes),
                      across_below =
                          __builtin_convertvector((int_lanes)((unsigned_lanes)four >> 24) - c, float_lanes);
    const float_lanes above = __builtin_convertvector(a, float_lanes) + fu * across,
                      below = __builtin_convertvector(c, float_lanes) + fu * across_below;
    *slope = (across + fv * (across_below - across)) * k->uw + (below - above) * k->vw;
    return above + fv * (below - above);
}

/* A row of taps: what depends on dy alone is multiplied once, at its end. */
static inline void accumulate_row(const block_taps *taps, const float_lanes *reference, const float_lanes *weights,
                                  float dy, block_sums *sums) {
    float_lanes g[2] = {{0}}, gr[2] = {{0}}, gs[2] = {{0}}, gg[3] = {{0}};
    const float_lanes down_u = taps->uy * dy, down_v = taps->vy * dy;
#ifndef __aarch64__ /* there, gcc works on all taps side by side, for which registers are too few */
#pragma GCC unroll 6
#endif
    for (int i = 0; i < SIDE; i++) {
        const float dx = (float)i - 0.5f * (SIDE - 1);
        float_lanes slope;
        const float_lanes s = sample(taps, taps->u[i] + down_u, taps->v[i] + down_v, &slope);
        const float_lanes r = reference[i], w = weights[i], ws = w * s, wg = w * slope;
        const float_lanes wgr = wg * r, wgs = wg * s, wgg = wg * slope;
        sums->s += ws;
        sums->ss += ws * s;
        sums->rs += ws * r;
        g[0] += wg;
        g[1] += wg * dx;
        gr[0] += wgr;
        gr[1] += wgr * dx;
        gs[0] += wgs;
        gs[1] += wgs * dx;
        gg[0] += wgg;
        gg[1] += wgg * dx;
        gg[2] += wgg * (dx * dx);
    }
    for (int k = 0; k < 2; k++) {
        sums->g[k] += g[k];
        sums->gr[k] += gr[k];
        sums->gs[k] += gs[k];
    }
    sums->g[2] += g[0] * dy;
    sums->gr[2] += gr[0] * dy;
    sums->gs[2] += gs[0] * dy;
    sums->gg[0] += gg[0];
    sums->gg[1] += gg[1];
    sums->gg[2] += gg[0] * dy;
    sums->gg[3] += gg[2];
    sums->gg[4] += gg[1] * dy;
    sums->gg[5] += gg[0] * (dy * dy);
}

/* All taps of a block in a source. */
static inline void match_block(const block_windows *windows, const paired_image *source, const block_place *place,
                               block_sums *sums) {
    block_taps taps;
    place_taps(source, place, &taps);
    memset(sums, 0, sizeof *sums);
    for (int j = 0; j < SIDE; j++) {
        accumulate_row(&taps, windows->r[j], windows->w[j], (float)j - 0.5f * (SIDE - 1), sums);
    }
}

/* Equations of the normalised windows, weighed by how well they match. */
static inline void add_block(const block_windows *windows, const block_sums *sums, const block_place *place,
                             float min_score, float_lanes *equations) {
    float_lanes mean[3], with_r[3], with_s[3], ir, is;
    const float_lanes n = 1 / windows->sum_w, mr = windows->sum_r * n, ms = sums->s * n;
    const float_lanes vr = windows->sum_rr * n - mr * mr + NOISE_VARIANCE,
                      vs = sums->ss * n - ms * ms + NOISE_VARIANCE;
    for (int l = 0; l < LANES; l++) {
        ir[l] = 1 / sqrtf(vr[l]);
        is[l] = 1 / sqrtf(vs[l]);
    }
    const float_lanes uw = load_floats(place->uw), vw = load_floats(place->vw);
    const float_lanes score = (sums->rs * n - mr * ms) * ir * is;
    const float_lanes counts = __builtin_convertvector(-(score > min_score), float_lanes);
    const float_lanes weight = load_floats(place->inside) * counts * windows->sum_w;
    for (int i = 0; i < 3; i++) {
        mean[i] = sums->g[i] * n;
        with_r[i] = (sums->gr[i] * n - mr * mean[i]) * ir;
        with_s[i] = (sums->gs[i] * n - ms * mean[i]) * is;
    }
    equations[0] += weight;
    equations[1] += weight * 2 * (1 - score);
    equations[2] += weight * (uw * uw + vw * vw);
    for (int i = 0, k = 0; i < 3; i++) {
        equations[3 + i] += weight * is * (with_r[i] - score * with_s[i]);
        for (int j = i; j < 3; j++, k++) {
            equations[6 + k] += weight * is * is * (sums->gg[k] * n - mean[i] * mean[j] - with_s[i] * with_s[j]);
        }
    }
}

/* Adds what the sources used say to a block's columns of the equations; in the order of the sources, so that it
 * does not matter how many come in one call. */
static inline void match_sources(const block_windows *windows, const patch_source *sources, ptrdiff_t source_count,
                                 uint32_t used, float min_score, ptrdiff_t count, ptrdiff_t stride,
                                 float *equations) {
    float_lanes e[PATCH_EQUATIONS];
    for (int k = 0; k < PATCH_EQUATIONS; k++) {
        e[k] = load_some(equations + k * stride, count);
    }
    for (ptrdiff_t i = 0; i < source_count; i++) {
        block_place place;
        if (used >> i & 1 && locate(windows, &sources[i], &place)) {
            block_sums sums;
            match_block(windows, &sources[i].image, &place, &sums);
            add_block(windows, &sums, &place, min_score, e);
        }
    }
    for (int k = 0; k < PATCH_EQUATIONS; k++) {
        store_some(equations + k * stride, e[k], count);
    }
}

void VERSION_OF(add_patch_equations)(const grey_image *reference, const patch_source *sources,
                                     ptrdiff_t source_count, const uint32_t *used, const float *planes,
                                     patch_rows rows, patch_options options, float *equations) {
    const ptrdiff_t width = reference->width, stride = rows.count * width;
    float near[SIDE][SIDE];
    for (int j = 0; j < SIDE; j++) {
        for (int i = 0; i < SIDE; i++) {
            near[j][i] = QUARTER_OF_WEIGHTS[ring(j)][ring(i)];
        }
    }
    for (ptrdiff_t row = 0; row < rows.count; row++) {
        const ptrdiff_t y = rows.first + row * rows.step;
        if (y < SIDE / 2 || y + SIDE / 2 > reference->height) {
            continue;
        }
        /* Windows reach SIDE / 2 pixels before and SIDE / 2 - 1 pixels behind their corner. Tiles begin at the
         * first corner, too, and their side is a multiple of LANES, so that a block lies in one of them. */
        for (ptrdiff_t x = SIDE / 2; x + SIDE / 2 <= width; x += LANES) {
            const ptrdiff_t left = width - SIDE / 2 + 1 - x, count = left < LANES ? left : LANES;
            block_windows windows;
            if (!read_planes(planes + row * width + x, stride, x, y, count, &windows)) {
                continue;
            }
            read_taps(reference->values + y * width + x, width, count, near, 1 / options.contrast, &windows);
            match_sources(&windows, sources, source_count, used[(x - SIDE / 2) / PATCH_TILE], options.min_score,
                          count, stride, equations + row * width + x);
        }
    }
}
