// Preloaded library: makes calls that change files below $FAULT_DIR fail. The file $FAULT_CONTROL,
// which all processes share, says which: `struct control`. A call is counted whether it fails or not.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

#define KINDS 65536
#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static struct control {
    int count, first, last, error;
    char kinds[KINDS]; // w write, t truncate, s fsync, n name, c close
} *control;
static const char *folder;

__attribute__((constructor)) static void start(void) {
    const char *path = getenv("FAULT_CONTROL");
    folder = getenv("FAULT_DIR");
    int fd = path && folder ? open(path, O_RDWR | O_CLOEXEC) : -1;
    if (fd < 0) return;
    void *found = mmap(NULL, sizeof *control, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (found != MAP_FAILED) control = found;
    REAL(close)(fd);
}

static int below(const char *path) { return control && !strncmp(path, folder, strlen(folder)); }

static int fails(const char *path, char kind) {
    if (!below(path)) return 0;
    int n = __sync_add_and_fetch(&control->count, 1);
    if (n < KINDS) control->kinds[n] = kind;
    if (n < control->first || n > control->last) return 0;
    if (control->error == ENOSPC && (kind == 's' || kind == 'c')) return 0; // these need no room
    errno = control->error;
    return 1;
}

static int fails_fd(int fd, char kind) {
    char link[64], path[PATH_MAX];
    if (!control) return 0;
    int kept = errno;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    errno = kept;
    if (n < 0) return 0;
    path[n] = 0;
    return fails(path, kind);
}

#define CALL(type, name, kind, fd, parameters, ...)                                                \
    type name parameters {                                                                         \
        if (fails_fd(fd, kind)) return -1;                                                         \
        return REAL(name)(__VA_ARGS__);                                                            \
    }
CALL(ssize_t, write, 'w', fd, (int fd, const void *data, size_t n), fd, data, n)
CALL(ssize_t, pwrite, 'w', fd, (int fd, const void *data, size_t n, off_t at), fd, data, n, at)
CALL(ssize_t, pwrite64, 'w', fd, (int fd, const void *data, size_t n, off_t at), fd, data, n, at)
CALL(ssize_t, writev, 'w', fd, (int fd, const struct iovec *data, int n), fd, data, n)
CALL(ssize_t, sendfile, 'w', out, (int out, int in, off_t *at, size_t n), out, in, at, n)
CALL(ssize_t, sendfile64, 'w', out, (int out, int in, off_t *at, size_t n), out, in, at, n)
CALL(ssize_t, copy_file_range, 'w', out,
     (int in, off_t *at, int out, off_t *to, size_t n, unsigned flags), in, at, out, to, n, flags)
CALL(int, ftruncate, 't', fd, (int fd, off_t size), fd, size)
CALL(int, ftruncate64, 't', fd, (int fd, off_t size), fd, size)
CALL(int, fsync, 's', fd, (int fd), fd)
CALL(int, fdatasync, 's', fd, (int fd), fd)

int close(int fd) {
    int flags = control ? fcntl(fd, F_GETFL) : -1;
    int failed = flags >= 0 && (flags & O_ACCMODE) != O_RDONLY && fails_fd(fd, 'c');
    int error = errno, result = REAL(close)(fd);
    if (!failed) return result;
    errno = error; // the file is closed, as on Linux
    return -1;
}

#define NAME(name, to, parameters, ...)                                                            \
    int name parameters {                                                                          \
        if (fails(to, 'n')) return -1;                                                             \
        return REAL(name)(__VA_ARGS__);                                                            \
    }
NAME(rename, to, (const char *from, const char *to), from, to)
NAME(renameat, to, (int a, const char *from, int b, const char *to), a, from, b, to)
NAME(link, to, (const char *from, const char *to), from, to)
NAME(linkat, to, (int a, const char *from, int b, const char *to, int flags), a, from, b, to, flags)
