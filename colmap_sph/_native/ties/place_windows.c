/* Where an image shows the pixels of windows; see ties.h. */
#include <math.h>
#include <string.h>

#include "arctangent.h"
#include "ties/sines.h"
#include "ties/ties.h"
#include "version.h"

/* Rows of a window, and pixels of a row, that are worked on together: as many as windows have. What is more than
 * there are is worked out for nothing. */
enum { BLOCK = 16 };
/* Angles from a window's middle up to this have sines by their series, right to the last bit of a float. */
static const double SMALL_ANGLE = 0.25;

/* Sines and cosines of angles and of sums of angles. */
typedef struct {
    float sine[BLOCK], cosine[BLOCK];
} directions;

/* Rows of a window in the image: a pixel's ray is `along` its direction, and what its row has in common. */
typedef struct {
    double middle[BLOCK]; /* what columns are equal steps of, at the middle pixel; and from pixel to pixel */
    double step;
    double flatness;               /* of the sphere's columns */
    directions middles;            /* of the middle pixels, where columns are angles */
    float along[3], row[3][BLOCK]; /* homogeneous pixel = along · sine + row · cosine */
} window_rows;

/* Angle of a column of the sphere. */
ALWAYS_INLINE double angle_of(double flatness, double along) {
    return flatness > 0 ? arctangent2(flatness * along, 1) / flatness : along;
}

static void find_rows(const double *place, const double *slopes, const rectified_camera *camera, ptrdiff_t first,
                      window_rows *rows) {
    const double *matrix = camera->pixel_from_ray;
    double down[BLOCK], ahead[BLOCK];
    for (int y = 0; y < BLOCK; y++) {
        const double j = (double)(first + y);
        const double across = (place[1] + j + camera->row_origin) / camera->row_scale;
        const sine_pair sines = sines_of(camera->spherical ? across : 0);
        down[y] = camera->spherical ? sines.sine : across;
        ahead[y] = sines.cosine;
        rows->middle[y] = (place[0] + slopes[1] * j + camera->column_origin) / camera->column_scale;
    }
    rows->step = slopes[0] / camera->column_scale;
    rows->flatness = camera->flatness;
    for (int k = 0; k < 3; k++) {
        rows->along[k] = (float)matrix[3 * k];
        for (int y = 0; y < BLOCK; y++) {
            rows->row[k][y] = (float)(matrix[3 * k + 1] * down[y] + matrix[3 * k + 2] * ahead[y]);
        }
    }
    for (int y = 0; y < BLOCK; y++) {
        const sine_pair sines = sines_of(angle_of(camera->flatness, rows->middle[y]));
        rows->middles.sine[y] = (float)sines.sine;
        rows->middles.cosine[y] = (float)sines.cosine;
    }
}

/* Of pixels of a row from `first` on, counted from the middle one. */
ALWAYS_INLINE void plane_directions(const window_rows *rows, int y, int first, directions *found) {
    for (int i = 0; i < BLOCK; i++) {
        found->sine[i] = (float)(rows->middle[y] + rows->step * (first + i));
        found->cosine[i] = 1;
    }
}

ALWAYS_INLINE void wide_directions(const window_rows *rows, int y, int first, directions *found) {
    for (int i = 0; i < BLOCK; i++) {
        const sine_pair sines = sines_of(angle_of(rows->flatness, rows->middle[y] + rows->step * (first + i)));
        found->sine[i] = (float)sines.sine;
        found->cosine[i] = (float)sines.cosine;
    }
}

/* Angle, if small, from the row's middle to a column so far from it: arctan b - arctan a is the arctangent of
 * (b - a) / (1 + a b). */
ALWAYS_INLINE float angle_from_middle(float flatness, float a, float away) {
    const float x = flatness * away / (1 + a * (a + flatness * away)), square = x * x;
    return x * (1 - square * (1.0f / 3 - square * (1.0f / 5 - square * (1.0f / 7)))) / flatness;
}

ALWAYS_INLINE void narrow_directions(const window_rows *rows, int y, int first, directions *found) {
    const float step = (float)rows->step, flatness = (float)rows->flatness;
    const float a = flatness * (float)rows->middle[y];
    const float middle_sine = rows->middles.sine[y], middle_cosine = rows->middles.cosine[y];
    for (int i = 0; i < BLOCK; i++) {
        const float away = step * (float)(first + i);
        const float angle = rows->flatness > 0 ? angle_from_middle(flatness, a, away) : away;
        const float square = angle * angle;
        const float sine = angle * (1 - square * (1.0f / 6) * (1 - square * (1.0f / 20)));
        const float cosine = 1 - square * 0.5f * (1 - square * (1.0f / 12) * (1 - square * (1.0f / 30)));
        found->sine[i] = middle_sine * cosine + middle_cosine * sine;
        found->cosine[i] = middle_cosine * cosine - middle_sine * sine;
    }
}

ALWAYS_INLINE void project(const window_rows *rows, int y, const directions *d, float *columns,
                           float *image_rows) {
    const float *along = rows->along, row[3] = {rows->row[0][y], rows->row[1][y], rows->row[2][y]};
    for (int i = 0; i < BLOCK; i++) {
        const float u = along[0] * d->sine[i] + row[0] * d->cosine[i];
        const float v = along[1] * d->sine[i] + row[1] * d->cosine[i];
        const float w = along[2] * d->sine[i] + row[2] * d->cosine[i];
        /* COLMAP counts from the pixel's corner, cv2.remap from its centre. */
        columns[i] = (w > 0 ? u / w : -1) - 0.5f;
        image_rows[i] = (w > 0 ? v / w : -1) - 0.5f;
    }
}

static void place_row(const window_rows *rows, int y, int spherical, int width, float *columns,
                      float *image_rows) {
    const int is_narrow = fabs(rows->step) * (double)width <= SMALL_ANGLE;
    for (int left = 0; left < width; left += BLOCK) {
        const int first = left - width / 2, count = width - left < BLOCK ? width - left : BLOCK;
        directions found;
        if (!spherical) {
            plane_directions(rows, y, first, &found);
        } else if (is_narrow) {
            narrow_directions(rows, y, first, &found);
        } else {
            wide_directions(rows, y, first, &found);
        }
        float u[BLOCK], v[BLOCK];
        project(rows, y, &found, u, v);
        memcpy(columns + left, u, (size_t)count * sizeof *u);
        memcpy(image_rows + left, v, (size_t)count * sizeof *v);
    }
}

void VERSION_OF(place_windows)(const double *places, const double *slopes, rectified_camera camera,
                               ptrdiff_t count, ptrdiff_t height, ptrdiff_t width, float *columns, float *rows) {
    for (ptrdiff_t p = 0; p < count; p++) {
        for (ptrdiff_t top = 0; top < height; top += BLOCK) {
            window_rows found;
            find_rows(places + 2 * p, slopes + 2 * p, &camera, top - height / 2, &found);
            for (int y = 0; y < BLOCK && top + y < height; y++) {
                const ptrdiff_t out = (p * height + top + y) * width;
                place_row(&found, y, camera.spherical, (int)width, columns + out, rows + out);
            }
        }
    }
}
