/* A program that calls libtracetools.so in the order of rclcpp (Iron), by commands on standard
 * input. It prints a line after each command. -DPLACE=240 or 248: offset of rmw_handle.
 * -DSTEADY=CLOCK_MONOTONIC: rcl's steady clock of Jazzy, else that of Humble. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <fcntl.h>
#include <linux/futex.h>
#include <pthread.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#ifndef STEADY
#define STEADY CLOCK_MONOTONIC_RAW
#endif

void ros_trace_rcl_node_init(const void *, const void *, const char *, const char *);
void ros_trace_rcl_publisher_init(const void *, const void *, const void *, const char *, size_t);
void ros_trace_rcl_subscription_init(const void *, const void *, const void *, const char *, size_t);
void ros_trace_rclcpp_subscription_init(const void *, const void *);
void ros_trace_rclcpp_subscription_callback_added(const void *, const void *);
void ros_trace_rcl_timer_init(const void *, int64_t);
void ros_trace_rclcpp_timer_callback_added(const void *, const void *);
void ros_trace_rclcpp_timer_link_node(const void *, const void *);
void ros_trace_callback_start(const void *, bool);
void ros_trace_callback_end(const void *);
void ros_trace_rcl_lifecycle_state_machine_init(const void *, const void *);
void ros_trace_rcl_lifecycle_transition(const void *, const char *, const char *);
void ros_trace_rcl_publish(const void *, const void *);
void ros_trace_rcl_service_init(const void *, const void *, const void *, const char *);
void ros_trace_rclcpp_service_callback_added(const void *, const void *);
void ros_trace_rmw_take(const void *, const void *, int64_t, bool);
void ros_trace_rclcpp_executor_get_next_ready(void);
void ros_trace_rclcpp_executor_execute(const void *);
#ifndef HUMBLE
void ros_trace_rclcpp_intra_publish(const void *, const void *);
void ros_trace_rclcpp_construct_ring_buffer(const void *, uint64_t);
void ros_trace_rclcpp_ring_buffer_enqueue(const void *, uint64_t, uint64_t, bool);
void ros_trace_rclcpp_ring_buffer_dequeue(const void *, uint64_t, uint64_t);
void ros_trace_rclcpp_buffer_to_ipb(const void *, const void *);
void ros_trace_rclcpp_ipb_to_subscription(const void *, const void *);
#endif

/* rmw_publisher_t and rmw_subscription_t begin alike. */
struct rmw { const char *identifier; void *data; const char *topic; char rest[32]; };
struct impl { char before[PLACE]; struct rmw *rmw; };
struct handle { struct impl *impl; };
struct timer_impl { char before[40]; uint64_t period; int64_t last, next; };
struct timer { struct timer_impl *impl; };

static struct rmw made_rmw(const char *topic) {
    struct rmw rmw = { "rmw_test_cpp", 0, topic, { 0 } };
    return rmw;
}
static int64_t clock_now(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}
static void pass(int64_t microseconds) {
    int64_t end = clock_now(CLOCK_MONOTONIC) + microseconds * 1000;
    while (clock_now(CLOCK_MONOTONIC) < end) {}
}

/* Adds the thread's CPU time and its waiting time, in nanoseconds, with a sign. */
static void add_schedstat(long long sums[2], int sign) {
    long long cpu = 0, run_delay = 0;
    FILE *file = fopen("/proc/thread-self/schedstat", "r");
    if (!file || fscanf(file, "%lld %lld", &cpu, &run_delay) != 2) abort();
    fclose(file);
    sums[0] += sign * cpu;
    sums[1] += sign * run_delay;
}

static struct rmw out_rmw, in_rmw;
static struct impl out_impl, in_impl;
static struct handle out = { &out_impl }, in = { &in_impl };
/* A handle whose structure shows nothing. */
static struct impl unnamed_impl;
static struct handle unnamed = { &unnamed_impl };
static struct timer_impl timer_impl;
static struct timer timer = { &timer_impl };
static char node, object, machine, owner;
static char callback[8], buffer[8], timer_callback, service, service_callback, message;
static uint64_t capacity = 4, filled, writes, reads;

/* A thread that holds the lock for `us` microseconds of each period, and rests for as long. */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static void *hold_lock(void *us) {
    pthread_setname_np(pthread_self(), "lock-holder");
    for (;;) {
        pthread_mutex_lock(&lock);
        usleep((long)us);
        pthread_mutex_unlock(&lock);
        usleep((long)us);
    }
    return 0;
}

/* Writes `us` KiB and waits for the disk. */
static void write_to_disk(const char *path, long kilobytes) {
    static char block[1024];
    int file = open(path, O_CREAT | O_WRONLY | O_TRUNC, 0600);
    for (long i = 0; i < kilobytes; i++) if (write(file, block, sizeof block) < 0) abort();
    if (fsync(file)) abort();
    close(file);
}

/* Reads a file that is not in memory, page by page. */
static void read_from_disk(const char *path) {
    int file = open(path, O_RDONLY);
    off_t size = lseek(file, 0, SEEK_END);
    if (posix_fadvise(file, 0, 0, POSIX_FADV_DONTNEED)) abort();
    char *pages = mmap(0, size, PROT_READ, MAP_SHARED, file, 0);
    if (madvise(pages, size, MADV_RANDOM)) abort();
    volatile char sum = 0;
    for (off_t at = 0; at < size; at += 4096) sum += pages[at];
    munmap(pages, size);
    close(file);
}

/* Does one of the things for which a callback can be late. */
static void be_late(const char *what, long us, const char *path) {
    if (!strcmp(what, "sleep")) usleep(us);
    else if (!strcmp(what, "compute")) pass(us);
    else if (!strcmp(what, "lock")) {
        pthread_mutex_lock(&lock);
        pthread_mutex_unlock(&lock);
    } else if (!strcmp(what, "disk")) write_to_disk(path, us);
    else if (!strcmp(what, "fault")) read_from_disk(path);
}

/* Puts one message into the ring buffer, as rclcpp's RingBufferImplementation does. */
static void enqueue(void) {
#ifndef HUMBLE
    bool full = filled == capacity;
    ros_trace_rclcpp_intra_publish(&out, &message);
    ros_trace_rclcpp_ring_buffer_enqueue(buffer, writes++ % capacity, filled + 1, full);
    if (full) reads++; else filled++;
#endif
}
static bool dequeue(void) {
#ifndef HUMBLE
    if (!filled) return false;
    ros_trace_rclcpp_ring_buffer_dequeue(buffer, reads++ % capacity, filled - 1);
    filled--;
#endif
    return true;
}

/* Opens a socket on a free port of ::1 or 127.0.0.1. Both kinds of addresses have the port at the
   same place. */
static int opened_socket(bool ipv6, struct sockaddr_in6 *address) {
    struct sockaddr_in ipv4 = { .sin_family = AF_INET, .sin_addr = { htonl(INADDR_LOOPBACK) } };
    *address = (struct sockaddr_in6){ .sin6_family = AF_INET6, .sin6_addr = IN6ADDR_LOOPBACK_INIT };
    if (!ipv6) memcpy(address, &ipv4, sizeof ipv4);
    socklen_t size = ipv6 ? sizeof *address : sizeof ipv4;
    int receiver = socket(ipv6 ? AF_INET6 : AF_INET, SOCK_DGRAM, 0);
    if (bind(receiver, (void *)address, size)) abort();
    if (getsockname(receiver, (void *)address, &size)) abort();
    return receiver;
}
/* Receives a datagram that begins with the RTPS header and INFO_TS. Returns the source timestamp
   in nanoseconds. */
static int64_t received_from(int receiver) {
    uint32_t words[16384];
    struct sockaddr_in6 from;
    socklen_t size = sizeof from;
    if (recvfrom(receiver, words, sizeof words, 0, (void *)&from, &size) < 32) abort();
    return words[6] * 1000000000LL + ((words[7] * 1000000000ULL + (1u << 31)) >> 32);
}

/* What another process writes into shared memory. */
struct port { uint32_t count; uint32_t padding; int64_t source; };
/* A thread of the middleware: it waits for messages in shared memory, and passes each one on after
   `us` microseconds. */
struct listener { struct port *port; long us; uint32_t passed; int64_t source; };
static pthread_mutex_t ready_lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t ready = PTHREAD_COND_INITIALIZER;
static void *listen_for_messages(void *argument) {
    struct listener *own = argument;
    pthread_setname_np(pthread_self(), "dds-listener");
    for (;;) {
        uint32_t count = __atomic_load_n(&own->port->count, __ATOMIC_ACQUIRE);
        if (count == own->passed) {
            syscall(SYS_futex, &own->port->count, FUTEX_WAIT, count, 0, 0, 0);
            continue;
        }
        if (own->us) usleep(own->us);
        pthread_mutex_lock(&ready_lock);
        own->source = own->port->source;
        own->passed = count;
        pthread_cond_signal(&ready);
        pthread_mutex_unlock(&ready_lock);
    }
    return 0;
}
static struct port *mapped_port(const char *path) {
    int file = open(path, O_RDWR);
    struct port *port = mmap(0, sizeof *port, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (port == MAP_FAILED) abort();
    close(file);
    return port;
}
static struct listener *started_listener(const char *path) {
    struct listener *own = calloc(1, sizeof *own);
    own->port = mapped_port(path);
    own->passed = own->port->count;
    pthread_t thread;
    if (pthread_create(&thread, 0, listen_for_messages, own)) abort();
    return own;
}

/* A call of the timer's callback in another thread of the executor. */
struct turn { long us; bool is_over; };
static void *call_first(void *argument) {
    struct turn *turn = argument;
    ros_trace_rclcpp_executor_get_next_ready();
    ros_trace_rclcpp_executor_execute(&timer);
    ros_trace_callback_start(&timer_callback, false);
    usleep(turn->us);
    ros_trace_callback_end(&timer_callback);
    pthread_mutex_lock(&ready_lock);
    turn->is_over = true;
    pthread_cond_signal(&ready);
    pthread_mutex_unlock(&ready_lock);
    return 0;
}

/* A thread of a large executor. */
static pthread_mutex_t all_called = PTHREAD_MUTEX_INITIALIZER;
static long called;
static void *call_once(void *unused) {
    ros_trace_rclcpp_executor_get_next_ready();
    ros_trace_rclcpp_executor_execute(&timer);
    ros_trace_callback_start(&timer_callback, false);
    ros_trace_callback_end(&timer_callback);
    __atomic_fetch_add(&called, 1, __ATOMIC_RELEASE);
    pthread_mutex_lock(&all_called);
    pthread_mutex_unlock(&all_called);
    return unused;
}

int main(int argc, char **argv) {
    int receiver = -1;
    struct listener *listener = 0;
    struct port *port = 0;
    uint32_t seen = 0;
    char line[4096], what[64], path[3072];
    const char *input = argc > 1 ? argv[1] : "/in", *output = argc > 2 ? argv[2] : "/out";
    const char *name = argc > 3 ? argv[3] : "filter";
    out_rmw = made_rmw(output);
    in_rmw = made_rmw(input);
    out_impl.rmw = &out_rmw;
    in_impl.rmw = &in_rmw;
    memset(out_impl.before, 0x5a, sizeof out_impl.before);
    while (fgets(line, sizeof line, stdin)) {
        long n = 0, us = 0;
        path[0] = 0;
        if (sscanf(line, "%63s %ld %ld %3071s", what, &n, &us, path) < 1) continue;
        if (!strcmp(what, "init")) {
            ros_trace_rcl_node_init(&node, 0, name, "/robot1");
            ros_trace_rcl_publisher_init(&out, &node, &out_rmw, output, 10);
            ros_trace_rcl_subscription_init(&in, &node, &in_rmw, input, 10);
            ros_trace_rclcpp_subscription_init(&in, &object);
            ros_trace_rclcpp_subscription_callback_added(&object, callback);
#ifndef HUMBLE
            ros_trace_rclcpp_construct_ring_buffer(buffer, capacity);
            ros_trace_rclcpp_buffer_to_ipb(buffer, &owner);
            ros_trace_rclcpp_ipb_to_subscription(&owner, &object);
#endif
            ros_trace_rcl_timer_init(&timer, 1000000);
            ros_trace_rclcpp_timer_callback_added(&timer, &timer_callback);
            ros_trace_rclcpp_timer_link_node(&timer, &node);
            ros_trace_rcl_lifecycle_state_machine_init(&node, &machine);
            ros_trace_rcl_service_init(&service, &node, 0, "/robot1/reset");
            ros_trace_rclcpp_service_callback_added(&service, &service_callback);
        } else if (!strcmp(what, "transition")) {
            ros_trace_rcl_lifecycle_transition(&machine, "inactive", "active");
        } else if (!strcmp(what, "publish")) {
            for (long i = 0; i < n; i++) { ros_trace_rcl_publish(&out, &message); pass(us); }
        } else if (!strcmp(what, "both")) {
            /* Publishes to subscriptions of the same process and to others. */
            for (long i = 0; i < n; i++) { enqueue(); ros_trace_rcl_publish(&out, &message); }
        } else if (!strcmp(what, "enqueue")) {
            for (long i = 0; i < n; i++) enqueue();
        } else if (!strcmp(what, "receive")) {
            /* Takes each message of the ring buffer in a callback of `us` microseconds. */
            long i = 0;
            for (; i < n && dequeue(); i++) {
                ros_trace_callback_start(callback + 1, true);
                pass(us);
                ros_trace_callback_end(callback + 1);
            }
            printf("%ld ", i);
        } else if (!strcmp(what, "take")) {
            /* Takes messages stamped 5 ms ago. The callback publishes after `us` microseconds.
               Prints the nanoseconds until then. */
            for (long i = 0; i < n; i++) {
                ros_trace_rclcpp_executor_get_next_ready();
                ros_trace_rclcpp_executor_execute(&in);
                ros_trace_rmw_take(&in_rmw, &message, clock_now(CLOCK_REALTIME) - 5000000, true);
                int64_t began = clock_now(CLOCK_MONOTONIC);
                ros_trace_callback_start(callback, false);
                pass(us);
                int64_t published = clock_now(CLOCK_MONOTONIC);
                ros_trace_rcl_publish(&out, &message);
                ros_trace_callback_end(callback);
                printf("%ld ", (long)(published - began));
            }
        } else if (strstr("sleep compute lock disk fault", what)) {
            /* Callbacks that need time for one of these, `us` microseconds or KiB. Prints the CPU
               time and the waiting time of all, as the kernel counts them. */
            static bool has_holder;
            if (!strcmp(what, "lock") && !has_holder) {
                pthread_t holder;
                has_holder = !pthread_create(&holder, 0, hold_lock, (void *)us);
            }
            long long sums[2] = { 0, 0 };
            for (long i = 0; i < n; i++) {
                /* The callback begins while the lock is held: it waits for nothing else. */
                while (!strcmp(what, "lock") && !pthread_mutex_trylock(&lock)) {
                    pthread_mutex_unlock(&lock);
                    usleep(100);
                }
                ros_trace_rclcpp_executor_get_next_ready();
                ros_trace_rclcpp_executor_execute(&unnamed);
                add_schedstat(sums, -1);
                ros_trace_callback_start(callback, false);
                be_late(what, us, path);
                ros_trace_callback_end(callback);
                add_schedstat(sums, 1);
            }
            printf("%lld %lld ", sums[0], sums[1]);
        } else if (!strcmp(what, "buffers")) {
            /* Takes messages of a buffer topic, as rmw_fastrtps of Lyrical does: without rmw_take. */
            for (long i = 0; i < n; i++) {
                ros_trace_rclcpp_executor_get_next_ready();
                ros_trace_rclcpp_executor_execute(&in);
                ros_trace_callback_start(callback, false);
                pass(us);
                ros_trace_callback_end(callback);
            }
        } else if (!strcmp(what, "serve")) {
            /* Finds no message, and answers requests in callbacks of `us` microseconds. */
            for (long i = 0; i < n; i++) {
                ros_trace_rclcpp_executor_get_next_ready();
                ros_trace_rclcpp_executor_execute(&in);
                ros_trace_rmw_take(&in_rmw, &message, 0, false);
                ros_trace_rclcpp_executor_get_next_ready();
                ros_trace_callback_start(&service_callback, false);
                pass(us);
                ros_trace_callback_end(&service_callback);
            }
        } else if (!strcmp(what, "relay")) {
            /* Takes a message with the source timestamp `n`. The callback publishes after `us`
               microseconds. Prints the source timestamp of its output, and the nanoseconds. */
            ros_trace_rclcpp_executor_get_next_ready();
            ros_trace_rclcpp_executor_execute(&in);
            ros_trace_rmw_take(&in_rmw, &message, n, true);
            int64_t began = clock_now(CLOCK_MONOTONIC);
            ros_trace_callback_start(callback, false);
            pass(us);
            int64_t published = clock_now(CLOCK_MONOTONIC);
            ros_trace_rcl_publish(&out, &message);
            int64_t source = clock_now(CLOCK_REALTIME);
            ros_trace_callback_end(callback);
            printf("%ld %ld ", (long)source, (long)(published - began));
        } else if (!strcmp(what, "socket")) {
            /* Opens a socket for IPv4, or for IPv6 if `n` is 6. Prints its port. */
            struct sockaddr_in6 address;
            receiver = opened_socket(n == 6, &address);
            printf("%d ", ntohs(address.sin6_port));
        } else if (!strcmp(what, "network")) {
            /* Receives datagrams, and takes each one `us` microseconds later. */
            for (long i = 0; i < n; i++) {
                ros_trace_rclcpp_executor_get_next_ready();
                int64_t source = received_from(receiver);
                if (us) usleep(us);
                ros_trace_rclcpp_executor_execute(&in);
                ros_trace_rmw_take(&in_rmw, &message, source, true);
                ros_trace_callback_start(callback, false);
                ros_trace_callback_end(callback);
            }
        } else if (!strcmp(what, "listen")) {
            /* Listens at a file that other processes map. */
            listener = started_listener(path);
            seen = listener->passed;
        } else if (!strcmp(what, "send")) {
            /* Publishes a message into that memory whose source timestamp is `us` microseconds old. */
            if (!port) port = mapped_port(path);
            ros_trace_rcl_publish(&out, &message);
            port->source = clock_now(CLOCK_REALTIME) - us * 1000;
            __atomic_fetch_add(&port->count, 1, __ATOMIC_RELEASE);
            syscall(SYS_futex, &port->count, FUTEX_WAKE, 1, 0, 0, 0);
        } else if (!strcmp(what, "shared")) {
            /* Takes `n` messages that the listener passes on after `us` microseconds each. */
            listener->us = us;
            for (long i = 0; i < n; i++) {
                ros_trace_rclcpp_executor_get_next_ready();
                pthread_mutex_lock(&ready_lock);
                while (listener->passed == seen) pthread_cond_wait(&ready, &ready_lock);
                int64_t source = listener->source;
                seen = listener->passed;
                pthread_mutex_unlock(&ready_lock);
                ros_trace_rclcpp_executor_execute(&in);
                ros_trace_rmw_take(&in_rmw, &message, source, true);
                ros_trace_callback_start(callback, false);
                ros_trace_callback_end(callback);
            }
        } else if (!strcmp(what, "group")) {
            /* Takes `n` messages with a thread that waits while another one of the same callback
               group is in a callback of `us` microseconds, which begins first. */
            for (long i = 0; i < n; i++) {
                struct turn turn = { .us = us };
                int64_t source = clock_now(CLOCK_REALTIME);
                pthread_t thread;
                pthread_mutex_lock(&ready_lock);
                if (pthread_create(&thread, 0, call_first, &turn)) abort();
                while (!turn.is_over) pthread_cond_wait(&ready, &ready_lock);
                pthread_mutex_unlock(&ready_lock);
                ros_trace_rclcpp_executor_get_next_ready();
                ros_trace_rclcpp_executor_execute(&in);
                ros_trace_rmw_take(&in_rmw, &message, source, true);
                ros_trace_callback_start(callback, false);
                ros_trace_callback_end(callback);
                pthread_join(thread, 0);
            }
        } else if (!strcmp(what, "threads")) {
            /* `n` threads call a callback each, one after the other. All end after the last one. */
            pthread_t *threads = calloc(n, sizeof *threads);
            pthread_mutex_lock(&all_called);
            for (long i = 0; i < n; i++)
                if (pthread_create(&threads[i], 0, call_once, 0)) abort();
            while (__atomic_load_n(&called, __ATOMIC_ACQUIRE) < n) usleep(1000);
            pthread_mutex_unlock(&all_called);
            for (long i = 0; i < n; i++) pthread_join(threads[i], 0);
            called = 0;
        } else if (!strcmp(what, "drain")) {
            /* Receives everything that waits. Prints the number of datagrams. */
            char bytes[65536];
            struct sockaddr_in6 from;
            socklen_t size = sizeof from;
            while (recvfrom(receiver, bytes, sizeof bytes, MSG_DONTWAIT, (void *)&from, &size) >= 0)
                n++;
            printf("%ld ", n);
        } else if (!strcmp(what, "miss")) {
            for (long i = 0; i < n; i++) ros_trace_rmw_take(&in_rmw, &message, 0, false);
        } else if (!strcmp(what, "timer")) {
            /* A timer of 1 ms, called `us` microseconds late by rcl's steady clock;
               the last call skips two periods. */
            timer_impl.period = 1000000;
            int64_t next = clock_now(STEADY) + 1000000;
            for (long i = 0; i < n; i++) {
                while (clock_now(STEADY) < next + us * 1000) {}
                timer_impl.last = clock_now(STEADY);
                next += 1000000;
                while (next <= timer_impl.last) next += 1000000;
                if (i == n - 1) next += 2000000;
                timer_impl.next = next;
                ros_trace_rclcpp_executor_get_next_ready();
                ros_trace_rclcpp_executor_execute(&timer);
                ros_trace_callback_start(&timer_callback, false);
                ros_trace_callback_end(&timer_callback);
            }
        } else if (!strcmp(what, "nowhere")) {
            /* Passes handles that are invalid pointers, all of them different. */
            for (long i = 0; i < n; i++) {
                ros_trace_rcl_publish((void *)(uintptr_t)(0x1000 + 8 * i), 0);
                ros_trace_rmw_take((void *)(uintptr_t)(0xdead0000beef0000 + 8 * i), 0, -1, true);
                ros_trace_callback_start((void *)(uintptr_t)(8 * i), i & 1);
                ros_trace_callback_end((void *)(uintptr_t)(8 * i + 1));
                ros_trace_rcl_node_init((void *)(uintptr_t)i, 0, (char *)8, (char *)-1);
                ros_trace_rclcpp_executor_execute((void *)(uintptr_t)i);
            }
        } else if (!strcmp(what, "fork")) {
            /* Forks children that publish once and exit. */
            for (long i = 0; i < n; i++) {
                pid_t child = fork();
                if (!child) { ros_trace_rcl_publish(&out, &message); _exit(0); }
                waitpid(child, 0, 0);
            }
        }
        printf("%s\n", what);
        fflush(stdout);
    }
    return 0;
}
