/* Points carried from one view to another. */
#ifndef COLMAP_SPH_GEOMETRY_H
#define COLMAP_SPH_GEOMETRY_H

typedef struct {
    double x, y, z;
} vector;

/* A pixel (x, y) of depth z in another view: its depth there as z, and its pixel times that depth. */
static inline vector transform(const double *m, const double *t, double x, double y, double z) {
    return (vector){(m[0] * x + m[1] * y + m[2]) * z + t[0], (m[3] * x + m[4] * y + m[5]) * z + t[1],
                    (m[6] * x + m[7] * y + m[8]) * z + t[2]};
}

/* [A | a], row by row, as A and a. */
static inline void split_transfer(const double *matrix, double *left, double *last) {
    for (int r = 0; r < 3; r++) {
        for (int c = 0; c < 3; c++) {
            left[3 * r + c] = matrix[4 * r + c];
        }
        last[r] = matrix[4 * r + 3];
    }
}

#endif
