/* The census of an image in blocks of pixels side by side: what the versions with vectors share. */
#ifndef COLMAP_SPH_CENSUS_BLOCKS_H
#define COLMAP_SPH_CENSUS_BLOCKS_H

#include "matching/matching.h"

/* Words of the pixels of a block, whose first one's window begins at `window`. */
typedef void census_block_fn(const int16_t *window, ptrdiff_t stride, uint64_t *words);

/* `lanes` is the number of pixels in a block. */
ALWAYS_INLINE void census_in_blocks(census_block_fn *block, ptrdiff_t lanes, const int16_t *padded,
                                    const uint8_t *valid, ptrdiff_t height, ptrdiff_t width, uint64_t *census) {
    if (width < lanes) {
        census_scalar(padded, valid, height, width, census);
        return;
    }
    const ptrdiff_t stride = width + 2 * CENSUS_RADIUS_X;
    for (ptrdiff_t y = 0; y < height; y++) {
        uint64_t *row = census + y * width;
        for (ptrdiff_t x = 0; x < width; x += lanes) {
            /* The last block overlaps the one before it. */
            const ptrdiff_t start = x + lanes <= width ? x : width - lanes;
            uint8_t any = 0;
            for (ptrdiff_t i = 0; i < lanes; i++) {
                any |= valid[y * width + start + i];
            }
            if (!any) {
                continue;
            }
            block(padded + y * stride + start, stride, row + start);
        }
        for (ptrdiff_t x = 0; x < width; x++) {
            row[x] = valid[y * width + x] ? row[x] : CENSUS_INVALID;
        }
    }
}

#endif
