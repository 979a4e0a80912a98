/* Counts a process's file operations below a folder, and makes chosen ones fail, or ends the process before one.
 *
 * Loaded by LD_PRELOAD. What it does stands in a control block: a file that whoever watches has mapped, too
 * (`shim.py` has the same record). The environment variable HOSTILE_CONTROL names it, or `hostile_arm` does.
 * Programs that a process starts inherit both, and count into the same block.
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { ROOM = 4096 };
enum kind { OPEN, READ, WRITE, CLOSE, SYNC, RENAME, REMOVE, MAKE, RESIZE, MAP, LIST };
enum action { COUNT, FAIL, SHORTEN, STOP };

struct control {
    uint32_t kinds;  /* bits: which kinds count */
    uint32_t action; /* what is done to the operations from `first` to `last` */
    uint64_t first, last;
    int32_t value;   /* errno, or a signal's number */
    int32_t process; /* that gets the signal; negative: its group, and that of the operation's process */
    _Atomic uint64_t counted, hit;
    char prefix[ROOM], log[ROOM];
};

static const char *const words[] = {"open",   "read", "write",  "close", "sync", "rename",
                                    "remove", "make", "resize", "map",   "list"};
static struct control *control;

void hostile_arm(const char *path) {
    int file = (int)syscall(SYS_openat, AT_FDCWD, path, O_RDWR | O_CLOEXEC, 0);
    if (file < 0)
        return;
    /* As a system call: the process's own mmap is watched. */
    void *block =
        (void *)syscall(SYS_mmap, NULL, sizeof(struct control), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    syscall(SYS_close, file);
    if (block != MAP_FAILED)
        control = block;
}

__attribute__((constructor)) static void arm_by_environment(void) {
    const char *path = getenv("HOSTILE_CONTROL");
    if (path && *path)
        hostile_arm(path);
}

static ssize_t path_of(int file, char *path) {
    char link[40];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = syscall(SYS_readlinkat, AT_FDCWD, link, path, (size_t)(ROOM - 1));
    path[length < 0 ? 0 : length] = 0;
    return length;
}

static void absolute(int folder, const char *path, char *full) {
    full[0] = 0;
    if (!path)
        return;
    if (path[0] != '/') {
        ssize_t length = 0;
        if (folder != AT_FDCWD)
            length = path_of(folder, full);
        else if (syscall(SYS_getcwd, full, (size_t)ROOM) > 0)
            length = (ssize_t)strlen(full);
        if (length < 0 || length >= ROOM - 2)
            return;
        full[length++] = '/';
        full[length] = 0;
    }
    strncat(full, path, ROOM - 1 - strlen(full));
}

static void note(enum kind kind, const char *path, int is_hit) {
    char line[ROOM + 64];
    int file = (int)syscall(SYS_openat, AT_FDCWD, control->log, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0666);
    if (file < 0)
        return;
    int length = snprintf(line, sizeof line, "%s%s %s\n", is_hit ? "! " : "", words[kind], path);
    syscall(SYS_write, file, line, (size_t)length);
    syscall(SYS_close, file);
}

/* Whether this operation is one to spoil; what ends the process is done here. */
static int is_spoiled(enum kind kind, const char *path) {
    size_t length = strlen(control->prefix);
    if (!(control->kinds >> kind & 1) || strncmp(path, control->prefix, length))
        return 0;
    uint64_t number = atomic_fetch_add(&control->counted, 1) + 1;
    int is_hit = control->action != COUNT && number >= control->first && number <= control->last;
    if (control->log[0] && (is_hit || control->action == COUNT))
        note(kind, path, is_hit);
    if (!is_hit)
        return 0;
    atomic_fetch_add(&control->hit, 1);
    if (control->action == STOP) {
        syscall(SYS_kill, control->process, control->value);
        if (control->process < 0)
            syscall(SYS_kill, 0, control->value);
        return 0;
    }
    errno = control->value;
    return 1;
}

static int spoils_path(enum kind kind, int folder, const char *path) {
    if (!control)
        return 0;
    int before = errno;
    char full[ROOM];
    absolute(folder, path, full);
    if (is_spoiled(kind, full))
        return 1;
    errno = before;
    return 0;
}

static int spoils_file(enum kind kind, int file) {
    if (!control)
        return 0;
    int before = errno;
    char full[ROOM];
    if (path_of(file, full) > 0 && is_spoiled(kind, full))
        return 1;
    errno = before;
    return 0;
}

#define REAL(type, name, ...)                                     \
    static type (*real)(__VA_ARGS__);                             \
    if (!real) real = (type (*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

/* ---- reading and writing ------------------------------------------------------------------------------------ */

/* The spoilt transfer is shorter, or fails. */
#define TRANSFER(kind, file, size)                                \
    if (spoils_file(kind, file)) {                                \
        if (control->action == FAIL) return -1;                   \
        if (size > 1) size = size / 2;                            \
    }

#define MOVES(name, kind, pointer)                                \
    ssize_t name(int file, pointer data, size_t size) {           \
        REAL(ssize_t, #name, int, pointer, size_t);               \
        TRANSFER(kind, file, size)                                \
        return real(file, data, size);                            \
    }
MOVES(read, READ, void *)
MOVES(write, WRITE, const void *)

#define MOVES_AT(name, kind, pointer)                             \
    ssize_t name(int file, pointer data, size_t size, off_t place) { \
        REAL(ssize_t, #name, int, pointer, size_t, off_t);        \
        TRANSFER(kind, file, size)                                \
        return real(file, data, size, place);                     \
    }
MOVES_AT(pread, READ, void *)
MOVES_AT(pread64, READ, void *)
MOVES_AT(pwrite, WRITE, const void *)
MOVES_AT(pwrite64, WRITE, const void *)

#define MOVES_PARTS(name, kind)                                   \
    ssize_t name(int file, const struct iovec *parts, int number) { \
        REAL(ssize_t, #name, int, const struct iovec *, int);     \
        if (spoils_file(kind, file)) {                            \
            if (control->action == FAIL) return -1;               \
            if (number > 1) number = 1;                           \
        }                                                         \
        return real(file, parts, number);                         \
    }
MOVES_PARTS(readv, READ)
MOVES_PARTS(writev, WRITE)

ssize_t __read_chk(int file, void *data, size_t size, size_t room) {
    REAL(ssize_t, "__read_chk", int, void *, size_t, size_t);
    TRANSFER(READ, file, size)
    return real(file, data, size, room);
}

#define COPIES(name, offset)                                      \
    ssize_t name(int to, int from, offset *place, size_t size) {  \
        REAL(ssize_t, #name, int, int, offset *, size_t);         \
        TRANSFER(WRITE, to, size)                                 \
        return real(to, from, place, size);                       \
    }
COPIES(sendfile, off_t)
COPIES(sendfile64, off64_t)

ssize_t copy_file_range(int from, off64_t *from_place, int to, off64_t *to_place, size_t size, unsigned flags) {
    REAL(ssize_t, "copy_file_range", int, off64_t *, int, off64_t *, size_t, unsigned);
    TRANSFER(WRITE, to, size)
    return real(from, from_place, to, to_place, size, flags);
}

size_t fread(void *data, size_t size, size_t number, FILE *file) {
    REAL(size_t, "fread", void *, size_t, size_t, FILE *);
    if (spoils_file(READ, fileno(file)))
        return control->action == FAIL ? 0 : real(data, size, number / 2, file);
    return real(data, size, number, file);
}

size_t fwrite(const void *data, size_t size, size_t number, FILE *file) {
    REAL(size_t, "fwrite", const void *, size_t, size_t, FILE *);
    if (spoils_file(WRITE, fileno(file)))
        return control->action == FAIL ? 0 : real(data, size, number / 2, file);
    return real(data, size, number, file);
}

/* ---- opening and closing ------------------------------------------------------------------------------------ */

#define OPENS(name)                                               \
    int name(const char *path, int flags, ...) {                  \
        REAL(int, #name, const char *, int, ...);                 \
        va_list rest;                                             \
        va_start(rest, flags);                                    \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0; \
        va_end(rest);                                             \
        if (spoils_path(OPEN, AT_FDCWD, path) && control->action == FAIL) return -1; \
        return real(path, flags, mode);                           \
    }
OPENS(open)
OPENS(open64)

#define OPENS_AT(name)                                            \
    int name(int folder, const char *path, int flags, ...) {      \
        REAL(int, #name, int, const char *, int, ...);            \
        va_list rest;                                             \
        va_start(rest, flags);                                    \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0; \
        va_end(rest);                                             \
        if (spoils_path(OPEN, folder, path) && control->action == FAIL) return -1; \
        return real(folder, path, flags, mode);                   \
    }
OPENS_AT(openat)
OPENS_AT(openat64)

#define OPENS_STREAM(name)                                        \
    FILE *name(const char *path, const char *mode) {              \
        REAL(FILE *, #name, const char *, const char *);          \
        if (spoils_path(OPEN, AT_FDCWD, path) && control->action == FAIL) return NULL; \
        return real(path, mode);                                  \
    }
OPENS_STREAM(fopen)
OPENS_STREAM(fopen64)

/* A close that fails has closed all the same, as on Linux. */
int close(int file) {
    REAL(int, "close", int);
    int fails = spoils_file(CLOSE, file) && control->action == FAIL;
    int result = real(file);
    if (fails)
        errno = control->value;
    return fails ? -1 : result;
}

int fclose(FILE *file) {
    REAL(int, "fclose", FILE *);
    int fails = spoils_file(CLOSE, fileno(file)) && control->action == FAIL;
    int result = real(file);
    if (fails)
        errno = control->value;
    return fails ? EOF : result;
}

/* ---- one file or path --------------------------------------------------------------------------------------- */

#define ON_FILE(name, kind)                                       \
    int name(int file) {                                          \
        REAL(int, #name, int);                                    \
        return spoils_file(kind, file) && control->action == FAIL ? -1 : real(file); \
    }
ON_FILE(fsync, SYNC)
ON_FILE(fdatasync, SYNC)
ON_FILE(syncfs, SYNC)

#define ON_PATH(name, kind)                                       \
    int name(const char *path) {                                  \
        REAL(int, #name, const char *);                           \
        return spoils_path(kind, AT_FDCWD, path) && control->action == FAIL ? -1 : real(path); \
    }
ON_PATH(unlink, REMOVE)
ON_PATH(rmdir, REMOVE)
ON_PATH(remove, REMOVE)

int unlinkat(int folder, const char *path, int flags) {
    REAL(int, "unlinkat", int, const char *, int);
    return spoils_path(REMOVE, folder, path) && control->action == FAIL ? -1 : real(folder, path, flags);
}

int mkdir(const char *path, mode_t mode) {
    REAL(int, "mkdir", const char *, mode_t);
    return spoils_path(MAKE, AT_FDCWD, path) && control->action == FAIL ? -1 : real(path, mode);
}

int mkdirat(int folder, const char *path, mode_t mode) {
    REAL(int, "mkdirat", int, const char *, mode_t);
    return spoils_path(MAKE, folder, path) && control->action == FAIL ? -1 : real(folder, path, mode);
}

#define TWO_PATHS(name, kind)                                     \
    int name(const char *from, const char *to) {                  \
        REAL(int, #name, const char *, const char *);             \
        return spoils_path(kind, AT_FDCWD, to) && control->action == FAIL ? -1 : real(from, to); \
    }
TWO_PATHS(rename, RENAME)
TWO_PATHS(link, MAKE)
TWO_PATHS(symlink, MAKE)

int renameat(int from_folder, const char *from, int to_folder, const char *to) {
    REAL(int, "renameat", int, const char *, int, const char *);
    if (spoils_path(RENAME, to_folder, to) && control->action == FAIL)
        return -1;
    return real(from_folder, from, to_folder, to);
}

int renameat2(int from_folder, const char *from, int to_folder, const char *to, unsigned flags) {
    REAL(int, "renameat2", int, const char *, int, const char *, unsigned);
    if (spoils_path(RENAME, to_folder, to) && control->action == FAIL)
        return -1;
    return real(from_folder, from, to_folder, to, flags);
}

int linkat(int from_folder, const char *from, int to_folder, const char *to, int flags) {
    REAL(int, "linkat", int, const char *, int, const char *, int);
    if (spoils_path(MAKE, to_folder, to) && control->action == FAIL)
        return -1;
    return real(from_folder, from, to_folder, to, flags);
}

int symlinkat(const char *from, int folder, const char *to) {
    REAL(int, "symlinkat", const char *, int, const char *);
    return spoils_path(MAKE, folder, to) && control->action == FAIL ? -1 : real(from, folder, to);
}

#define RESIZES(name)                                             \
    int name(int file, off_t size) {                              \
        REAL(int, #name, int, off_t);                             \
        return spoils_file(RESIZE, file) && control->action == FAIL ? -1 : real(file, size); \
    }
RESIZES(ftruncate)
RESIZES(ftruncate64)

/* Tells its error as its result. */
#define ALLOCATES(name)                                           \
    int name(int file, off_t place, off_t size) {                 \
        REAL(int, #name, int, off_t, off_t);                      \
        return spoils_file(RESIZE, file) && control->action == FAIL ? control->value : real(file, place, size); \
    }
ALLOCATES(posix_fallocate)
ALLOCATES(posix_fallocate64)

#define MAPS(name)                                                \
    void *name(void *wish, size_t size, int protection, int flags, int file, off_t place) { \
        REAL(void *, #name, void *, size_t, int, int, int, off_t); \
        if (file >= 0 && spoils_file(MAP, file) && control->action == FAIL) return MAP_FAILED; \
        return real(wish, size, protection, flags, file, place);  \
    }
MAPS(mmap)
MAPS(mmap64)

DIR *opendir(const char *path) {
    REAL(DIR *, "opendir", const char *);
    return spoils_path(LIST, AT_FDCWD, path) && control->action == FAIL ? NULL : real(path);
}

DIR *fdopendir(int file) {
    REAL(DIR *, "fdopendir", int);
    return spoils_file(LIST, file) && control->action == FAIL ? NULL : real(file);
}
