// Preloaded library: logs every change of a file under $SHIM_DIR with its content, in order, into
// $SHIM_LOG, and makes calls fail: SHIM_FAIL=call:errno:first[:last] counts the calls named so. While
// the file $SHIM_TROUBLE holds an error number, everything that this error can strike fails with it.
//
// A log entry: kind (1 byte), lengths of two paths (2 x uint16), offset (int64), size (uint32), the
// paths, the content. Kinds: O created, T truncated to nothing, W written, S set to a size, F
// fsynced, R renamed, L linked, U unlinked.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

#define MAX_FD 4096
#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static char *paths[MAX_FD];
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static const char *watched, *failing, *trouble;
static int log_fd = -1, fail_errno, fail_first, fail_last, n_calls;

__attribute__((constructor)) static void start(void) {
    watched = getenv("SHIM_DIR");
    trouble = getenv("SHIM_TROUBLE");
    const char *log = getenv("SHIM_LOG"), *fail = getenv("SHIM_FAIL");
    if (log) {
        int fd = REAL(open)(log, O_WRONLY | O_CREAT | O_APPEND, 0644);
        log_fd = fcntl(fd, F_DUPFD_CLOEXEC, 900);
        REAL(close)(fd);
    }
    if (fail) {
        static char call[32];
        int n = sscanf(fail, "%31[a-z]:%d:%d:%d", call, &fail_errno, &fail_first, &fail_last);
        if (n == 3) fail_last = fail_first;
        failing = call;
    }
}

static const char *path_of(int fd) { return fd >= 0 && fd < MAX_FD ? paths[fd] : NULL; }

static int troubled(int opens, int changes) {
    char text[8] = "";
    int fd = trouble ? REAL(open)(trouble, O_RDONLY | O_CLOEXEC) : -1, error = 0;
    if (fd >= 0) {
        if (REAL(read)(fd, text, 7) > 0) error = atoi(text);
        REAL(close)(fd);
    }
    if (!error || (error == EMFILE ? !opens : !changes)) return 0;
    errno = error;
    return 1;
}

static int fails(const char *call) {
    if (troubled(0, 1)) return 1;
    if (!failing || strcmp(call, failing)) return 0;
    int n = __sync_add_and_fetch(&n_calls, 1);
    if (n < fail_first || n > fail_last) return 0;
    errno = fail_errno;
    return 1;
}

static void record(char kind, const char *a, const char *b, int64_t at, const void *data, uint32_t n) {
    if (log_fd < 0) return;
    int kept = errno;
    uint16_t la = a ? strlen(a) : 0, lb = b ? strlen(b) : 0;
    struct iovec parts[] = {{&kind, 1}, {&la, 2}, {&lb, 2}, {&at, 8}, {&n, 4},
                            {(void *)a, la}, {(void *)b, lb}, {(void *)data, n}};
    // In one call: several processes append to one log.
    if (writev(log_fd, parts, 8) != 17 + la + lb + (ssize_t)n) abort();
    errno = kept;
}

static int is_watched(const char *path) {
    return watched && path && !strncmp(path, watched, strlen(watched));
}

static void opened(int fd, const char *path, int flags) {
    if (fd < 0 || fd >= MAX_FD) return;
    pthread_mutex_lock(&lock);
    free(paths[fd]);
    paths[fd] = is_watched(path) ? strdup(path) : NULL;
    if (paths[fd] && (flags & (O_TRUNC | O_CREAT)))
        record(flags & O_TRUNC ? 'T' : 'O', path, NULL, 0, NULL, 0);
    pthread_mutex_unlock(&lock);
}

#define MODE(mode)                                                                                 \
    mode_t mode = 0;                                                                               \
    if (flags & (O_CREAT | O_TMPFILE)) {                                                           \
        va_list rest;                                                                              \
        va_start(rest, flags);                                                                     \
        mode = (mode_t)va_arg(rest, int);                                                          \
        va_end(rest);                                                                              \
    }
#define OPEN(name)                                                                                 \
    int name(const char *path, int flags, ...) {                                                   \
        MODE(mode)                                                                                 \
        if (is_watched(path) && troubled(1, (flags & O_ACCMODE) != O_RDONLY)) return -1;           \
        int fd = REAL(name)(path, flags, mode);                                                    \
        opened(fd, path, flags);                                                                   \
        return fd;                                                                                 \
    }
OPEN(open)
OPEN(open64)
#define OPENAT(name)                                                                               \
    int name(int dir, const char *path, int flags, ...) {                                          \
        MODE(mode)                                                                                 \
        if (is_watched(path) && troubled(1, (flags & O_ACCMODE) != O_RDONLY)) return -1;           \
        int fd = REAL(name)(dir, path, flags, mode);                                               \
        opened(fd, path, flags);                                                                   \
        return fd;                                                                                 \
    }
OPENAT(openat)
OPENAT(openat64)

int close(int fd) {
    if (path_of(fd)) {
        pthread_mutex_lock(&lock);
        free(paths[fd]);
        paths[fd] = NULL;
        pthread_mutex_unlock(&lock);
    }
    return REAL(close)(fd);
}

#define PWRITE(name)                                                                               \
    ssize_t name(int fd, const void *data, size_t n, off_t at) {                                   \
        const char *path = path_of(fd);                                                            \
        if (!path) return REAL(name)(fd, data, n, at);                                             \
        if (fails("pwrite")) return -1;                                                            \
        pthread_mutex_lock(&lock);                                                                 \
        ssize_t written = REAL(name)(fd, data, n, at);                                             \
        if (written > 0) record('W', path, NULL, at, data, (uint32_t)written);                     \
        pthread_mutex_unlock(&lock);                                                               \
        return written;                                                                            \
    }
PWRITE(pwrite)
PWRITE(pwrite64)

ssize_t write(int fd, const void *data, size_t n) {
    const char *path = path_of(fd);
    if (!path) return REAL(write)(fd, data, n);
    if (fails("write")) return -1;
    pthread_mutex_lock(&lock);
    ssize_t written = REAL(write)(fd, data, n);
    if (written > 0) record('W', path, NULL, lseek(fd, 0, SEEK_CUR) - written, data, (uint32_t)written);
    pthread_mutex_unlock(&lock);
    return written;
}

// Copies are refused: the caller then reads and writes.
#define SENDFILE(name)                                                                             \
    ssize_t name(int out, int in, off_t *at, size_t n) {                                           \
        if (!path_of(out)) return REAL(name)(out, in, at, n);                                      \
        errno = EINVAL;                                                                            \
        return -1;                                                                                 \
    }
SENDFILE(sendfile)
SENDFILE(sendfile64)

#define FTRUNCATE(name)                                                                            \
    int name(int fd, off_t size) {                                                                 \
        const char *path = path_of(fd);                                                            \
        if (!path) return REAL(name)(fd, size);                                                    \
        if (fails("ftruncate")) return -1;                                                         \
        pthread_mutex_lock(&lock);                                                                 \
        int result = REAL(name)(fd, size);                                                         \
        if (!result) record('S', path, NULL, size, NULL, 0);                                       \
        pthread_mutex_unlock(&lock);                                                               \
        return result;                                                                             \
    }
FTRUNCATE(ftruncate)
FTRUNCATE(ftruncate64)

#define FSYNC(name)                                                                                \
    int name(int fd) {                                                                             \
        const char *path = path_of(fd);                                                            \
        if (!path) return REAL(name)(fd);                                                          \
        if (fails("fsync")) return -1;                                                             \
        int result = REAL(name)(fd);                                                               \
        pthread_mutex_lock(&lock);                                                                 \
        if (!result) record('F', path, NULL, 0, NULL, 0);                                          \
        pthread_mutex_unlock(&lock);                                                               \
        return result;                                                                             \
    }
FSYNC(fsync)
FSYNC(fdatasync)

static void renamed(char kind, const char *from, const char *to) {
    pthread_mutex_lock(&lock);
    record(kind, from, to, 0, NULL, 0);
    for (int fd = 0; kind != 'U' && fd < MAX_FD; fd++)
        if (paths[fd] && !strcmp(paths[fd], from)) {
            free(paths[fd]);
            paths[fd] = strdup(to);
        }
    pthread_mutex_unlock(&lock);
}

int rename(const char *from, const char *to) {
    if (is_watched(to) && troubled(0, 1)) return -1;
    int result = REAL(rename)(from, to);
    if (!result && is_watched(to)) renamed('R', from, to);
    return result;
}

int link(const char *from, const char *to) {
    if (is_watched(to) && troubled(0, 1)) return -1;
    int result = REAL(link)(from, to);
    if (!result && is_watched(to)) renamed('L', from, to);
    return result;
}

int linkat(int from_dir, const char *from, int to_dir, const char *to, int flags) {
    int result = REAL(linkat)(from_dir, from, to_dir, to, flags);
    if (!result && is_watched(to)) renamed('L', from, to);
    return result;
}

int unlink(const char *path) {
    if (is_watched(path) && troubled(0, 1) && errno != ENOSPC) return -1;
    int result = REAL(unlink)(path);
    if (!result && is_watched(path)) renamed('U', path, NULL);
    return result;
}
