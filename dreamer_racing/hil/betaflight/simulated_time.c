/* Simulated time for a firmware that was built for a computer: loaded before it (LD_PRELOAD), nothing of it is changed.

   By itself the firmware lives in real time: its loop reads a clock and sleeps, and its threads take packets as they come,
   so that what it answers depends on how busy the machine is. Here the clock stands still until a packet with the
   vehicle's state has come, then lets one step pass in the firmware's main thread, and says so to the port of the motors
   with a packet of its own, as it does when the boot is over. Nothing is read from the state's socket during a step, and none begins before what came in at
   other sockets has been taken. So a flight takes as long as it takes to compute, and is the same each time.

   Environment: FIRMWARE_STEP_NS of a step, 0: time is real; FIRMWARE_BOOT_NS that pass at the start, before any state, as fast as they can;
   FIRMWARE_PORTS, "9002=40001,9003=40002,...": where the firmware's ports are to be, all on the loopback; what it sends to
   other ports is dropped. */

#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { MOTOR_PORT = 9002, STATE_PORT = 9003, STATE_SIZE = 144, MOST_PORTS = 16, MOST_THREADS = 8 };
static const int64_t READING_NS = 100; /* that reading the clock takes, so that whoever waits by reading it gets on */
static const char DONE[] = "step";     /* 4 bytes: no packet of motors, which has 16 */

static int (*real_select)(int, fd_set *, fd_set *, fd_set *, struct timeval *);
static ssize_t (*real_recvfrom)(int, void *, size_t, int, struct sockaddr *, socklen_t *);
static ssize_t (*real_sendto)(int, const void *, size_t, int, const struct sockaddr *, socklen_t);
static int (*real_bind)(int, const struct sockaddr *, socklen_t);
static int (*real_listen)(int, int);
static int (*real_clock_gettime)(clockid_t, struct timespec *);
static int (*real_nanosleep)(const struct timespec *, struct timespec *);

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed = PTHREAD_COND_INITIALIZER;
static int64_t now_ns = 1000000000, granted_ns, step_ns; /* by the firmware's clock */
static bool main_waits;                                  /* it has used up what was granted */
static bool listens;                                     /* at its serial port */
static pthread_t main_thread;
static struct { int from, to; } ports[MOST_PORTS];
static int port_count, state_socket = -1;
static struct Listener { fd_set reads; int end; bool busy; } listeners[MOST_THREADS]; /* threads that select */
static int listener_count;
static _Thread_local int own = -1;          /* index of this thread's */
static _Thread_local bool booted;          /* and the thread of the state has said so */
static _Thread_local bool state_has_come;   /* and is taken in when this thread selects again */

static int64_t number(const char *name) {
    const char *text = getenv(name);
    if (text == NULL) {
        fprintf(stderr, "simulated time: %s is not set\n", name);
        exit(2);
    }
    return atoll(text);
}

__attribute__((constructor)) static void begin(void) {
    real_select = dlsym(RTLD_NEXT, "select");
    real_recvfrom = dlsym(RTLD_NEXT, "recvfrom");
    real_sendto = dlsym(RTLD_NEXT, "sendto");
    real_bind = dlsym(RTLD_NEXT, "bind");
    real_listen = dlsym(RTLD_NEXT, "listen");
    real_clock_gettime = dlsym(RTLD_NEXT, "clock_gettime");
    real_nanosleep = dlsym(RTLD_NEXT, "nanosleep");
    main_thread = pthread_self();
    step_ns = number("FIRMWARE_STEP_NS");
    granted_ns = now_ns + number("FIRMWARE_BOOT_NS");
    const char *text = getenv("FIRMWARE_PORTS");
    while (text != NULL && port_count < MOST_PORTS) {
        if (sscanf(text, "%d=%d", &ports[port_count].from, &ports[port_count].to) != 2) break;
        port_count++;
        text = strchr(text, ',');
        text = text == NULL ? NULL : text + 1;
    }
}

static int moved(int port) {
    for (int i = 0; i < port_count; i++)
        if (ports[i].from == port) return ports[i].to;
    return 0;
}

/* The clock */

int clock_gettime(clockid_t id, struct timespec *out) {
    if (id != CLOCK_MONOTONIC || step_ns == 0) return real_clock_gettime(id, out);
    pthread_mutex_lock(&lock);
    if (pthread_equal(pthread_self(), main_thread)) now_ns += READING_NS;
    out->tv_sec = now_ns / 1000000000;
    out->tv_nsec = now_ns % 1000000000;
    pthread_mutex_unlock(&lock);
    return 0;
}

int nanosleep(const struct timespec *wanted, struct timespec *left) {
    if (step_ns == 0 || !pthread_equal(pthread_self(), main_thread)) return real_nanosleep(wanted, left);
    pthread_mutex_lock(&lock);
    now_ns += (int64_t)wanted->tv_sec * 1000000000 + wanted->tv_nsec;
    while (now_ns > granted_ns) {
        main_waits = true;
        pthread_cond_broadcast(&changed);
        pthread_cond_wait(&changed, &lock);
    }
    main_waits = false;
    pthread_mutex_unlock(&lock);
    return 0;
}

/* Packets in: a thread that has taken one is busy until it selects again */

static bool anything_waits(void) {
    for (int i = 0; i < listener_count; i++) {
        if (i == own) continue;
        pthread_mutex_lock(&lock);
        struct Listener other = listeners[i];
        pthread_mutex_unlock(&lock);
        struct timeval at_once = {0, 0};
        if (other.busy || real_select(other.end, &other.reads, NULL, NULL, &at_once) > 0) return true;
    }
    return false;
}

static void say_done(void) {
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(moved(MOTOR_PORT))};
    to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    real_sendto(state_socket, DONE, sizeof DONE - 1, 0, (struct sockaddr *)&to, sizeof to);
}

static void let_a_step_pass(void) {
    while (anything_waits()) usleep(20);
    pthread_mutex_lock(&lock);
    while (!main_waits) pthread_cond_wait(&changed, &lock);
    main_waits = false;
    granted_ns += step_ns;
    pthread_cond_broadcast(&changed);
    while (!main_waits) pthread_cond_wait(&changed, &lock);
    pthread_mutex_unlock(&lock);
    say_done();
}

/* The thread of the serial port sweeps away sockets that are not open, and one that the main thread is about to open with
   them: such a firmware never answers. It has nothing to select from until then, and is held there. */
static void wait_for_serial_port(void) {
    pthread_mutex_lock(&lock);
    bool too_early = !listens;
    while (!listens) pthread_cond_wait(&changed, &lock);
    pthread_mutex_unlock(&lock);
    if (too_early) usleep(50000); /* in which the main thread notes that the socket is open */
}

int listen(int socket, int backlog) {
    int status = real_listen(socket, backlog);
    pthread_mutex_lock(&lock);
    listens = true;
    pthread_cond_broadcast(&changed);
    pthread_mutex_unlock(&lock);
    return status;
}

int select(int end, fd_set *reads, fd_set *writes, fd_set *errors, struct timeval *timeout) {
    if (reads == NULL && writes == NULL && !pthread_equal(pthread_self(), main_thread)) wait_for_serial_port();
    if (step_ns == 0 || reads == NULL || pthread_equal(pthread_self(), main_thread))
        return real_select(end, reads, writes, errors, timeout);
    if (own < 0 && listener_count < MOST_THREADS) {
        pthread_mutex_lock(&lock);
        own = listener_count++;
        pthread_mutex_unlock(&lock);
    }
    if (state_has_come) {
        state_has_come = false;
        let_a_step_pass();
    }
    pthread_mutex_lock(&lock);
    bool boots = !booted && state_socket >= 0 && FD_ISSET(state_socket, reads);
    while (boots && !main_waits) pthread_cond_wait(&changed, &lock); /* the first state waits for the end of the boot */
    listeners[own] = (struct Listener){*reads, end, false};
    pthread_mutex_unlock(&lock);
    if (boots) {
        booted = true;
        say_done();
    }
    int found = real_select(end, reads, writes, errors, timeout);
    pthread_mutex_lock(&lock);
    listeners[own].busy = found > 0;
    pthread_mutex_unlock(&lock);
    return found;
}

ssize_t recvfrom(int from, void *data, size_t size, int flags, struct sockaddr *sender, socklen_t *length) {
    ssize_t received = real_recvfrom(from, data, size, flags, sender, length);
    if (from == state_socket && received == STATE_SIZE) state_has_come = true;
    return received;
}

/* Ports */

int bind(int socket, const struct sockaddr *address, socklen_t length) {
    if (address->sa_family != AF_INET) return real_bind(socket, address, length);
    struct sockaddr_in own_address = *(const struct sockaddr_in *)address;
    int port = ntohs(own_address.sin_port);
    if (port == STATE_PORT) state_socket = socket;
    own_address.sin_port = htons(moved(port) ? moved(port) : port);
    own_address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    return real_bind(socket, (struct sockaddr *)&own_address, sizeof own_address);
}

ssize_t sendto(int socket, const void *data, size_t size, int flags, const struct sockaddr *to, socklen_t length) {
    if (to == NULL || to->sa_family != AF_INET) return real_sendto(socket, data, size, flags, to, length);
    struct sockaddr_in address = *(const struct sockaddr_in *)to;
    int port = moved(ntohs(address.sin_port));
    if (!port) return size;
    address.sin_port = htons(port);
    return real_sendto(socket, data, size, flags, (struct sockaddr *)&address, sizeof address);
}
