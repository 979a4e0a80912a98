/* The kernels of rectified images as Python's functions. */
#include "boundary.h"
#include "images/images.h"

#define SOURCE_PIXELS(X) \
    X(VALUE, backend, backend) \
    X(IN, float32, ray_rows, 3, H) \
    X(IN, float32, ray_columns, 3, W) \
    X(IN, float32, weights, W) \
    X(VALUE, int, source_width) \
    X(VALUE, int, source_height) \
    X(OUT, float32, columns, H, W) \
    X(OUT, float32, rows, H, W) \
    X(OUT, uint8, inside, H, W)
ARGUMENTS(source_pixels, SOURCE_PIXELS);

static int run_source_pixels(void *arguments) {
    const source_pixels_arguments *a = arguments;
    const ray_tables tables = {a->ray_rows, a->ray_columns, a->weights, a->size.H, a->size.W};
    a->backend->source_pixels(tables, (float)a->source_width, (float)a->source_height, a->columns, a->rows,
                              a->inside);
    return 0;
}

FUNCTION(
    source_pixels, SOURCE_PIXELS, any,
    "Where rectified pixels, of rays ray_rows * weights + ray_columns, lie in an image, and 255 inside of it.");

#define RESAMPLE(X) \
    X(VALUE, backend, backend) \
    X(IN, float32, ray_rows, 3, H) \
    X(IN, float32, ray_columns, 3, W) \
    X(IN, float32, weights, W) \
    X(IN, float32, image, SOURCE_H, SOURCE_W) \
    X(IN, uint8, mask, MASK_H, SOURCE_W) \
    X(OUT, float32, grey, H, W) \
    X(OUT, uint8, valid, H, W)
ARGUMENTS(resample, RESAMPLE);

static int check_resample(const void *arguments) {
    const resample_arguments *a = arguments;
    return check(a->size.SOURCE_H >= 2 && a->size.SOURCE_W >= 2,
                 "an image must have a size of 2 x 2 pixels or more") &&
           check(a->size.SOURCE_H <= INT32_MAX / a->size.SOURCE_W,
                 "an image must have a size of fewer than 2^31 pixels") &&
           check(a->size.MASK_H == 0 || a->size.MASK_H == a->size.SOURCE_H,
                 "a mask must have the size of its image, or no rows");
}

static int run_resample(void *arguments) {
    const resample_arguments *a = arguments;
    const ray_tables tables = {a->ray_rows, a->ray_columns, a->weights, a->size.H, a->size.W};
    const uint8_t *mask = a->size.MASK_H > 0 ? a->mask : NULL;
    const source_image source = {a->image, mask, a->size.SOURCE_H, a->size.SOURCE_W};
    return a->backend->resample(tables, source, a->grey, a->valid);
}

FUNCTION(resample, RESAMPLE, check_resample,
         "Grey values of rectified pixels, linear between an image's, and 255 where all of them count.");

static int check_half(const sizes *size) {
    return check(size->H == size->FINE_H / 2 + size->FINE_H % 2 && size->W == size->FINE_W / 2 + size->FINE_W % 2,
                 "an image must have twice the size of its half, or one less");
}

#define HALF_IMAGE(X) \
    X(IN, float32, image, FINE_H, FINE_W) \
    X(OUT, float32, half, H, W)
ARGUMENTS(half_image, HALF_IMAGE);

static int check_half_image(const void *arguments) {
    const half_image_arguments *a = arguments;
    return check_half(&a->size);
}

static int run_half_image(void *arguments) {
    const half_image_arguments *a = arguments;
    half_image(a->image, a->size.FINE_H, a->size.FINE_W, a->half);
    return 0;
}

FUNCTION(half_image, HALF_IMAGE, check_half_image, "The mean of 2 x 2 pixels each.");

#define HALF_MASK(X) \
    X(IN, uint8, mask, FINE_H, FINE_W) \
    X(OUT, uint8, half, H, W)
ARGUMENTS(half_mask, HALF_MASK);

static int check_half_mask(const void *arguments) {
    const half_mask_arguments *a = arguments;
    return check_half(&a->size);
}

static int run_half_mask(void *arguments) {
    const half_mask_arguments *a = arguments;
    half_mask(a->mask, a->size.FINE_H, a->size.FINE_W, a->half);
    return 0;
}

FUNCTION(half_mask, HALF_MASK, check_half_mask, "255 where at least half of 2 x 2 pixels are, else 0.");

#define SHARPEN(X) \
    X(VALUE, backend, backend) \
    X(IN, float32, image, H, W) \
    X(VALUE, float, sharpening) \
    X(OUT, int16, padded, H + 6, W + 8)
ARGUMENTS(sharpen, SHARPEN);

static int run_sharpen(void *arguments) {
    const sharpen_arguments *a = arguments;
    return a->backend->sharpen(a->image, a->size.H, a->size.W, a->sharpening, a->padded);
}

FUNCTION(
    sharpen, SHARPEN, any,
    "An image plus so many times what it differs by from its mean nearby, in 1/64 grey value, with a border.");

native_function *const images_functions[] = {&source_pixels_function, &resample_function, &half_image_function,
                                             &half_mask_function,     &sharpen_function,  NULL};
