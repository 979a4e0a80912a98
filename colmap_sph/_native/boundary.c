#include "boundary.h"

#include <string.h>

/* An empty array can have any number of rows, over which loops would run for hours. */
enum { LONGEST_OF_NOTHING = 1 << 24 };

enum { MAX_ARRAYS = 16 + MAX_IMAGES };

/* The arrays of a call. */
typedef struct {
    Py_buffer views[MAX_ARRAYS];
    int written[MAX_ARRAYS];
    int count;
    image_tuple images;
} array_set;

static const struct {
    const char *name, *formats; /* of the array's items; none of a value */
    Py_ssize_t itemsize;
} types[] = {
    [TYPE_backend] = {PYTHON_backend, "", 0}, [TYPE_flag] = {PYTHON_flag, "", 0},
    [TYPE_int] = {PYTHON_int, "", 0},         [TYPE_ptrdiff] = {PYTHON_ptrdiff, "", 0},
    [TYPE_float] = {PYTHON_float, "", 0},     [TYPE_double] = {PYTHON_double, "", 0},
    [TYPE_pair] = {PYTHON_pair, "", 0},       [TYPE_uint8] = {"uint8", "B?", 1}, /* truth values are bytes, too */
    [TYPE_uint16] = {"uint16", "H", 2},       [TYPE_uint32] = {"uint32", "IL", 4},
    [TYPE_uint64] = {"uint64", "LQ", 8},      [TYPE_int16] = {"int16", "h", 2},
    [TYPE_int32] = {"int32", "il", 4},        [TYPE_float32] = {"float32", "f", 4},
    [TYPE_float64] = {"float64", "d", 8},
};

static const char *const role_names[] = {
    [VALUE] = "value", [IN] = "in", [OUT] = "out", [IMAGES] = "images", [RESULT] = "result"};

/* ---- errors ------------------------------------------------------------------------------------------------ */

int any(const void *arguments) {
    (void)arguments;
    return 1;
}

int check(int condition, const char *message) {
    if (!condition) {
        PyErr_SetString(PyExc_ValueError, message);
    }
    return condition;
}

int check_size(const char *name, int axis, ptrdiff_t size, ptrdiff_t expected) {
    if (size != expected) {
        PyErr_Format(PyExc_ValueError, "%s has size %zd along axis %d, expected %zd", name, (Py_ssize_t)size, axis,
                     (Py_ssize_t)expected);
    }
    return size == expected;
}

/* In place of Python's message, which does not name the argument. */
static void name_argument(const char *name, const char *wanted) {
    if (PyErr_ExceptionMatches(PyExc_TypeError)) {
        PyErr_Format(PyExc_TypeError, "%s must be %s", name, wanted);
    } else if (PyErr_ExceptionMatches(PyExc_OverflowError)) {
        PyErr_Format(PyExc_OverflowError, "%s is too large for %s", name, wanted);
    }
}

/* ---- values ------------------------------------------------------------------------------------------------ */

static int read_backend(const char *name, PyObject *object, const kernel_table **table) {
    Py_ssize_t length;
    const char *text = PyUnicode_AsUTF8AndSize(object, &length);
    if (!text) {
        name_argument(name, "text");
        return 0;
    }
    if (strlen(text) != (size_t)length) {
        PyErr_Format(PyExc_ValueError, "%s has an embedded null character", name);
        return 0;
    }
    *table = kernels_by_name(text);
    if (!*table) {
        PyErr_Format(PyExc_ValueError, "no kernels named '%s' on this processor", text);
    }
    return *table != NULL;
}

static int read_flag(PyObject *object, int *flag) {
    *flag = PyObject_IsTrue(object);
    return *flag >= 0;
}

static int read_int(const char *name, PyObject *object, int *integer) {
    const long number = PyLong_AsLong(object);
    if (PyErr_Occurred()) {
        name_argument(name, "a whole number of 32 bits");
        return 0;
    }
    if (number < INT_MIN || number > INT_MAX) {
        PyErr_Format(PyExc_OverflowError, "%s is too large for a whole number of 32 bits", name);
        return 0;
    }
    *integer = (int)number;
    return 1;
}

static int read_ptrdiff(const char *name, PyObject *object, ptrdiff_t *count) {
    *count = PyNumber_AsSsize_t(object, PyExc_OverflowError);
    if (*count == -1 && PyErr_Occurred()) {
        name_argument(name, "a whole number of 64 bits");
        return 0;
    }
    return 1;
}

static int read_double(const char *name, PyObject *object, double *number) {
    *number = PyFloat_AsDouble(object);
    if (*number == -1 && PyErr_Occurred()) {
        name_argument(name, "a number");
        return 0;
    }
    return 1;
}

static int read_pair(const char *name, PyObject *object, number_pair *pair) {
    if (!PyTuple_Check(object) || PyTuple_Size(object) != 2) {
        PyErr_Format(PyExc_TypeError, "%s must be a tuple of two numbers", name);
        return 0;
    }
    return read_double(name, PyTuple_GetItem(object, 0), &pair->first) &&
           read_double(name, PyTuple_GetItem(object, 1), &pair->second);
}

static int read_value(const parameter *p, PyObject *object, slot *value) {
    double number;
    switch (p->type) {
    case TYPE_backend:
        return read_backend(p->name, object, &value->backend);
    case TYPE_flag:
        return read_flag(object, &value->integer);
    case TYPE_int:
        return read_int(p->name, object, &value->integer);
    case TYPE_ptrdiff:
        return read_ptrdiff(p->name, object, &value->size);
    case TYPE_float:
        if (!read_double(p->name, object, &number)) {
            return 0;
        }
        value->single = (float)number;
        return 1;
    case TYPE_double:
        return read_double(p->name, object, &value->number);
    case TYPE_pair:
        return read_pair(p->name, object, &value->pair);
    default:
        PyErr_Format(PyExc_SystemError, "%s is of no type of values", p->name);
        return 0;
    }
}

/* ---- arrays ------------------------------------------------------------------------------------------------ */

static int has_type(const Py_buffer *view, argument_type type) {
    const char *format = view->format ? view->format : "B";
    if (*format == '<' || *format == '=' || *format == '@') {
        format++;
    }
    return strlen(format) == 1 && strchr(types[type].formats, *format) && view->itemsize == types[type].itemsize;
}

/* The buffer of `object`, of this type and number of dimensions; NULL with an error set. `set` keeps it. */
static const Py_buffer *get_array(array_set *set, PyObject *object, const char *name, argument_type type,
                                  int dimensions, int written) {
    if (set->count == MAX_ARRAYS) {
        PyErr_SetString(PyExc_SystemError, "too many arrays");
        return NULL;
    }
    Py_buffer *view = &set->views[set->count];
    const int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (written ? PyBUF_WRITABLE : 0);
    if (PyObject_GetBuffer(object, view, flags)) {
        PyErr_Clear();
        PyErr_Format(PyExc_TypeError, "%s must be a C-contiguous%s array", name, written ? " writable" : "");
        return NULL;
    }
    set->written[set->count++] = written;
    if (!has_type(view, type)) {
        PyErr_Format(PyExc_TypeError, "%s must have items of type %s, not '%s'", name, types[type].name,
                     view->format ? view->format : "B");
        return NULL;
    }
    if (view->ndim != dimensions) {
        PyErr_Format(PyExc_ValueError, "%s must have %d dimensions, not %d", name, dimensions, view->ndim);
        return NULL;
    }
    if (view->len > 0 && (uintptr_t)view->buf % (size_t)view->itemsize) {
        PyErr_Format(PyExc_ValueError, "%s must be aligned to its items", name);
        return NULL;
    }
    for (int k = 0; view->len == 0 && k < dimensions; k++) {
        if (view->shape[k] > LONGEST_OF_NOTHING) {
            PyErr_Format(PyExc_ValueError, "%s is empty, yet has size %zd along axis %d", name, view->shape[k], k);
            return NULL;
        }
    }
    return view;
}

static int symbol_of(int size) { return (size >> SYMBOL_SHIFT) - 1; } /* -1 of a number */

static int number_of(int size) { return size & ((1 << SYMBOL_SHIFT) - 1); }

static int dimensions_of(const parameter *p) {
    int dimensions = 0;
    while (dimensions < MAX_DIMENSIONS && p->size[dimensions]) {
        dimensions++;
    }
    return dimensions;
}

/* Sets the symbol of a size, or compares with what it was set to before. */
static int tie_size(const parameter *p, int axis, ptrdiff_t size, sizes *known) {
    const int symbol = symbol_of(p->size[axis]), number = number_of(p->size[axis]);
    if (symbol < 0) {
        return check_size(p->name, axis, size, number);
    }
    if (known->all[symbol] >= 0) {
        return check_size(p->name, axis, size, known->all[symbol] + number);
    }
    if (size < number) {
        PyErr_Format(PyExc_ValueError, "%s has size %zd along axis %d, expected %d or more", p->name,
                     (Py_ssize_t)size, axis, number);
        return 0;
    }
    known->all[symbol] = size - number;
    return 1;
}

static int read_array(array_set *set, const parameter *p, PyObject *object, sizes *size, slot *value) {
    const int dimensions = dimensions_of(p);
    const Py_buffer *view = get_array(set, object, p->name, p->type, dimensions, p->role == OUT);
    for (int k = 0; view && k < dimensions; k++) {
        if (!tie_size(p, k, view->shape[k], size)) {
            return 0;
        }
    }
    value->array = view ? view->buf : NULL;
    return view != NULL;
}

static int read_images(array_set *set, const parameter *p, PyObject *object, sizes *size, slot *value) {
    image_tuple *images = &set->images;
    if (!PyTuple_Check(object)) {
        PyErr_Format(PyExc_TypeError, "%s must be a tuple of arrays", p->name);
        return 0;
    }
    images->count = PyTuple_Size(object);
    if (images->count < 1 || images->count > MAX_IMAGES) {
        PyErr_Format(PyExc_ValueError, "the number of %s must lie in 1..%d", p->name, (int)MAX_IMAGES);
        return 0;
    }
    for (ptrdiff_t k = 0; k < images->count; k++) {
        char name[64];
        PyOS_snprintf(name, sizeof name, "%s[%d]", p->name, (int)k);
        const Py_buffer *view = get_array(set, PyTuple_GetItem(object, k), name, p->type, 2, 0);
        if (!view) {
            return 0;
        }
        images->image[k].values = view->buf;
        images->image[k].height = view->shape[0];
        images->image[k].width = view->shape[1];
    }
    value->images = images;
    return tie_size(p, 0, images->count, size);
}

/* False with ValueError set if an array that is written overlaps any other of the call. */
static int check_disjoint(const array_set *set) {
    for (int a = 0; a < set->count; a++) {
        const char *start = set->views[a].buf, *end = start + set->views[a].len;
        for (int b = 0; b < set->count && set->written[a]; b++) {
            const char *other = set->views[b].buf, *other_end = other + set->views[b].len;
            if (a != b && start < other_end && other < end) {
                PyErr_SetString(PyExc_ValueError, "an output array overlaps another argument");
                return 0;
            }
        }
    }
    return 1;
}

/* ---- a call ------------------------------------------------------------------------------------------------ */

static int count_role(const native_function *function, argument_role role) {
    int count = 0;
    for (int k = 0; k < function->count; k++) {
        count += function->parameters[k].role == role;
    }
    return count;
}

static int read_argument(array_set *set, const parameter *p, PyObject *object, sizes *size, slot *value) {
    return p->role == VALUE    ? read_value(p, object, value)
           : p->role == IMAGES ? read_images(set, p, object, size, value)
                               : read_array(set, p, object, size, value);
}

static int read_arguments(const native_function *function, PyObject *args, array_set *set, sizes *size,
                          slot *slots) {
    const Py_ssize_t given = PyTuple_Size(args), taken = function->count - count_role(function, RESULT);
    if (given != taken) {
        PyErr_Format(PyExc_TypeError, "%s() takes %zd arguments, not %zd", function->methods->ml_name, taken,
                     given);
        return 0;
    }
    for (int k = 0; k < SYMBOL_COUNT; k++) {
        size->all[k] = -1;
    }
    /* Values first: to read one can run Python code, which had better not come between the check of an array and
     * its use. Results are behind all arguments. */
    for (int arrays = 0; arrays < 2; arrays++) {
        for (int k = 0; k < (int)taken; k++) {
            const parameter *p = &function->parameters[k];
            PyObject *object = PyTuple_GetItem(args, k);
            if ((p->role != VALUE) == arrays && !read_argument(set, p, object, size, &slots[k])) {
                return 0;
            }
        }
    }
    return 1;
}

/* None, or a tuple of all results. */
static PyObject *results_of(const native_function *function, const slot *slots) {
    const int count = count_role(function, RESULT), first = function->count - count;
    if (count == 0) {
        Py_RETURN_NONE;
    }
    PyObject *results = PyTuple_New(count);
    for (int k = 0; results && k < count; k++) {
        PyObject *result = PyLong_FromSsize_t(slots[first + k].size);
        if (!result || PyTuple_SetItem(results, k, result)) {
            Py_CLEAR(results);
        }
    }
    return results;
}

PyObject *native_call(const native_function *function, PyObject *args, void *arguments, sizes *size, slot *slots) {
    array_set set;
    set.count = 0;
    int status = 0;
    const int ready =
        read_arguments(function, args, &set, size, slots) && check_disjoint(&set) && function->check(arguments);
    if (ready) {
        Py_BEGIN_ALLOW_THREADS;
        status = function->run(arguments);
        Py_END_ALLOW_THREADS;
    }
    for (int k = 0; k < set.count; k++) {
        PyBuffer_Release(&set.views[k]);
    }
    return !ready ? NULL : status ? PyErr_NoMemory() : results_of(function, slots);
}

/* ---- signatures -------------------------------------------------------------------------------------------- */

static PyObject *size_tuple(const parameter *p) {
    const int dimensions = dimensions_of(p);
    PyObject *tuple = PyTuple_New(dimensions);
    for (int k = 0; tuple && k < dimensions; k++) {
#define SYMBOL_NAME(symbol) #symbol,
        static const char *const names[] = {SYMBOLS(SYMBOL_NAME)};
#undef SYMBOL_NAME
        const int symbol = symbol_of(p->size[k]);
        PyObject *size = Py_BuildValue("zi", symbol < 0 ? NULL : names[symbol], number_of(p->size[k]));
        if (!size || PyTuple_SetItem(tuple, k, size)) {
            Py_CLEAR(tuple);
        }
    }
    return tuple;
}

PyObject *signature_of(const native_function *function) {
    PyObject *arguments = PyTuple_New(function->count);
    for (int k = 0; arguments && k < function->count; k++) {
        const parameter *p = &function->parameters[k];
        PyObject *argument =
            Py_BuildValue("sssN", p->name, role_names[p->role], types[p->type].name, size_tuple(p));
        if (!argument || PyTuple_SetItem(arguments, k, argument)) {
            Py_CLEAR(arguments);
        }
    }
    return arguments ? Py_BuildValue("sN", function->methods->ml_name, arguments) : NULL;
}
