/* A system clock that a test sets, for one process and its children.
 *
 * Loaded with LD_PRELOAD. CLOCK_REALTIME is shifted by the number of nanoseconds in the first eight bytes of the file
 * that SET_CLOCK names; the monotonic clock is not. A wait until a time of the system clock ends when the *shifted*
 * clock reaches it, as in the kernel: after the clock was set back, it lasts as much longer.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static const long long SECOND = 1000000000LL;
static const long long SLICE = 50000000LL; /* [ns]; between two looks at the clock */
static volatile long long none = 0;
static volatile long long *shift = &none;

__attribute__((constructor)) static void map_shift(void) {
  const char *path = getenv("SET_CLOCK");
  int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
  if (file < 0) return;
  void *place = mmap(NULL, sizeof(long long), PROT_READ, MAP_SHARED, file, 0);
  if (place != MAP_FAILED) shift = place;
  close(file);
}

static long long true_now(void) {
  struct timespec now;
  syscall(SYS_clock_gettime, CLOCK_REALTIME, &now);
  return now.tv_sec * SECOND + now.tv_nsec;
}

static struct timespec to_timespec(long long nanoseconds) {
  struct timespec found = {nanoseconds / SECOND, nanoseconds % SECOND};
  return found;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
  if (clock != CLOCK_REALTIME && clock != CLOCK_REALTIME_COARSE) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    return real(clock, now);
  }
  *now = to_timespec(true_now() + *shift);
  return 0;
}

int gettimeofday(struct timeval *now, void *zone) {
  (void)zone;
  long long time = true_now() + *shift;
  now->tv_sec = time / SECOND;
  now->tv_usec = time % SECOND / 1000;
  return 0;
}

time_t time(time_t *now) {
  time_t found = (true_now() + *shift) / SECOND;
  if (now) *now = found;
  return found;
}

int timespec_get(struct timespec *now, int base) {
  return base == TIME_UTC && clock_gettime(CLOCK_REALTIME, now) == 0 ? base : 0;
}

/* Whether a deadline is one of the system clock, of today; the other clock counts from the start of the machine. */
static int is_system_time(const struct timespec *deadline) { return deadline->tv_sec > 1000000000; }

/* Waits with `wait` until the shifted clock reaches `deadline`; after a step back, it looks again in slices. */
#define WAIT_UNTIL(deadline, wait)                                      \
  long long due = (deadline)->tv_sec * SECOND + (deadline)->tv_nsec;    \
  long long until = is_system_time(deadline) ? due - *shift : due;      \
  for (;;) {                                                            \
    struct timespec slice = to_timespec(until);                         \
    int code = wait;                                                    \
    if (code != ETIMEDOUT || true_now() + *shift >= due) return code;   \
    until = true_now() + SLICE;                                         \
  }

int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex, const struct timespec *deadline) {
  static int (*real)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);
  if (!real) real = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
  if (!real) real = dlsym(RTLD_NEXT, "pthread_cond_timedwait");
  WAIT_UNTIL(deadline, real(condition, mutex, &slice))
}

int pthread_mutex_timedlock(pthread_mutex_t *mutex, const struct timespec *deadline) {
  static int (*real)(pthread_mutex_t *, const struct timespec *);
  if (!real) real = dlsym(RTLD_NEXT, "pthread_mutex_timedlock");
  WAIT_UNTIL(deadline, real(mutex, &slice))
}

static int sem_wait_until(int (*real)(sem_t *, const struct timespec *), sem_t *semaphore, const struct timespec *deadline) {
  WAIT_UNTIL(deadline, real(semaphore, &slice) ? errno : 0)
}

int sem_timedwait(sem_t *semaphore, const struct timespec *deadline) {
  static int (*real)(sem_t *, const struct timespec *);
  if (!real) real = dlsym(RTLD_NEXT, "sem_timedwait");
  int code = sem_wait_until(real, semaphore, deadline);
  if (code) errno = code;
  return code ? -1 : 0;
}
