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

#endif
