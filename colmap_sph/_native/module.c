/* The extension module. Its functions, in the groups' functions.c, are the Python face of the kernels: Python
 * allocates every array; sizes and bounds are checked, and the GIL is released around the work (boundary.h). */
#include "boundary.h"

static native_function *const *const groups[] = {matching_functions, depth_functions, fusion_functions,
                                                 surface_functions,  ties_functions,  offsets_functions,
                                                 images_functions};

enum { GROUPS = sizeof groups / sizeof *groups };

/* Appends and lets go of an item; clears the list where that fails, or where there is no item. */
static void append(PyObject **list, PyObject *item) {
    if (!item || PyList_Append(*list, item)) {
        Py_CLEAR(*list);
    }
    Py_XDECREF(item);
}

static PyObject *py_backends(PyObject *self, PyObject *args) {
    (void)self;
    (void)args;
    PyObject *names = PyList_New(0);
    for (const char *const *name = kernel_names; names && *name; name++) {
        if (kernels_by_name(*name)) {
            append(&names, PyUnicode_FromString(*name));
        }
    }
    return names;
}

static PyObject *py_missing(PyObject *self, PyObject *args) {
    (void)self;
    (void)args;
    PyObject *names = PyList_New(0);
    for (const char *const *name = missing_kernels; names && *name; name++) {
        append(&names, PyUnicode_FromString(*name));
    }
    return names;
}

static PyObject *py_signatures(PyObject *self, PyObject *args) {
    (void)self;
    (void)args;
    PyObject *signatures = PyList_New(0);
    for (int g = 0; g < GROUPS; g++) {
        for (native_function *const *function = groups[g]; signatures && *function; function++) {
            append(&signatures, signature_of(*function));
        }
    }
    return signatures;
}

static int add_functions(PyObject *module) {
    for (int g = 0; g < GROUPS; g++) {
        for (native_function *const *function = groups[g]; *function; function++) {
            if (PyModule_AddFunctions(module, (*function)->methods)) {
                return -1;
            }
        }
    }
    return 0;
}

static PyMethodDef methods[] = {
    {"backends", py_backends, METH_NOARGS,
     "backends($module, /)\n--\n\nNames of the kernel versions this processor runs, fastest first."},
    {"missing", py_missing, METH_NOARGS,
     "missing($module, /)\n--\n\n"
     "Names of the kernel versions that a build for this kind of processor can have and this one has not."},
    {"signatures", py_signatures, METH_NOARGS,
     "signatures($module, /)\n--\n\n"
     "Of all other functions (name, ((argument, role, type, ((symbol or None, number), ...)), ...)).\n\n"
     "Roles are value, in, out, images and result; an array's size along an axis is that of the symbol, plus the\n"
     "number."},
    {NULL, NULL, 0, NULL}};

static PyModuleDef_Slot slots[] = {{Py_mod_exec, add_functions}, {0, NULL}};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, .m_name = "_native",
                                        .m_doc = "Kernels of colmap_sph.", .m_methods = methods, .m_slots = slots};

PyMODINIT_FUNC PyInit__native(void) { return PyModuleDef_Init(&definition); }
