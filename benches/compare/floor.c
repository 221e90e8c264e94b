// SPDX-License-Identifier: GPL-3.0-or-later
// Measures how late a loop is on this computer that only waits for the next instant, as SCHED_FIFO. No program that
// steps from user space can be earlier. Prints the lateness of 50 thousand instants a second, in ns, one a line.

#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define PERIOD_NS 20000
// Half of the time, well below the kernel's real-time throttle.
#define BURST 25000

static long long now_ns(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec * 1000000000LL + time.tv_nsec;
}

int main(int argc, char **argv) {
    int bursts = argc > 1 ? atoi(argv[1]) : 1;
    static int late_ns[BURST];
    struct sched_param param = {.sched_priority = 49};
    if (sched_setscheduler(0, SCHED_FIFO, &param)) {
        perror("sched_setscheduler");
        return 1;
    }
    while (bursts--) {
        long long due = now_ns() + 1000000;
        for (int i = 0; i < BURST; i++, due += PERIOD_NS) {
            long long now;
            while ((now = now_ns()) < due)
                ;
            late_ns[i] = now - due;
        }
        for (int i = 0; i < BURST; i++)
            printf("%d\n", late_ns[i]);
        nanosleep(&(struct timespec){.tv_nsec = 500000000}, NULL);
    }
    return 0;
}
