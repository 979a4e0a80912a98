/* The kernels of ties as Python's functions. */
#include "ties/ties.h"

#include "boundary.h"

_Static_assert(PARAMETERS == 4, "tables below");

static int check_window(ptrdiff_t height, ptrdiff_t width) {
    return check(height > 0 && width > 0 && height <= MAX_WINDOW && width <= MAX_WINDOW &&
                     height * width <= MAX_WINDOW,
                 "windows must have 1 to 1024 pixels");
}

#define FIT_SURFACES(X) \
    X(IN, float32, disparity, H, W) \
    X(IN, float64, places, POINTS, 2) \
    X(VALUE, double, least_found) \
    X(OUT, float64, planes, POINTS, 3) \
    X(OUT, float32, roughness, POINTS)
ARGUMENTS(fit_surfaces, FIT_SURFACES);

static int run_fit_surfaces(void *arguments) {
    const fit_surfaces_arguments *a = arguments;
    const disparity_map map = {a->disparity, a->size.H, a->size.W};
    fit_surfaces(map, a->places, a->size.POINTS, a->least_found, a->planes, a->roughness);
    return 0;
}

FUNCTION(fit_surfaces, FIT_SURFACES, any,
         "Planes through the disparities around places, and how far these are from them; infinite where too few.");

#define PLACE_WINDOWS(X) \
    X(VALUE, backend, backend) \
    X(IN, float64, places, POINTS, 2) \
    X(IN, float64, slopes, POINTS, 2) \
    X(IN, float64, pixel_from_ray, 3, 3) \
    X(VALUE, pair, origins) \
    X(VALUE, pair, scales) \
    X(VALUE, flag, spherical) \
    X(VALUE, double, flatness) \
    X(OUT, float32, columns, POINTS, H, W) \
    X(OUT, float32, rows, POINTS, H, W)
ARGUMENTS(place_windows, PLACE_WINDOWS);

static int check_place_windows(const void *arguments) {
    const place_windows_arguments *a = arguments;
    return check_window(a->size.H, a->size.W);
}

static int run_place_windows(void *arguments) {
    const place_windows_arguments *a = arguments;
    const rectified_camera camera = {a->pixel_from_ray, a->origins.first, a->origins.second, a->scales.first,
                                     a->scales.second,  a->spherical,     a->flatness};
    a->backend->place_windows(a->places, a->slopes, camera, a->size.POINTS, a->size.H, a->size.W, a->columns,
                              a->rows);
    return 0;
}

FUNCTION(place_windows, PLACE_WINDOWS, check_place_windows,
         "Where an image shows the pixels of sloping windows around places of a rectified pair.");

#define MAKE_TEMPLATES(X) \
    X(IN, float32, windows, POINTS, H + 2, W + 2) \
    X(VALUE, float, least_contrast) \
    X(OUT, float32, values, POINTS, PIXELS) \
    X(OUT, float32, jacobian, POINTS, 4, PIXELS) \
    X(OUT, float32, normal, POINTS, 4, 4)
ARGUMENTS(make_templates, MAKE_TEMPLATES);

static int check_make_templates(const void *arguments) {
    const make_templates_arguments *a = arguments;
    return check_window(a->size.H, a->size.W) &&
           check(a->size.PIXELS == a->size.H * a->size.W,
                 "values must have the size of the windows without their rim");
}

static int run_make_templates(void *arguments) {
    const make_templates_arguments *a = arguments;
    make_templates(a->windows, a->size.POINTS, a->size.H, a->size.W, a->least_contrast, a->values, a->jacobian,
                   a->normal);
    return 0;
}

FUNCTION(make_templates, MAKE_TEMPLATES, check_make_templates,
         "Windows with mean 0 and variance 1, how they change when they move and slope, and the normal matrices.");

#define STEP_WINDOWS(X) \
    X(IN, float32, values, POINTS, PIXELS) \
    X(IN, float32, jacobian, POINTS, 4, PIXELS) \
    X(IN, float32, inverse, POINTS, 4, 4) \
    X(IN, float32, windows, POINTS, PIXELS) \
    X(VALUE, float, least_contrast) \
    X(OUT, float32, move, POINTS, 4) \
    X(OUT, float32, correlation, POINTS) \
    X(OUT, float32, variance, POINTS)
ARGUMENTS(step_windows, STEP_WINDOWS);

static int check_step_windows(const void *arguments) {
    const step_windows_arguments *a = arguments;
    return check_window(1, a->size.PIXELS);
}

static int run_step_windows(void *arguments) {
    const step_windows_arguments *a = arguments;
    const template_windows input = {a->values,      a->jacobian,    a->inverse,       a->windows,
                                    a->size.POINTS, a->size.PIXELS, a->least_contrast};
    step_windows(input, a->move, a->correlation, a->variance);
    return 0;
}

FUNCTION(
    step_windows, STEP_WINDOWS, check_step_windows,
    "One step of the least squares of windows towards templates, their correlation and mean square difference.");

native_function *const ties_functions[] = {&fit_surfaces_function, &place_windows_function,
                                           &make_templates_function, &step_windows_function, NULL};
