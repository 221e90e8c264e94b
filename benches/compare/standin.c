// SPDX-License-Identifier: GPL-3.0-or-later
// Stands in for the GPIO character device and spidev, by LD_PRELOAD. A program opens /dev/gpiochip0 or /dev/spidevB.C
// (null devices, made by the bench), and speaks the ioctls of uAPI v1 or v2. It sees a chip of 64 lines. Every change
// of an output is stamped with CLOCK_MONOTONIC, so that two programs are measured alike.
//
//   BENCH_EDGES=FILE   where the changes go: one 64-bit word each,
//                      nanoseconds << 8 | line << 1 | level, in order, up to the first zero
//   BENCH_EDGES_MAX=N  how many at most
//   BENCH_SYSCALL=1    spend a system call on each value ioctl, as a real chip does
//   BENCH_BUS_US=N     an SPI transfer sleeps N microseconds, and echoes; a write(2) to spidev is one
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <linux/gpio.h>
#include <linux/spi/spidev.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

enum { LINES = 64, DESCRIPTORS = 1024 };

// A descriptor that stands for requested lines.
struct request {
    uint8_t used;
    uint8_t count;
    uint8_t lines[LINES];
};

static struct request requests[DESCRIPTORS];
// Descriptors of spidev: those that got an SPI request.
static uint8_t buses[DESCRIPTORS];
static uint8_t levels[LINES];
static _Atomic uint64_t *edges;
static _Atomic uint64_t edge_count;
static uint64_t edges_max;
static int spends_syscall;
static long bus_us;
static int (*real_ioctl)(int, unsigned long, ...);
static int (*real_close)(int);
static ssize_t (*real_write)(int, const void *, size_t);

static long number(const char *name)
{
    const char *text = getenv(name);
    return text ? atol(text) : 0;
}

__attribute__((constructor)) static void set_up(void)
{
    real_ioctl = dlsym(RTLD_NEXT, "ioctl");
    real_close = dlsym(RTLD_NEXT, "close");
    real_write = dlsym(RTLD_NEXT, "write");
    spends_syscall = number("BENCH_SYSCALL") != 0;
    bus_us = number("BENCH_BUS_US");
    const char *file = getenv("BENCH_EDGES");
    size_t bytes = number("BENCH_EDGES_MAX") * sizeof(*edges);
    int fd = file && bytes ? open(file, O_RDWR | O_CREAT | O_CLOEXEC, 0600) : -1;
    if (fd < 0 || ftruncate(fd, bytes))
        return;
    void *map = mmap(0, bytes, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_POPULATE, fd, 0);
    real_close(fd);
    if (map == MAP_FAILED)
        return;
    edges = map;
    edges_max = bytes / sizeof(*edges);
}

static void set_line(unsigned line, int level)
{
    if (line >= LINES || levels[line] == level)
        return;
    levels[line] = level;
    if (!edges_max)
        return;
    uint64_t at = atomic_fetch_add_explicit(&edge_count, 1, memory_order_relaxed);
    if (at >= edges_max)
        return;
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    uint64_t ns = (uint64_t)now.tv_sec * 1000000000 + now.tv_nsec;
    atomic_store_explicit(&edges[at], ns << 8 | line << 1 | level, memory_order_relaxed);
}

static int new_request(unsigned count, const uint32_t *lines)
{
    int fd = open("/dev/null", O_RDWR | O_CLOEXEC);
    if (fd < 0 || fd >= DESCRIPTORS || count > LINES)
        return -1;
    struct request *request = &requests[fd];
    request->used = 1;
    request->count = count;
    for (unsigned i = 0; i < count; i++)
        request->lines[i] = lines[i];
    return fd;
}

int close(int fd)
{
    if (fd >= 0 && fd < DESCRIPTORS)
        requests[fd].used = buses[fd] = 0;
    return real_close(fd);
}

// A signal does not cut a driver's transfer short.
static void transfer(void)
{
    struct timespec until;
    clock_gettime(CLOCK_MONOTONIC, &until);
    until.tv_nsec += bus_us % 1000000 * 1000;
    until.tv_sec += bus_us / 1000000 + until.tv_nsec / 1000000000;
    until.tv_nsec %= 1000000000;
    while (bus_us && clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, 0))
        ;
}

ssize_t write(int fd, const void *bytes, size_t count)
{
    if (fd < 0 || fd >= DESCRIPTORS || !buses[fd])
        return real_write(fd, bytes, count);
    transfer();
    return count;
}

static int spi(int fd, unsigned long command, void *argument)
{
    if (fd >= 0 && fd < DESCRIPTORS)
        buses[fd] = 1;
    if (_IOC_NR(command) != 0)
        return 0;
    struct spi_ioc_transfer *parts = argument;
    int total = 0;
    for (unsigned i = 0; i < _IOC_SIZE(command) / sizeof(*parts); i++) {
        void *to = (void *)(uintptr_t)parts[i].rx_buf;
        const void *from = (const void *)(uintptr_t)parts[i].tx_buf;
        if (to && from)
            memmove(to, from, parts[i].len);
        else if (to)
            memset(to, 0, parts[i].len);
        total += parts[i].len;
    }
    transfer();
    return total;
}

static int values(struct request *request, unsigned command, void *argument)
{
    if (spends_syscall)
        syscall(SYS_getppid);
    struct gpiohandle_data *v1 = argument;
    struct gpio_v2_line_values *v2 = argument;
    for (unsigned i = 0; i < request->count; i++)
        switch (command) {
        case GPIOHANDLE_SET_LINE_VALUES_IOCTL:
            set_line(request->lines[i], v1->values[i] != 0);
            break;
        case GPIO_V2_LINE_SET_VALUES_IOCTL:
            if (v2->mask >> i & 1)
                set_line(request->lines[i], v2->bits >> i & 1);
            break;
        case GPIOHANDLE_GET_LINE_VALUES_IOCTL:
            v1->values[i] = levels[request->lines[i]];
            break;
        case GPIO_V2_LINE_GET_VALUES_IOCTL:
            if (!i)
                v2->bits = 0;
            v2->bits |= (uint64_t)levels[request->lines[i]] << i;
            break;
        }
    return 0;
}

int ioctl(int fd, unsigned long long_command, ...)
{
    va_list rest;
    va_start(rest, long_command);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    unsigned command = long_command;
    struct request *request = fd >= 0 && fd < DESCRIPTORS && requests[fd].used ? &requests[fd] : 0;
    switch (command) {
    case GPIOHANDLE_SET_LINE_VALUES_IOCTL:
    case GPIOHANDLE_GET_LINE_VALUES_IOCTL:
    case GPIO_V2_LINE_SET_VALUES_IOCTL:
    case GPIO_V2_LINE_GET_VALUES_IOCTL:
        if (request)
            return values(request, command, argument);
        break;
    case GPIO_GET_CHIPINFO_IOCTL: {
        struct gpiochip_info *chip = argument;
        *chip = (struct gpiochip_info){ .name = "gpiochip0", .label = "bench", .lines = LINES };
        return 0;
    }
    case GPIO_GET_LINEINFO_IOCTL: {
        struct gpioline_info *line = argument;
        *line = (struct gpioline_info){ .line_offset = line->line_offset };
        snprintf(line->name, sizeof(line->name), "GPIO%u", line->line_offset);
        return 0;
    }
    case GPIO_V2_GET_LINEINFO_IOCTL: {
        struct gpio_v2_line_info *line = argument;
        *line = (struct gpio_v2_line_info){ .offset = line->offset, .flags = GPIO_V2_LINE_FLAG_INPUT };
        snprintf(line->name, sizeof(line->name), "GPIO%u", line->offset);
        return 0;
    }
    case GPIO_GET_LINEHANDLE_IOCTL: {
        struct gpiohandle_request *asked = argument;
        asked->fd = new_request(asked->lines, asked->lineoffsets);
        for (unsigned i = 0; i < asked->lines && asked->flags & GPIOHANDLE_REQUEST_OUTPUT; i++)
            set_line(asked->lineoffsets[i], asked->default_values[i] != 0);
        return asked->fd < 0 ? -1 : 0;
    }
    case GPIO_V2_GET_LINE_IOCTL: {
        struct gpio_v2_line_request *asked = argument;
        uint64_t bits = 0;
        for (unsigned i = 0; i < asked->config.num_attrs; i++)
            if (asked->config.attrs[i].attr.id == GPIO_V2_LINE_ATTR_ID_OUTPUT_VALUES)
                bits = asked->config.attrs[i].attr.values & asked->config.attrs[i].mask;
        asked->fd = new_request(asked->num_lines, asked->offsets);
        for (unsigned i = 0; i < asked->num_lines && asked->config.flags & GPIO_V2_LINE_FLAG_OUTPUT; i++)
            set_line(asked->offsets[i], bits >> i & 1);
        return asked->fd < 0 ? -1 : 0;
    }
    case GPIOHANDLE_SET_CONFIG_IOCTL: {
        struct gpiohandle_config *asked = argument;
        if (!request)
            break;
        for (unsigned i = 0; i < request->count && asked->flags & GPIOHANDLE_REQUEST_OUTPUT; i++)
            set_line(request->lines[i], asked->default_values[i] != 0);
        return 0;
    }
    }
    if (_IOC_TYPE(command) == SPI_IOC_MAGIC && _IOC_NR(command) <= 5)
        return spi(fd, command, argument);
    return real_ioctl(fd, long_command, argument);
}
