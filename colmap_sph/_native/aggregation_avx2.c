/* The AVX2 version of aggregation_scalar.c: 32 slots of 8 bits per register, four paths side by side.
 *
 * Path costs lie in rows with a gap of 255s between pixels, wide enough that a load at any shift between two
 * pixels' bases reads "no such slot" and never another pixel. */
#include <immintrin.h>
#include <stdlib.h>
#include <string.h>

#include "kernels.h"

enum { PATHS = 4 };

typedef struct {
    uint8_t *slots;  /* first slot of pixel 0 */
    uint8_t *minima; /* least slot of each pixel */
} path_row;

typedef struct {
    path_row rows[2][PATHS]; /* [parity of the row][path] */
    uint8_t *edge;           /* the pixel before the image's edge: all zero, which makes L = C */
    ptrdiff_t stride;        /* from pixel to pixel in `slots` */
    uint8_t *memory;
} path_buffers;

static int allocate(path_buffers *buffers, ptrdiff_t width, ptrdiff_t depth) {
    const ptrdiff_t gap = depth + DEPTH_STEP; /* >= depth + 2, the furthest load from a pixel's slots */
    const ptrdiff_t row_size = (width * (depth + gap) + gap + 63) / 64 * 64;
    const ptrdiff_t edge_size = depth + 2 * gap;
    const ptrdiff_t minima_size = (width + 63) / 64 * 64;
    const size_t size = (size_t)(2 * PATHS * (row_size + minima_size) + edge_size);
    buffers->memory = malloc(size);
    if (!buffers->memory) {
        return -1;
    }
    memset(buffers->memory, 255, size);
    uint8_t *next = buffers->memory;
    for (int k = 0; k < 2 * PATHS; k++, next += row_size + minima_size) {
        buffers->rows[k / PATHS][k % PATHS] = (path_row){next + gap, next + row_size};
    }
    memset(next, 0, (size_t)edge_size);
    buffers->edge = next + gap;
    buffers->stride = depth + gap;
    return 0;
}

/* What one path brings to a pixel: where the slots before it are, already shifted, and its penalties. */
typedef struct {
    const uint8_t *before;
    __m256i least, jump; /* min_k L(q, k) and that plus P2 */
    __m256i minimum;     /* running minimum of the new slots */
    uint8_t *path;
} step;

static inline void begin_step(step *s, const uint8_t *slots, uint8_t least, ptrdiff_t difference, ptrdiff_t depth,
                              uint8_t p2, uint8_t *path) {
    const ptrdiff_t limit = depth + 1;
    s->before = slots + (difference > limit ? limit : difference < -limit ? -limit : difference);
    s->least = _mm256_set1_epi8((char)least);
    /* Saturated: without common slots `least` itself has grown to 62 + P2. */
    s->jump = _mm256_set1_epi8((char)(least + p2 > 255 ? 255 : least + p2));
    s->minimum = _mm256_set1_epi8((char)255);
    s->path = path;
}

static inline __m256i advance(step *s, ptrdiff_t i, __m256i cost, __m256i p1) {
    const __m256i same = _mm256_loadu_si256((const __m256i *)(s->before + i));
    const __m256i below = _mm256_loadu_si256((const __m256i *)(s->before + i - 1));
    const __m256i above = _mm256_loadu_si256((const __m256i *)(s->before + i + 1));
    const __m256i one_step = _mm256_adds_epu8(_mm256_min_epu8(below, above), p1);
    const __m256i best = _mm256_min_epu8(_mm256_min_epu8(same, one_step), s->jump);
    const __m256i slots = _mm256_add_epi8(cost, _mm256_sub_epi8(best, s->least));
    s->minimum = _mm256_min_epu8(s->minimum, slots);
    _mm256_storeu_si256((__m256i *)(s->path + i), slots);
    return slots;
}

static inline uint8_t horizontal_min(__m256i v) {
    __m128i m = _mm_min_epu8(_mm256_castsi256_si128(v), _mm256_extracti128_si256(v, 1));
    m = _mm_min_epu8(m, _mm_srli_epi16(m, 8));
    return (uint8_t)_mm_cvtsi128_si32(_mm_minpos_epu16(_mm_and_si128(m, _mm_set1_epi16(255))));
}

/* sums[0..31] (+)= a + b + c + d, 8 bits to 16. */
static inline void add_paths(uint16_t *sums, int accumulate, __m256i a, __m256i b, __m256i c, __m256i d) {
    const __m256i ones = _mm256_set1_epi8(1);
    const __m256i low = _mm256_add_epi16(_mm256_maddubs_epi16(_mm256_unpacklo_epi8(a, b), ones),
                                         _mm256_maddubs_epi16(_mm256_unpacklo_epi8(c, d), ones));
    const __m256i high = _mm256_add_epi16(_mm256_maddubs_epi16(_mm256_unpackhi_epi8(a, b), ones),
                                          _mm256_maddubs_epi16(_mm256_unpackhi_epi8(c, d), ones));
    __m256i first = _mm256_permute2x128_si256(low, high, 0x20);
    __m256i second = _mm256_permute2x128_si256(low, high, 0x31);
    if (accumulate) {
        first = _mm256_add_epi16(first, _mm256_loadu_si256((const __m256i *)sums));
        second = _mm256_add_epi16(second, _mm256_loadu_si256((const __m256i *)(sums + 16)));
    }
    _mm256_storeu_si256((__m256i *)sums, first);
    _mm256_storeu_si256((__m256i *)(sums + 16), second);
}

static inline void sweep(const uint8_t *cost, const int32_t *base, const uint8_t *image, match_size size,
                         uint8_t p1, const uint8_t *p2, int32_t max_slant, int backward, path_buffers *buffers,
                         uint16_t *aggregated) {
    const ptrdiff_t direction = backward ? -1 : 1, depth = size.depth;
    const __m256i p1_vector = _mm256_set1_epi8((char)p1);
    for (ptrdiff_t n = 0; n < size.height; n++) {
        const ptrdiff_t y = backward ? size.height - 1 - n : n;
        path_row *now = buffers->rows[n & 1], *above = buffers->rows[!(n & 1)];
        for (ptrdiff_t m = 0; m < size.width; m++) {
            const ptrdiff_t x = backward ? size.width - 1 - m : m;
            const ptrdiff_t p = y * size.width + x;
            const uint8_t *pixel_cost = cost + p * depth;
            uint16_t *sums = aggregated + p * depth;
            step steps[PATHS];
            for (int k = 0; k < PATHS; k++) {
                /* Path 0 comes along the row, 1 to 3 from the three neighbours in the row before. */
                const ptrdiff_t before_x = k == 0 ? x - direction : x + (k - 2) * direction;
                const ptrdiff_t q = (k == 0 ? y : y - direction) * size.width + before_x;
                const path_row *from = k == 0 ? now : above + k;
                uint8_t *path = now[k].slots + x * buffers->stride;
                if (before_x < 0 || before_x >= size.width || (k > 0 && n == 0)) {
                    begin_step(&steps[k], buffers->edge, 0, 0, depth, p2[0], path);
                } else {
                    const ptrdiff_t difference = (ptrdiff_t)base[p] - base[q];
                    begin_step(&steps[k], from->slots + before_x * buffers->stride, from->minima[before_x],
                               llabs(difference) <= max_slant ? 0 : difference, depth,
                               p2[abs(image[p] - image[q])], path);
                }
            }
            for (ptrdiff_t i = 0; i < depth; i += DEPTH_STEP) {
                const __m256i c = _mm256_loadu_si256((const __m256i *)(pixel_cost + i));
                const __m256i l0 = advance(&steps[0], i, c, p1_vector);
                const __m256i l1 = advance(&steps[1], i, c, p1_vector);
                const __m256i l2 = advance(&steps[2], i, c, p1_vector);
                const __m256i l3 = advance(&steps[3], i, c, p1_vector);
                add_paths(sums + i, backward, l0, l1, l2, l3);
            }
            for (int k = 0; k < PATHS; k++) {
                now[k].minima[x] = horizontal_min(steps[k].minimum);
            }
        }
    }
}

int aggregation_avx2(const uint8_t *cost, const int32_t *base, const uint8_t *image, match_size size, uint8_t p1,
                     const uint8_t *p2, int32_t max_slant, uint16_t *aggregated) {
    path_buffers buffers;
    if (allocate(&buffers, size.width, size.depth)) {
        return -1;
    }
    sweep(cost, base, image, size, p1, p2, max_slant, 0, &buffers, aggregated);
    sweep(cost, base, image, size, p1, p2, max_slant, 1, &buffers, aggregated);
    free(buffers.memory);
    return 0;
}
