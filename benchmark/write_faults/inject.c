// Lets the n-th call that changes files below a folder fail, write half, or be the last of its process; a process that
// is killed before a write has written half.
// Loaded by LD_PRELOAD, so that it meets the calls of every library: Python's, sqlite's, and renameat2 by ctypes.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { FAIL, SHORT, KILL_BEFORE, KILL_AFTER };

static char folder[PATH_MAX];
static int target, count, kind, number, lasting, no_exchange;

void inject_arm(const char *path, int nth, int what, int error, int lasts, int exchange) {
    snprintf(folder, sizeof folder, "%s", path);
    target = nth, count = 0, kind = what, number = error, lasting = lasts, no_exchange = !exchange;
}

int inject_count(void) { return count; }

static int below(const char *path) {
    size_t length = strlen(folder);
    char full[PATH_MAX];
    if (!length || !path) return 0;
    if (path[0] != '/') {
        if (!getcwd(full, sizeof full - 1)) return 0;
        strncat(full, "/", sizeof full - strlen(full) - 1);
        strncat(full, path, sizeof full - strlen(full) - 1);
        path = full;
    }
    return !strncmp(path, folder, length) && (path[length] == '/' || !path[length]);
}

static int of_descriptor(int descriptor) {
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    ssize_t length = *folder ? readlink(link, path, sizeof path - 1) : -1;
    if (length < 0) return 0;
    path[length] = 0;
    return below(path);
}

static int at(int directory, const char *path) {
    if (path && path[0] == '/') return below(path);
    return directory == AT_FDCWD ? below(path) : of_descriptor(directory);
}

// Whether this call is the one; a disk that is full stays so for all that takes room.
static int chosen(int watched, int takes_room) {
    if (!watched) return 0;
    count++;
    return target && (count == target || (lasting && kind == FAIL && takes_room && count > target));
}

#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define AFTER(call) ({ __typeof__(call) answer = (call); if (one && kind == KILL_AFTER) _exit(137); answer; })
#define CALL(watched, room, call)                                                     \
    int one = chosen(watched, room);                                                  \
    if (one && kind == KILL_BEFORE) _exit(137);                                       \
    if (one && kind == FAIL) { errno = number; return -1; }                           \
    return AFTER(call)
#define WRITES(flags) ((flags) & (O_CREAT | O_WRONLY | O_RDWR | O_TRUNC))
#define MODE mode_t mode = 0; if (flags & (O_CREAT | O_TMPFILE)) { va_list list; va_start(list, flags); mode = va_arg(list, mode_t); va_end(list); }

int open(const char *path, int flags, ...) { MODE CALL(WRITES(flags) && below(path), flags & O_CREAT, NEXT(open)(path, flags, mode)); }
int open64(const char *path, int flags, ...) { MODE CALL(WRITES(flags) && below(path), flags & O_CREAT, NEXT(open64)(path, flags, mode)); }
int openat(int directory, const char *path, int flags, ...) { MODE CALL(WRITES(flags) && at(directory, path), flags & O_CREAT, NEXT(openat)(directory, path, flags, mode)); }
int openat64(int directory, const char *path, int flags, ...) { MODE CALL(WRITES(flags) && at(directory, path), flags & O_CREAT, NEXT(openat64)(directory, path, flags, mode)); }

#define WRITE(size, half, whole)                                                 \
    int one = chosen(of_descriptor(descriptor), 1);                              \
    if (one && kind == FAIL) { errno = number; return -1; }                      \
    if (one && kind == SHORT && (size) > 1) return half;                         \
    if (one && kind == KILL_BEFORE) { __typeof__(half) part = (half); _exit(137 + 0 * (int)part); } \
    return AFTER(whole)
ssize_t write(int descriptor, const void *from, size_t size) { WRITE(size, NEXT(write)(descriptor, from, size / 2), NEXT(write)(descriptor, from, size)); }
ssize_t pwrite(int descriptor, const void *from, size_t size, off_t place) { WRITE(size, NEXT(pwrite)(descriptor, from, size / 2, place), NEXT(pwrite)(descriptor, from, size, place)); }
ssize_t pwrite64(int descriptor, const void *from, size_t size, off64_t place) { WRITE(size, NEXT(pwrite64)(descriptor, from, size / 2, place), NEXT(pwrite64)(descriptor, from, size, place)); }

int fsync(int descriptor) { CALL(of_descriptor(descriptor), 1, NEXT(fsync)(descriptor)); }
int fdatasync(int descriptor) { CALL(of_descriptor(descriptor), 1, NEXT(fdatasync)(descriptor)); }
int ftruncate(int descriptor, off_t size) { CALL(of_descriptor(descriptor), 0, NEXT(ftruncate)(descriptor, size)); }
int ftruncate64(int descriptor, off64_t size) { CALL(of_descriptor(descriptor), 0, NEXT(ftruncate64)(descriptor, size)); }
int rename(const char *from, const char *to) { CALL(below(to), 0, NEXT(rename)(from, to)); }
int renameat(int a, const char *from, int b, const char *to) { CALL(at(b, to), 0, NEXT(renameat)(a, from, b, to)); }
int renameat2(int a, const char *from, int b, const char *to, unsigned flags) {
    if (no_exchange && flags && at(b, to)) { errno = EINVAL; return -1; }
    CALL(at(b, to), 0, NEXT(renameat2)(a, from, b, to, flags));
}
int mkdir(const char *path, mode_t mode) { CALL(below(path), 1, NEXT(mkdir)(path, mode)); }
int mkdirat(int directory, const char *path, mode_t mode) { CALL(at(directory, path), 1, NEXT(mkdirat)(directory, path, mode)); }
int unlink(const char *path) { CALL(below(path), 0, NEXT(unlink)(path)); }
int unlinkat(int directory, const char *path, int flags) { CALL(at(directory, path), 0, NEXT(unlinkat)(directory, path, flags)); }
int rmdir(const char *path) { CALL(below(path), 0, NEXT(rmdir)(path)); }
int link(const char *from, const char *to) { CALL(below(to), 1, NEXT(link)(from, to)); }
int symlink(const char *from, const char *to) { CALL(below(to), 1, NEXT(symlink)(from, to)); }
