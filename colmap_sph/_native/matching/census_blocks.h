/* The census of an image in blocks of pixels side by side: what the versions with vectors share. */
#ifndef COLMAP_SPH_CENSUS_BLOCKS_H
#define COLMAP_SPH_CENSUS_BLOCKS_H

#include "matching/weighed_census.h"

/* Words of the pixels of a block, whose first one's window begins at `window`. */
typedef void census_block_fn(const int16_t *window, ptrdiff_t stride, uint64_t *words);

ALWAYS_INLINE void finish_row(const int16_t *restrict centres, const uint8_t *restrict valid, ptrdiff_t width,
                              int fine, const uint64_t *restrict grey, uint64_t *restrict row) {
    for (ptrdiff_t x = 0; x < width; x++) {
        const uint64_t word = weighed_census(row[x], centres[x], fine, grey);
        row[x] = valid[x] ? word : CENSUS_INVALID;
    }
}

/* `lanes` is the number of pixels in a block. */
ALWAYS_INLINE void census_in_blocks(census_block_fn *block, ptrdiff_t lanes, census_image image, ptrdiff_t stride,
                                    uint64_t *census) {
    if (image.width < lanes) {
        census_scalar(image, stride, census);
        return;
    }
    const ptrdiff_t width = image.width, padded_stride = width + 2 * CENSUS_RADIUS_X;
    for (ptrdiff_t y = 0; y < image.height; y++) {
        const uint8_t *valid = image.valid + y * width;
        const int16_t *centres = image.padded + (y + CENSUS_RADIUS_Y) * padded_stride + CENSUS_RADIUS_X;
        uint64_t *row = census + y * stride;
        for (ptrdiff_t x = 0; x < width; x += lanes) {
            /* The last block overlaps the one before it. */
            const ptrdiff_t start = x + lanes <= width ? x : width - lanes;
            uint8_t any = 0;
            for (ptrdiff_t i = 0; i < lanes; i++) {
                any |= valid[start + i];
            }
            if (!any) {
                continue;
            }
            block(image.padded + y * padded_stride + start, padded_stride, row + start);
        }
        if (image.fine) {
            finish_row(centres, valid, width, 1, image.grey, row);
        } else if (image.grey) {
            finish_row(centres, valid, width, 0, image.grey, row);
        } else {
            finish_row(centres, valid, width, 0, NULL, row);
        }
    }
}

#endif
