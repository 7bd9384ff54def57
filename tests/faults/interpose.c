/* Storage calls that fail, or that a process does not survive: loaded before the C library (LD_PRELOAD).

   Calls on files below one folder are counted. The one with a chosen number is the fault: the process is killed before,
   inside or after it, or it fails with an error, once or from then on. Without a plan everything goes through. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

enum kind { OPEN_READ, OPEN_WRITE, READ, WRITE, SYNC, RENAME, UNLINK, TRUNCATE, MKDIR, CHMOD, LOCK, SET_LOCK, CLOSE, MAP, KINDS };
enum how { NOTHING, KILL_BEFORE, KILL_INSIDE, KILL_AFTER, FAIL_ONCE, FAIL_ALWAYS, SHORT, FULL, READ_ONLY };
enum { MOST_FILES = 65536, MOST_CALLS = 1 << 20, HALF = -1 };

static char folder[PATH_MAX];
static size_t length;
static unsigned char ours[MOST_FILES], kinds[MOST_CALLS];
static long number, at, room;
static int how, code, failing;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

void fault_arm(const char *path, int what, long when, int error) {
    length = strlen(path);
    memcpy(folder, path, length + 1);
    number = 0, failing = -1, how = what, at = room = when, code = error;
}

void fault_disarm(void) { length = 0; }
long fault_calls(void) { return number; }
int fault_kind(long call) { return kinds[call]; }

static int below(const char *path) {
    return length && path && !strncmp(path, folder, length) && (path[length] == '/' || !path[length]);
}

static int is_ours(int file) { return length && file >= 0 && file < MOST_FILES && ours[file]; }

static void die(void) { kill(getpid(), SIGKILL); }

/* 0 to go on, HALF to do half of it, else the error; size is of what is to be written. */
static int before(enum kind kind, size_t size) {
    int writes = kind == OPEN_WRITE || (kind >= WRITE && kind <= CHMOD && kind != SYNC);
    if (++number < MOST_CALLS) kinds[number] = kind;
    if (how == FULL && (kind == WRITE || kind == MKDIR)) return (room -= size) < 0 ? ENOSPC : 0;
    if (how == READ_ONLY && number >= at && writes) return EROFS;
    if (how == FAIL_ALWAYS && failing == kind) return code;
    if (number != at) return 0;
    switch (how) {
    case KILL_BEFORE: die(); break;
    case KILL_INSIDE: case SHORT: return kind == WRITE ? HALF : 0;
    case FAIL_ALWAYS: failing = kind; return code;
    case FAIL_ONCE: return code;
    }
    return 0;
}

static void after(void) {
    if (how == KILL_AFTER && number == at) die();
}

#define GUARDED(kind, size, call)                        \
    do {                                                 \
        int error = before(kind, size);                  \
        if (error > 0) { errno = error; return -1; }     \
        __typeof__(call) answer = call;                  \
        int seen = errno;                                \
        after();                                         \
        errno = seen;                                    \
        return answer;                                   \
    } while (0)

#define OPENS(name, real_call)                                                          \
    int error = below(path) ? before(flags & (O_WRONLY | O_RDWR | O_CREAT) ? OPEN_WRITE : OPEN_READ, 0) : 0; \
    if (error > 0) { errno = error; return -1; }                                        \
    int file = real_call;                                                               \
    if (file >= 0 && file < MOST_FILES) ours[file] = below(path);                       \
    if (below(path)) { int seen = errno; after(); errno = seen; }                       \
    return file;

#define MODE mode_t mode = 0; if (flags & (O_CREAT | O_TMPFILE)) { va_list rest; va_start(rest, flags); mode = va_arg(rest, mode_t); va_end(rest); }

int open(const char *path, int flags, ...) { MODE OPENS(open, REAL(open)(path, flags, mode)) }
int open64(const char *path, int flags, ...) { MODE OPENS(open64, REAL(open64)(path, flags, mode)) }
int openat(int where, const char *path, int flags, ...) { MODE OPENS(openat, REAL(openat)(where, path, flags, mode)) }
int openat64(int where, const char *path, int flags, ...) { MODE OPENS(openat64, REAL(openat64)(where, path, flags, mode)) }

int close(int file) {
    static __typeof__(&close) real;
    if (!real) real = REAL(close);
    if (!is_ours(file)) return real(file);
    ours[file] = 0;
    int error = before(CLOSE, 0), answer = real(file);
    if (error > 0) { errno = error; return -1; }
    after();
    return answer;
}

ssize_t read(int file, void *data, size_t size) {
    static __typeof__(&read) real;
    if (!real) real = REAL(read);
    if (!is_ours(file)) return real(file, data, size);
    GUARDED(READ, 0, real(file, data, size));
}

#define READS(name, offset_type)                                                \
    ssize_t name(int file, void *data, size_t size, offset_type place) {        \
        if (!is_ours(file)) return REAL(name)(file, data, size, place);         \
        GUARDED(READ, 0, REAL(name)(file, data, size, place));                  \
    }
READS(pread, off_t)
READS(pread64, off64_t)

#define WRITES(declaration, real_call, half_call)                        \
    declaration {                                                        \
        if (!is_ours(file)) return real_call;                            \
        int error = before(WRITE, size);                                 \
        if (error == HALF) {                                             \
            ssize_t half = size / 2 ? half_call : real_call;             \
            if (how == KILL_INSIDE) die();                               \
            return half;                                                 \
        }                                                                \
        if (error > 0) { errno = error; return -1; }                     \
        ssize_t answer = real_call;                                      \
        int seen = errno;                                                \
        after();                                                         \
        errno = seen;                                                    \
        return answer;                                                   \
    }
WRITES(ssize_t write(int file, const void *data, size_t size), REAL(write)(file, data, size), REAL(write)(file, data, size / 2))
WRITES(ssize_t pwrite(int file, const void *data, size_t size, off_t place), REAL(pwrite)(file, data, size, place), REAL(pwrite)(file, data, size / 2, place))
WRITES(ssize_t pwrite64(int file, const void *data, size_t size, off64_t place), REAL(pwrite64)(file, data, size, place), REAL(pwrite64)(file, data, size / 2, place))

int fsync(int file) { if (!is_ours(file)) return REAL(fsync)(file); GUARDED(SYNC, 0, REAL(fsync)(file)); }
int fdatasync(int file) { if (!is_ours(file)) return REAL(fdatasync)(file); GUARDED(SYNC, 0, REAL(fdatasync)(file)); }
int ftruncate(int file, off_t size) { if (!is_ours(file)) return REAL(ftruncate)(file, size); GUARDED(TRUNCATE, 0, REAL(ftruncate)(file, size)); }
int ftruncate64(int file, off64_t size) { if (!is_ours(file)) return REAL(ftruncate64)(file, size); GUARDED(TRUNCATE, 0, REAL(ftruncate64)(file, size)); }
int flock(int file, int operation) { if (!is_ours(file)) return REAL(flock)(file, operation); GUARDED(LOCK, 0, REAL(flock)(file, operation)); }
int fchmod(int file, mode_t mode) { if (!is_ours(file)) return REAL(fchmod)(file, mode); GUARDED(CHMOD, 0, REAL(fchmod)(file, mode)); }

int rename(const char *from, const char *to) { if (!below(from) && !below(to)) return REAL(rename)(from, to); GUARDED(RENAME, 0, REAL(rename)(from, to)); }
int unlink(const char *path) { if (!below(path)) return REAL(unlink)(path); GUARDED(UNLINK, 0, REAL(unlink)(path)); }
int mkdir(const char *path, mode_t mode) { if (!below(path)) return REAL(mkdir)(path, mode); GUARDED(MKDIR, 4096, REAL(mkdir)(path, mode)); }
int chmod(const char *path, mode_t mode) { if (!below(path)) return REAL(chmod)(path, mode); GUARDED(CHMOD, 0, REAL(chmod)(path, mode)); }

#define LOCKS(name)                                                                          \
    int name(int file, int command, ...) {                                                   \
        va_list rest;                                                                        \
        va_start(rest, command);                                                             \
        void *given = va_arg(rest, void *);                                                  \
        va_end(rest);                                                                        \
        if (!is_ours(file) || command != F_SETLK) return REAL(name)(file, command, given);   \
        GUARDED(SET_LOCK, 0, REAL(name)(file, command, given));                              \
    }
LOCKS(fcntl)
LOCKS(fcntl64)

#define MAPS(name, offset_type)                                                                        \
    void *name(void *address, size_t size, int protection, int flags, int file, offset_type place) {   \
        int error = is_ours(file) ? before(MAP, 0) : 0;                                                \
        if (error > 0) { errno = error; return MAP_FAILED; }                                           \
        void *answer = REAL(name)(address, size, protection, flags, file, place);                      \
        if (is_ours(file)) after();                                                                    \
        return answer;                                                                                 \
    }
MAPS(mmap, off_t)
MAPS(mmap64, off64_t)
