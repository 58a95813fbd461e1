/* What the parts of the stand-in share. */
#ifndef CUDA_ON_CPU_DRIVER_H
#define CUDA_ON_CPU_DRIVER_H
#include <stddef.h>

#include "device.h"

#define COUNTERS(X) \
    X(launches) X(synchronisations) X(modules) X(compiled_modules) X(fills) X(allocations) X(frees) \
    X(copies_to_device) X(bytes_to_device) X(copies_to_host) X(bytes_to_host) X(copies_on_device) X(bytes_on_device)
#define X(name) long name;
struct counters {
    COUNTERS(X)
};
#undef X
extern struct counters counters;

struct kernel { /* what cuModuleGetFunction gives out; Python reads the first three */
    const char *name;
    long launches;
    const char *ptx; /* the file that holds its module */
    const struct entry *entry;
    int flushes_denormals;
};

enum result {
    SUCCESS,
    INVALID_VALUE,
    OUT_OF_MEMORY,
    NO_DEVICE = 100,
    INVALID_PTX = 218,
    NOT_FOUND = 500,
    NOT_SUPPORTED = 801
};

long option(const char *name, long otherwise); /* CUDA_ON_CPU_name */
void stop(const char *format, ...);            /* ends the process, naming the kernel that runs */

/* memory.c */
void memory_start(void);
enum result memory_give(void **out, size_t bytes);
enum result memory_take_back(void *device);
enum result memory_copy(void *to, const void *from, size_t bytes, int to_device, int from_device);
enum result memory_fill(void *device, uint32_t value, size_t count, int bytes_each);
int memory_is_device(const void *address);
const char *memory_complaint(uint64_t address, int bytes);
void memory_left(size_t *unused, size_t *total);

/* modules.c */
struct module;
struct module *module_load(const char *ptx);
struct kernel *module_kernel(struct module *module, const char *name);

/* launch.c */
extern struct thread thread;
void launch_start(void);
const char *launch_running(void); /* the kernel that runs, or 0 */
enum result launch(struct kernel *kernel, const uint32_t blocks[3], const uint32_t threads[3], void **arguments);
#endif
