/* Fails, or kills the process at, a chosen libc call that changes files.
 *
 * Loaded with LD_PRELOAD, so that the program under test, its libraries and the interpreter are
 * unmodified. Only calls on paths below `under` are counted. Inactive until a forked child calls
 * faults_arm().
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

static char under[PATH_MAX];
static char beside[PATH_MAX];
static char only[128];
static long at = -1;
static int action;
static int persist;
static long shift;
static atomic_long seen;

/* Let `n` calls pass, then kill (act = 0) or fail with errno `act`, once or from then on. `calls`
 * names the calls that count, between commas; empty for all. Calls below `spared` do not count, unless
 * it is empty. The time of day is moved by `seconds`. */
void faults_arm(const char *path, long n, int act, int from_then_on, const char *calls,
                const char *spared, long seconds)
{
    snprintf(under, sizeof under, "%s", path);
    snprintf(beside, sizeof beside, "%s", spared);
    snprintf(only, sizeof only, "%s", calls);
    at = n;
    action = act;
    persist = from_then_on;
    shift = seconds;
    atomic_store(&seen, 0);
}

/* For processes that nobody can arm: IRL_FAULTS="CALL ERRNO PATH" fails each such call below PATH. */
__attribute__((constructor)) static void arm_from_environment(void)
{
    const char *text = getenv("IRL_FAULTS");
    char call[64], path[PATH_MAX], calls[70];
    int number;
    if (text == NULL || sscanf(text, "%63s %d %4095s", call, &number, path) != 3) return;
    snprintf(calls, sizeof calls, ",%s,", call);
    faults_arm(path, 0, number, 1, calls, "", 0);
}

long faults_seen(void) { return atomic_load(&seen); }

static int begins(const char *path, const char *with)
{
    size_t length = strlen(with);
    return length > 0 && strncmp(path, with, length) == 0;
}

static int below(const char *path)
{
    return path != NULL && begins(path, under) && !begins(path, beside);
}

static int below_fd(int fd)
{
    char link[64], path[PATH_MAX];
    ssize_t length;
    if (under[0] == '\0') return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = '\0';
    return below(path);
}

static int below_at(int dir, const char *path)
{
    return path != NULL && (path[0] == '/' || dir == AT_FDCWD) ? below(path) : below_fd(dir);
}

static int counts(const char *call)
{
    char wanted[64];
    if (only[0] == '\0') return 1;
    snprintf(wanted, sizeof wanted, ",%s,", call);
    return strstr(only, wanted) != NULL;
}

/* 1 if the call must fail now. */
static int due(const char *call)
{
    long number;
    if (!counts(call)) return 0;
    number = atomic_fetch_add(&seen, 1);
    return at >= 0 && (number == at || (persist && number > at));
}

static int refuse(void)
{
    if (action == 0) raise(SIGKILL);
    errno = action;
    return -1;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define CALL(type, name, place, parameters, arguments)              \
    type name parameters                                            \
    {                                                               \
        if (place && due(#name)) return refuse();                   \
        return REAL(name) arguments;                                \
    }

CALL(int, fsync, below_fd(fd), (int fd), (fd))
CALL(int, fdatasync, below_fd(fd), (int fd), (fd))
CALL(int, flock, below_fd(fd), (int fd, int operation), (fd, operation))
CALL(int, ftruncate, below_fd(fd), (int fd, off_t n), (fd, n))
CALL(int, rename, below(b), (const char *a, const char *b), (a, b))
CALL(int, link, below(b), (const char *a, const char *b), (a, b))
CALL(int, unlink, below(a), (const char *a), (a))
CALL(int, rmdir, below(a), (const char *a), (a))
CALL(int, mkdir, below(a), (const char *a, mode_t m), (a, m))
CALL(int, chmod, below(a), (const char *a, mode_t m), (a, m))
CALL(int, unlinkat, below_at(d, a), (int d, const char *a, int f), (d, a, f))

int renameat(int d, const char *a, int e, const char *b)
{
    if (below_at(e, b) && due("rename")) return refuse();
    return REAL(renameat)(d, a, e, b);
}

int linkat(int d, const char *a, int e, const char *b, int f)
{
    if (below_at(e, b) && due("link")) return refuse();
    return REAL(linkat)(d, a, e, b, f);
}

/* A write that is killed, or finds the disk full, has often written a part. */
ssize_t write(int fd, const void *data, size_t size)
{
    if (below_fd(fd) && due("write")) {
        REAL(write)(fd, data, size / 2);
        return refuse();
    }
    return REAL(write)(fd, data, size);
}

#define OPEN(name)                                                                   \
    int name(const char *path, int flags, ...)                                       \
    {                                                                                \
        va_list rest;                                                                \
        mode_t mode;                                                                 \
        va_start(rest, flags);                                                       \
        mode = flags & O_CREAT ? va_arg(rest, mode_t) : 0;                           \
        va_end(rest);                                                                \
        if (flags & O_CREAT && below(path) && due("open")) return refuse();          \
        return REAL(name)(path, flags, mode);                                        \
    }
OPEN(open)
OPEN(open64)

int clock_gettime(clockid_t clock, struct timespec *now)
{
    int code = REAL(clock_gettime)(clock, now);
    if (code == 0 && clock == CLOCK_REALTIME) now->tv_sec += shift;
    return code;
}
