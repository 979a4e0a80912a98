#include "arrays.h"

#include <stdint.h>
#include <string.h>

/* An empty array can have any number of rows, over which loops would run for hours. */
enum { LONGEST_OF_NOTHING = 1 << 24 };

static char format_kind(const char *format) {
    if (!format) {
        return 'u';
    }
    if (*format == '<' || *format == '=' || *format == '@') {
        format++;
    }
    if (strlen(format) != 1) {
        return '\0';
    }
    return strchr("BHILQ?", *format) ? 'u' : strchr("bhilq", *format) ? 'i' : strchr("fd", *format) ? 'f' : '\0';
}

void *array_get(array_set *set, PyObject *object, const char *name, char kind, Py_ssize_t itemsize, int ndim,
                int writable, Py_ssize_t *shape) {
    if (set->count == MAX_ARRAYS) {
        PyErr_SetString(PyExc_SystemError, "too many arrays");
        return NULL;
    }
    Py_buffer *view = &set->views[set->count];
    const int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (writable ? PyBUF_WRITABLE : 0);
    if (PyObject_GetBuffer(object, view, flags)) {
        PyErr_Clear();
        PyErr_Format(PyExc_TypeError, "%s must be a C-contiguous%s array", name, writable ? " writable" : "");
        return NULL;
    }
    set->writable[set->count++] = writable;
    if (format_kind(view->format) != kind || view->itemsize != itemsize) {
        PyErr_Format(PyExc_TypeError, "%s must have items of type %c%zd, not '%s'", name, kind, itemsize,
                     view->format ? view->format : "B");
        return NULL;
    }
    if (view->ndim != ndim) {
        PyErr_Format(PyExc_ValueError, "%s must have %d dimensions, not %d", name, ndim, view->ndim);
        return NULL;
    }
    if (view->len > 0 && (uintptr_t)view->buf % (size_t)itemsize) {
        PyErr_Format(PyExc_ValueError, "%s must be aligned to its items", name);
        return NULL;
    }
    for (int k = 0; view->len == 0 && k < ndim; k++) {
        if (view->shape[k] > LONGEST_OF_NOTHING) {
            PyErr_Format(PyExc_ValueError, "%s is empty, yet has size %zd along axis %d", name, view->shape[k], k);
            return NULL;
        }
    }
    for (int k = 0; shape && k < ndim; k++) {
        if (shape[k] >= 0 && shape[k] != view->shape[k]) {
            PyErr_Format(PyExc_ValueError, "%s has size %zd along axis %d, expected %zd", name, view->shape[k], k,
                         shape[k]);
            return NULL;
        }
        shape[k] = view->shape[k];
    }
    return view->buf;
}

int arrays_disjoint(const array_set *set) {
    for (int a = 0; a < set->count; a++) {
        const char *start = set->views[a].buf, *end = start + set->views[a].len;
        for (int b = 0; b < set->count && set->writable[a]; b++) {
            const char *other = set->views[b].buf, *other_end = other + set->views[b].len;
            if (a != b && start < other_end && other < end) {
                PyErr_SetString(PyExc_ValueError, "an output array overlaps another argument");
                return 0;
            }
        }
    }
    return 1;
}

void arrays_release(array_set *set) {
    for (int k = 0; k < set->count; k++) {
        PyBuffer_Release(&set->views[k]);
    }
    set->count = 0;
}
