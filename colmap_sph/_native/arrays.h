/* Array arguments by the buffer protocol: type, shape, contiguity and alignment checked, with the argument's name
 * in the message. */
#ifndef COLMAP_SPH_ARRAYS_H
#define COLMAP_SPH_ARRAYS_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

enum { MAX_ARRAYS = 40 };

typedef struct {
    Py_buffer views[MAX_ARRAYS];
    int writable[MAX_ARRAYS];
    int count;
} array_set;

/* The data of `object`, a C-contiguous array of `ndim` dimensions whose items are `kind` ('u', 'i' or 'f') of
 * `itemsize` bytes; NULL with TypeError or ValueError set. `shape` (may be NULL) receives the dimensions, or,
 * where it holds a value >= 0, is what the array must have. */
void *array_get(array_set *set, PyObject *object, const char *name, char kind, Py_ssize_t itemsize, int ndim,
                int writable, Py_ssize_t *shape);

/* False with ValueError set if an output overlaps any other array of the set. */
int arrays_disjoint(const array_set *set);

void arrays_release(array_set *set);

#endif
