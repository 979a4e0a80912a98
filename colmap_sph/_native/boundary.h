/* The boundary between Python and C as data: a native function is one table of its arguments, in their order,
 *
 *     #define CENSUS(X) \
 *         X(VALUE, backend, backend) \
 *         X(IN, int16, padded, H + 6, W + 8) \
 *         X(IN, uint8, valid, H, W) \
 *         X(OUT, uint64, census, H, W)
 *     ARGUMENTS(census, CENSUS);
 *     ...
 *     FUNCTION(census, CENSUS, any, "What it does.")
 *
 * from which come the C struct that the kernel's call reads (`a->padded` is a `const int16_t *`, `a->size.H` the
 * number of rows), the checks, the docstring, and by signatures() the stub that scripts/make_native_stub.py
 * writes.
 *
 *     X(VALUE, type, name)        a backend, flag, int, ptrdiff, float, double or pair of doubles
 *     X(IN, item, name, size...)  an array, which is read
 *     X(OUT, item, name, size...) an array, which is written, too; it may not overlap any other
 *     X(IMAGES, item, name, size) a tuple of so many arrays of two dimensions each, which are read
 *     X(RESULT, name)             a whole number that is returned
 *
 * A size is a number, a symbol of SYMBOLS, or a symbol + a number. The first array with a symbol sets it; in those
 * after it, it must have the same value. */
#ifndef COLMAP_SPH_BOUNDARY_H
#define COLMAP_SPH_BOUNDARY_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "dispatch.h"

/* ---- sizes ------------------------------------------------------------------------------------------------- */

/* H and W are rows and columns of the image or map in question, D disparities; the others speak for themselves. */
#define SYMBOLS(X) \
    X(H) X(W) X(D) X(FINE_H) X(FINE_W) X(TARGET_W) X(SOURCE_H) X(SOURCE_W) X(MASK_H) X(BAND) X(MAP_H) X(MAP_W) \
    X(PARTNER_H) X(PARTNER_W) X(PAIRS) X(SOURCES) X(ROWS) X(POINTS) X(WORDS) X(PIXELS) X(TILES) X(BYTES)

#define SYMBOL_INDEX(symbol) INDEX_##symbol,
#define SYMBOL_SIZE(symbol) symbol = (INDEX_##symbol + 1) << SYMBOL_SHIFT,
#define SYMBOL_MEMBER(symbol) ptrdiff_t symbol;
enum { SYMBOL_SHIFT = 16, MAX_DIMENSIONS = 3, MAX_IMAGES = 32 };
enum { SYMBOLS(SYMBOL_INDEX) SYMBOL_COUNT };
enum { SYMBOLS(SYMBOL_SIZE) };

/* What the symbols stand for in a call; -1 where no array has told. */
typedef union {
    struct {
        SYMBOLS(SYMBOL_MEMBER)
    };
    ptrdiff_t all[SYMBOL_COUNT];
} sizes;

/* ---- arguments --------------------------------------------------------------------------------------------- */

typedef enum { VALUE, IN, OUT, IMAGES, RESULT } argument_role;

typedef enum {
    TYPE_backend,
    TYPE_flag,
    TYPE_int,
    TYPE_ptrdiff,
    TYPE_float,
    TYPE_double,
    TYPE_pair,
    TYPE_uint8,
    TYPE_uint16,
    TYPE_uint32,
    TYPE_uint64,
    TYPE_int16,
    TYPE_int32,
    TYPE_float32,
    TYPE_float64
} argument_type;

typedef struct {
    double first, second;
} number_pair;

typedef struct {
    ptrdiff_t count;
    struct {
        const void *values;
        ptrdiff_t height, width;
    } image[MAX_IMAGES];
} image_tuple;

typedef const kernel_table *type_backend;
typedef int type_flag;
typedef int type_int;
typedef ptrdiff_t type_ptrdiff;
typedef float type_float;
typedef double type_double;
typedef number_pair type_pair;
typedef uint8_t type_uint8;
typedef uint16_t type_uint16;
typedef uint32_t type_uint32;
typedef uint64_t type_uint64;
typedef int16_t type_int16;
typedef int32_t type_int32;
typedef float type_float32;
typedef double type_float64;

/* The types of values in Python. */
#define PYTHON_backend "str"
#define PYTHON_flag "bool"
#define PYTHON_int "int"
#define PYTHON_ptrdiff "int"
#define PYTHON_float "float"
#define PYTHON_double "float"
#define PYTHON_pair "tuple[float, float]"

/* Room for any argument. */
typedef union {
    const kernel_table *backend;
    int integer; /* or flag */
    ptrdiff_t size;
    float single;
    double number;
    number_pair pair;
    void *array;
    const image_tuple *images;
} slot;

typedef struct {
    const char *name;
    argument_role role;
    argument_type type;
    int size[MAX_DIMENSIONS]; /* 0 beyond the last dimension */
} parameter;

typedef struct {
    PyMethodDef methods[2]; /* its own, and the end of the list */
    const parameter *parameters;
    int count;
    /* Both get the function's arguments. `check` looks at what the table does not say: false with an error set.
     * `run`, with the GIL released, gives 0, or -1 without memory. */
    int (*check)(const void *arguments);
    int (*run)(void *arguments);
} native_function;

/* Reads `args` into `slots` and `size`, both members of `arguments`, checks and runs. */
PyObject *native_call(const native_function *function, PyObject *args, void *arguments, sizes *size, slot *slots);

/* A check that every argument passes. */
int any(const void *arguments);

/* False with ValueError set where the condition does not hold. */
int check(int condition, const char *message);

/* False with ValueError set where the array has not the expected size along an axis. */
int check_size(const char *name, int axis, ptrdiff_t size, ptrdiff_t expected);

/* All functions of a group, NULL ends them. */
extern native_function *const matching_functions[],
    *const depth_functions[], *const fusion_functions[], *const surface_functions[],
                                                             *const ties_functions[],
                                                                 *const offsets_functions[],
                                                                     *const images_functions[];

/* (name, ((argument, role, type, ((symbol or None, number), ...)), ...)); NULL with an error set. */
PyObject *signature_of(const native_function *function);

/* ---- what becomes of a table ------------------------------------------------------------------------------- */

/* `name`_parameters, and the type `name`_arguments: `size` and a member for each argument, which has the place of
 * a slot. */
#define ARGUMENTS(name, TABLE) \
    static const parameter name##_parameters[] = {TABLE(PARAMETER)}; \
    enum { name##_count = sizeof name##_parameters / sizeof *name##_parameters }; \
    typedef struct { \
        sizes size; \
        union { \
            slot slots[name##_count]; \
            struct { \
                TABLE(MEMBER) \
            }; \
        }; \
    } name##_arguments; \
    _Static_assert(sizeof(name##_arguments) == sizeof(sizes) + name##_count * sizeof(slot), "a slot each")

/* `name`_function, which Python sees, from `name`_parameters and run_`name`. */
#define FUNCTION(name, TABLE, check, summary) \
    static native_function name##_function; \
    static PyObject *py_##name(PyObject *self, PyObject *args) { \
        name##_arguments a; \
        (void)self; \
        return native_call(&name##_function, args, &a, &a.size, a.slots); \
    } \
    static native_function name##_function = { \
        {{#name, py_##name, METH_VARARGS, \
          #name "($module" TABLE(LISTED) ", /)\n--\n\n" summary "\n" TABLE(DESCRIBED)}, \
         {NULL, NULL, 0, NULL}}, \
        name##_parameters, \
        name##_count, \
        check, \
        run_##name}

#define PARAMETER(role, ...) {PARAMETER_##role(__VA_ARGS__)},
#define PARAMETER_VALUE(type, name) #name, VALUE, TYPE_##type, {0}
#define PARAMETER_IN(type, name, ...) #name, IN, TYPE_##type, {__VA_ARGS__}
#define PARAMETER_OUT(type, name, ...) #name, OUT, TYPE_##type, {__VA_ARGS__}
#define PARAMETER_IMAGES(type, name, size) #name, IMAGES, TYPE_##type, {size}
#define PARAMETER_RESULT(name) #name, RESULT, TYPE_ptrdiff, {0}

#define MEMBER(role, ...) MEMBER_##role(__VA_ARGS__)
#define MEMBER_OF(declaration, name) \
    union { \
        declaration; \
        slot name##_slot; \
    };
#define MEMBER_VALUE(type, name) MEMBER_OF(type_##type name, name)
#define MEMBER_IN(type, name, ...) MEMBER_OF(const type_##type *name, name)
#define MEMBER_OUT(type, name, ...) MEMBER_OF(type_##type *name, name)
#define MEMBER_IMAGES(type, name, size) MEMBER_OF(const image_tuple *name, name)
#define MEMBER_RESULT(name) MEMBER_OF(type_ptrdiff name, name)

#define LISTED(role, ...) LISTED_##role(__VA_ARGS__)
#define LISTED_VALUE(type, name) ", " #name
#define LISTED_IN(type, name, ...) ", " #name
#define LISTED_OUT(type, name, ...) ", " #name
#define LISTED_IMAGES(type, name, size) ", " #name
#define LISTED_RESULT(name) ""

#define DESCRIBED(role, ...) DESCRIBED_##role(__VA_ARGS__)
#define DESCRIBED_VALUE(type, name) "\n" #name " : " PYTHON_##type
#define DESCRIBED_IN(type, name, ...) "\n" #name " : (" #__VA_ARGS__ ") " #type
#define DESCRIBED_OUT(type, name, ...) "\n" #name " : (" #__VA_ARGS__ ") " #type ", written"
#define DESCRIBED_IMAGES(type, name, size) "\n" #name " : tuple of " #size " images, " #type
#define DESCRIBED_RESULT(name) "\nreturned: " #name

#endif
