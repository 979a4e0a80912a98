/* The AVX2 version of aggregation_scalar.c: 32 slots of 8 bits per register, four paths side by side.
 *
 * The path along the row stays in registers. The three paths from the row before keep one row each, in place: row
 * n stores pixel x where its predecessor on the path was, which nothing needs any more. Between the pixels lies a
 * gap of 255s, so that a load one slot beside a pixel's own reads "no such slot". */
#include <immintrin.h>
#include <stdlib.h>
#include <string.h>

#include "rows.h"

enum {
    VERTICAL_PATHS = 3,
    GAP = DEPTH_STEP,
    MINIMUM = GAP / 2,            /* where in the gap a pixel's least slot is kept */
    MAX_VECTORS = MAX_DEPTH / 32, /* registers per pixel */
    AHEAD = 1024                  /* bytes of the volumes fetched ahead: the processor's own prefetching is late */
};

#define ALWAYS_INLINE static inline __attribute__((always_inline))

/* The pixel before the image's edge: it makes L = C. */
static const uint8_t edge[MAX_DEPTH + 2 * GAP];

/* Bytes from pixel to pixel and from path to path in `memory`. */
static inline ptrdiff_t pixel_stride(match_size size) { return size.depth + GAP; }
static inline ptrdiff_t path_stride(match_size size) { return size.width * pixel_stride(size) + GAP; }

int sweep_begin_avx2(sweep_state *state, const int32_t *base, const uint8_t *image, match_size size,
                     path_penalties penalties, int backward) {
    *state =
        (sweep_state){.base = base, .image = image, .size = size, .penalties = penalties, .backward = backward};
    state->memory_size = ((size_t)(VERTICAL_PATHS * path_stride(size)) + 63) / 64 * 64;
    state->memory = aligned_alloc(64, state->memory_size);
    if (!state->memory) {
        return -1;
    }
    memset(state->memory, 255, state->memory_size);
    return 0;
}

ALWAYS_INLINE __m256i load(const uint8_t *p) { return _mm256_loadu_si256((const __m256i *)p); }

ALWAYS_INLINE void store(uint8_t *p, __m256i v) { _mm256_storeu_si256((__m256i *)p, v); }

/* The pixel before on a path: its slots, as the new pixel counts them, and the penalties. */
typedef struct {
    const uint8_t *slots;
    __m256i least, jump; /* min_k L(q, k) and that plus P2 */
    __m256i minimum;     /* running minimum of the new slots */
} step;

/* Slots from -1 to `depth`: slot i of the result is slot i + difference of `slots`, 255 where there is none. */
static const uint8_t *shifted(const uint8_t *slots, int64_t difference, ptrdiff_t depth, uint8_t *scratch) {
    memset(scratch, 255, (size_t)(depth + 2 * GAP));
    const int64_t first = difference > 0 ? -1 : -difference;
    const int64_t end = difference < 0 ? depth + 1 : depth - difference;
    if (end > first) {
        memcpy(scratch + GAP + first, slots + first + difference, (size_t)(end - first));
    }
    return scratch + GAP;
}

/* The step from pixel q to p, whose slots and their minimum are given. */
ALWAYS_INLINE step begin_step(const sweep_state *s, ptrdiff_t p, ptrdiff_t q, const uint8_t *slots,
                              __m256i least) {
    const int p2 = s->penalties.p2[abs(s->image[p] - s->image[q])];
    /* Saturated: without common slots `least` itself has grown to 62 + P2. */
    return (step){slots, least, _mm256_adds_epu8(least, _mm256_set1_epi8((char)p2)), _mm256_set1_epi8((char)255)};
}

ALWAYS_INLINE __m256i advance(step *s, __m256i below, __m256i same, __m256i above, __m256i cost, __m256i p1) {
    const __m256i one_step = _mm256_adds_epu8(_mm256_min_epu8(below, above), p1);
    const __m256i best = _mm256_min_epu8(_mm256_min_epu8(same, one_step), s->jump);
    const __m256i slots = _mm256_add_epi8(cost, _mm256_sub_epi8(best, s->least));
    s->minimum = _mm256_min_epu8(s->minimum, slots);
    return slots;
}

/* The least byte, in every byte. */
ALWAYS_INLINE __m256i horizontal_min(__m256i v) {
    __m128i m = _mm_min_epu8(_mm256_castsi256_si128(v), _mm256_extracti128_si256(v, 1));
    m = _mm_min_epu8(m, _mm_srli_epi16(m, 8));
    return _mm256_broadcastb_epi8(_mm_minpos_epu16(_mm_and_si128(m, _mm_set1_epi16(255))));
}

/* out[0..31] = in[0..31] + a + b + c + d, 8 bits to 16; without `in` for the first sweep. */
ALWAYS_INLINE void add_paths(const uint16_t *in, uint16_t *out, __m256i a, __m256i b, __m256i c, __m256i d) {
    const __m256i ones = _mm256_set1_epi8(1);
    const __m256i low = _mm256_add_epi16(_mm256_maddubs_epi16(_mm256_unpacklo_epi8(a, b), ones),
                                         _mm256_maddubs_epi16(_mm256_unpacklo_epi8(c, d), ones));
    const __m256i high = _mm256_add_epi16(_mm256_maddubs_epi16(_mm256_unpackhi_epi8(a, b), ones),
                                          _mm256_maddubs_epi16(_mm256_unpackhi_epi8(c, d), ones));
    __m256i first = _mm256_permute2x128_si256(low, high, 0x20);
    __m256i second = _mm256_permute2x128_si256(low, high, 0x31);
    if (in) {
        first = _mm256_add_epi16(first, _mm256_loadu_si256((const __m256i *)in));
        second = _mm256_add_epi16(second, _mm256_loadu_si256((const __m256i *)(in + 16)));
    }
    _mm256_storeu_si256((__m256i *)out, first);
    _mm256_storeu_si256((__m256i *)(out + 16), second);
}

ALWAYS_INLINE void prefetch(const void *row, ptrdiff_t offset) {
    _mm_prefetch((const char *)((uintptr_t)row + (uintptr_t)offset), _MM_HINT_T0);
}

/* Path k comes from the row before: from column x - 1, x or x + 1 in the direction of the sweep. */
ALWAYS_INLINE step begin_vertical(const sweep_state *s, ptrdiff_t y, ptrdiff_t x, int k, const uint8_t *place,
                                  ptrdiff_t depth, uint8_t *scratch) {
    const ptrdiff_t direction = s->backward ? -1 : 1, width = s->size.width;
    const ptrdiff_t before_x = x + (k - 1) * direction;
    if (s->done == 0 || before_x < 0 || before_x >= width) {
        const __m256i zero = _mm256_setzero_si256();
        return (step){edge + GAP, zero, zero, _mm256_set1_epi8((char)255)};
    }
    const ptrdiff_t p = y * width + x, q = (y - direction) * width + before_x;
    const int64_t difference = (int64_t)s->base[p] - s->base[q];
    const uint8_t *slots =
        llabs(difference) <= s->penalties.max_slant ? place : shifted(place, difference, depth, scratch);
    return begin_step(s, p, q, slots, _mm256_set1_epi8((char)place[depth + MINIMUM]));
}

/* The path along the row: slots of the pixel before in registers. */
typedef struct {
    __m256i slots[MAX_VECTORS];
    __m256i first_below, last_above; /* what lies beside them */
} along_row;

ALWAYS_INLINE step begin_along(const sweep_state *s, ptrdiff_t p, __m256i least, ptrdiff_t depth,
                               along_row *along) {
    const ptrdiff_t q = p - (s->backward ? -1 : 1);
    const int64_t difference = (int64_t)s->base[p] - s->base[q];
    along->first_below = along->last_above = _mm256_set1_epi8((char)255);
    if (llabs(difference) > s->penalties.max_slant) {
        uint8_t unshifted[MAX_DEPTH], scratch[MAX_DEPTH + 2 * GAP];
        for (ptrdiff_t i = 0; i < depth / 32; i++) {
            store(unshifted + 32 * i, along->slots[i]);
        }
        const uint8_t *slots = shifted(unshifted, difference, depth, scratch);
        for (ptrdiff_t i = 0; i < depth / 32; i++) {
            along->slots[i] = load(slots + 32 * i);
        }
        along->first_below = load(slots - 32);
        along->last_above = load(slots + depth);
    }
    return begin_step(s, p, q, NULL, least);
}

ALWAYS_INLINE void sweep_row_of(sweep_state *s, ptrdiff_t y, const uint8_t *cost, const uint16_t *sums_in,
                                uint16_t *sums_out, const ptrdiff_t depth) {
    const ptrdiff_t direction = s->backward ? -1 : 1, width = s->size.width, vectors = depth / 32;
    const ptrdiff_t turned = width > 0 ? s->done % width : 0;
    const __m256i p1 = _mm256_set1_epi8((char)s->penalties.p1), zero = _mm256_setzero_si256();
    uint8_t scratch[VERTICAL_PATHS][MAX_DEPTH + 2 * GAP];
    along_row along;
    step horizontal = {NULL, zero, zero, _mm256_set1_epi8((char)255)};
    along.first_below = along.last_above = zero;
    for (ptrdiff_t i = 0; i < vectors; i++) {
        along.slots[i] = zero; /* as `edge` */
    }
    for (ptrdiff_t m = 0; m < width; m++) {
        const ptrdiff_t x = s->backward ? width - 1 - m : m;
        const uint8_t *pixel_cost = cost + x * depth;
        uint8_t *places[VERTICAL_PATHS];
        step steps[VERTICAL_PATHS];
        for (int k = 0; k < VERTICAL_PATHS; k++) {
            /* Row n of path k has pixel x at x + (k - 1) n, going round: its predecessor's place in row n - 1. */
            ptrdiff_t place = x + (k - 1) * direction * turned;
            place += place < 0 ? width : place >= width ? -width : 0;
            places[k] = s->memory + k * path_stride(s->size) + GAP + place * (depth + GAP);
            steps[k] = begin_vertical(s, y, x, k, places[k], depth, scratch[k]);
        }
        if (m > 0) {
            horizontal = begin_along(s, y * width + x, horizontal.least, depth, &along);
        }
        __m256i beside = along.first_below, paths[VERTICAL_PATHS] = {zero, zero, zero};
        for (ptrdiff_t i = 0; i < vectors; i++) {
            const __m256i c = load(pixel_cost + 32 * i);
            prefetch(pixel_cost, 32 * i + direction * AHEAD);
            for (int k = 0; k < VERTICAL_PATHS; k++) {
                const uint8_t *slots = steps[k].slots + 32 * i;
                const __m256i below = load(slots - 1), same = load(slots), above = load(slots + 1);
                if (i > 0) {
                    store(places[k] + 32 * (i - 1), paths[k]); /* not before `below` was read from there */
                }
                paths[k] = advance(&steps[k], below, same, above, c, p1);
            }
            const __m256i old = along.slots[i];
            const __m256i next = i + 1 < vectors ? along.slots[i + 1] : along.last_above;
            const __m256i below = _mm256_alignr_epi8(old, _mm256_permute2x128_si256(beside, old, 0x21), 15);
            const __m256i above = _mm256_alignr_epi8(_mm256_permute2x128_si256(old, next, 0x21), old, 1);
            along.slots[i] = advance(&horizontal, below, old, above, c, p1);
            beside = old;
            uint16_t *out = sums_out + x * depth + 32 * i;
            prefetch((sums_in ? sums_in : sums_out) + x * depth, 64 * i + direction * AHEAD);
            add_paths(sums_in ? sums_in + x * depth + 32 * i : NULL, out, paths[0], paths[1], paths[2],
                      along.slots[i]);
        }
        for (int k = 0; k < VERTICAL_PATHS; k++) {
            store(places[k] + depth - 32, paths[k]);
            places[k][depth + MINIMUM] = (uint8_t)_mm256_extract_epi8(horizontal_min(steps[k].minimum), 0);
        }
        horizontal.least = horizontal_min(horizontal.minimum);
    }
    s->done++;
}

void sweep_row_avx2(sweep_state *s, ptrdiff_t y, const uint8_t *cost, const uint16_t *sums_in,
                    uint16_t *sums_out) {
    /* The usual numbers of disparities as constants, for which the compiler keeps slots in registers. */
    switch (s->size.depth) {
    case 32:
        sums_in ? sweep_row_of(s, y, cost, sums_in, sums_out, 32) : sweep_row_of(s, y, cost, NULL, sums_out, 32);
        break;
    case 64:
        sums_in ? sweep_row_of(s, y, cost, sums_in, sums_out, 64) : sweep_row_of(s, y, cost, NULL, sums_out, 64);
        break;
    case 128:
        sums_in ? sweep_row_of(s, y, cost, sums_in, sums_out, 128) : sweep_row_of(s, y, cost, NULL, sums_out, 128);
        break;
    default:
        sweep_row_of(s, y, cost, sums_in, sums_out, s->size.depth);
    }
}
