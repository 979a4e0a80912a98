/* Kernels of rectified images: where their pixels lie in the image that they are sampled from, and what the census
 * compares. One pass each, plain enough for compilers to work on many pixels at once. */
#ifndef COLMAP_SPH_IMAGES_H
#define COLMAP_SPH_IMAGES_H

#include "common.h"

/* The homogeneous source pixel of a rectified one, three floats: rows[k][row] * weights[column] +
 * columns[k][column] (three arrays of so many rows and columns). */
typedef struct {
    const float *rows, *columns, *weights;
    ptrdiff_t height, width;
} ray_tables;

/* Columns and rows in an image of so many pixels, whose centres have whole numbers; `inside` is 255 where they lie
 * in it, else 0. */
typedef void source_pixels_fn(ray_tables tables, float source_width, float source_height, float *columns,
                              float *rows, uint8_t *inside);

/* Grey values, and where they count, 255 (NULL: everywhere); no fewer than 2 x 2 pixels, and fewer than 2^31. */
typedef struct {
    const float *pixels;
    const uint8_t *mask;
    ptrdiff_t height, width;
} source_image;

/* Grey values of rectified pixels, linear between those of the source, beyond which its outermost ones go on; and
 * 255 where they lie inside and no pixel that does not count has a part in them, else 0. -1 without memory. */
typedef int resample_fn(ray_tables tables, source_image source, float *grey, uint8_t *valid);

/* The mean of 2 x 2 pixels each, and 255 where at least half of them are content, 255, else 0. Half the size is
 * that rounded up: an image's last row or column is doubled, and beyond a mask's there is no content. Plain enough
 * for compilers to work on many pixels at once, so that one version serves all processors. */
void half_image(const float *image, ptrdiff_t height, ptrdiff_t width, float *half);
void half_mask(const uint8_t *mask, ptrdiff_t height, ptrdiff_t width, uint8_t *half);

/* An image plus `sharpening` times its difference from the binomial mean of 3 x 3 pixels, in 1/CENSUS_STEPS grey
 * value, cut to whole ones, with a border of CENSUS_RADIUS_{Y,X}: there, and beside it, the outermost pixels of
 * the image go on. -1 without memory. */
typedef int sharpen_fn(const float *image, ptrdiff_t height, ptrdiff_t width, float sharpening, int16_t *padded);

source_pixels_fn source_pixels_scalar, source_pixels_avx2, source_pixels_avx512bw, source_pixels_avx512;
resample_fn resample_scalar, resample_avx2, resample_avx512bw, resample_avx512;
sharpen_fn sharpen_scalar, sharpen_avx2, sharpen_avx512bw, sharpen_avx512;

#endif
