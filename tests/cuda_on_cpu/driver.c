/* A stand-in for NVIDIA's driver library, libcuda.so: the functions that Taichi 1.7.4 looks up, and no more.
 *
 * Kernels are executed on the host, at once and one at a time: whatever is asynchronous on a card is over here when
 * the call returns. Source of the interface: CUDA Driver API, chapter 6. */
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "driver.h"

enum { MEMORY_TYPE_DEVICE = 2 };
enum attribute { /* CUdevice_attribute */
                 MOST_THREADS_PER_BLOCK = 1,
                 MOST_THREADS_IN_X = 2,
                 SHARED_PER_BLOCK = 8,
                 WARP_SIZE = 10,
                 MULTIPROCESSORS = 16,
                 CAPABILITY_MAJOR = 75,
                 CAPABILITY_MINOR = 76,
                 SHARED_PER_BLOCK_ON_REQUEST = 97,
                 MOST_BLOCKS = 106,
                 HAS_MEMORY_POOLS = 115,
};
enum {
    BLOCKS = 2
}; /* per multiprocessor, of which there is one: loops over more items than threads are walked through */

typedef uint32_t status;
struct counters counters;
#define X(name) #name " "
const char cuda_on_cpu_counter_names[] = COUNTERS(X);
#undef X
struct counters *cuda_on_cpu_counters(void) { return &counters; }

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int started;
static void *const handle = (void *)1; /* of what there is one only: context, stream, memory pool */

static status done(enum result result) {
    pthread_mutex_unlock(&lock);
    return result;
}
/* Calls come from any thread, and one is served at a time. */
#define SERVE(call) (pthread_mutex_lock(&lock), start(), done(call))
static void start(void) {
    if (started) return;
    started = 1;
    memory_start();
    launch_start();
}

long option(const char *name, long otherwise) {
    char whole[64];
    snprintf(whole, sizeof whole, "CUDA_ON_CPU_%s", name);
    const char *value = getenv(whole);
    return value && *value ? atol(value) : otherwise;
}

void stop(const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    const char *kernel = launch_running();
    fprintf(stderr, "\ncuda_on_cpu: ");
    if (kernel) fprintf(stderr, "kernel %s, block %u, thread %u: ", kernel, thread.ctaid[0], thread.tid[0]);
    vfprintf(stderr, format, arguments);
    fputc('\n', stderr);
    abort();
}

/* ---- the device ---- */
status cuInit(unsigned flags) { return option("DEVICES", 1) ? SUCCESS : NO_DEVICE; }
status cuDriverGetVersion(int *version) { return *version = 12040, SUCCESS; }
status cuDeviceGetCount(int *count) { return *count = option("DEVICES", 1), SUCCESS; }
status cuDeviceGet(int *device, int number) {
    return *device = number, number < option("DEVICES", 1) ? SUCCESS : NO_DEVICE;
}
status cuDeviceGetName(char *name, int room, int device) { return snprintf(name, room, "executed PTX"), SUCCESS; }
status cuDeviceGetDefaultMemPool(void **pool, int device) { return *pool = handle, SUCCESS; }
status cuDeviceGetAttribute(int *value, enum attribute which, int device) {
    switch (which) {
    case CAPABILITY_MAJOR: *value = 8; break;
    case CAPABILITY_MINOR: *value = 6; break;
    case MULTIPROCESSORS: *value = 1; break;
    case MOST_BLOCKS: *value = BLOCKS; break;
    case WARP_SIZE: *value = 32; break;
    case MOST_THREADS_PER_BLOCK:
    case MOST_THREADS_IN_X: *value = 1024; break;
    case SHARED_PER_BLOCK:
    case SHARED_PER_BLOCK_ON_REQUEST: *value = SHARED_BYTES; break;
    case HAS_MEMORY_POOLS: *value = 1; break;
    default: *value = 1;
    }
    return SUCCESS;
}
status cuGetErrorName(status error, const char **name) {
    static char text[32];
    snprintf(text, sizeof text, "%s",
             error == OUT_OF_MEMORY ? "CUDA_ERROR_OUT_OF_MEMORY"
             : error == NO_DEVICE   ? "CUDA_ERROR_NO_DEVICE"
                                    : "CUDA_ERROR");
    return *name = text, SUCCESS;
}
status cuGetErrorString(status error, const char **text) {
    *text = error == OUT_OF_MEMORY ? "out of memory"
            : error == NO_DEVICE   ? "no CUDA-capable device is detected"
                                   : "see stderr";
    return SUCCESS;
}

/* ---- contexts, streams, events: one of each, and always in step ---- */
status cuCtxCreate_v2(void **context, unsigned flags, int device) { return *context = handle, SUCCESS; }
status cuCtxSetCurrent(void *context) { return SUCCESS; }
status cuCtxGetCurrent(void **context) { return *context = handle, SUCCESS; }
status cuCtxSetLimit(int limit, size_t value) { return SUCCESS; }
status cuDevicePrimaryCtxRetain(void **context, int device) { return *context = handle, SUCCESS; }
status cuStreamCreate(void **stream, unsigned flags) { return *stream = handle, SUCCESS; }
status cuStreamSynchronize(void *stream) { return counters.synchronisations++, SUCCESS; }
status cuEventCreate(void **event, unsigned flags) { return *event = handle, SUCCESS; }
status cuEventDestroy(void *event) { return SUCCESS; }
status cuEventRecord(void *event, void *stream) { return SUCCESS; }
status cuEventSynchronize(void *event) { return counters.synchronisations++, SUCCESS; }
status cuEventElapsedTime(float *milliseconds, void *from, void *to) { return *milliseconds = 0, SUCCESS; }

/* ---- memory ---- */
status cuMemAlloc_v2(void **out, size_t bytes) { return SERVE(memory_give(out, bytes)); }
status cuMemAllocAsync(void **out, size_t bytes, void *stream) { return SERVE(memory_give(out, bytes)); }
status cuMemFree_v2(void *device) { return SERVE(memory_take_back(device)); }
status cuMemFreeAsync(void *device, void *stream) { return SERVE(memory_take_back(device)); }
status cuMemcpyHtoD_v2(void *to, void *from, size_t bytes) { return SERVE(memory_copy(to, from, bytes, 1, 0)); }
status cuMemcpyDtoH_v2(void *to, void *from, size_t bytes) { return SERVE(memory_copy(to, from, bytes, 0, 1)); }
status cuMemcpyDtoD_v2(void *to, void *from, size_t bytes) { return SERVE(memory_copy(to, from, bytes, 1, 1)); }
status cuMemcpyHtoDAsync_v2(void *to, void *from, size_t bytes, void *stream) {
    return SERVE(memory_copy(to, from, bytes, 1, 0));
}
status cuMemcpyDtoHAsync_v2(void *to, void *from, size_t bytes, void *stream) {
    return SERVE(memory_copy(to, from, bytes, 0, 1));
}
status cuMemsetD8_v2(void *device, uint8_t value, size_t count) { return SERVE(memory_fill(device, value, count, 1)); }
status cuMemsetD32_v2(void *device, uint32_t value, size_t count) {
    return SERVE(memory_fill(device, value, count, 4));
}
status cuMemGetInfo_v2(size_t *unused, size_t *total) { return SERVE((memory_left(unused, total), SUCCESS)); }
status cuMemAdvise(void *device, size_t bytes, unsigned advice, int where) { return SUCCESS; }
status cuMemPoolSetAttribute(void *pool, unsigned attribute, void *value) { return SUCCESS; }
status cuPointerGetAttribute(unsigned *value, unsigned attribute, void *address) {
    enum result result = SERVE(memory_is_device(address) ? SUCCESS : INVALID_VALUE);
    if (result == SUCCESS) *value = MEMORY_TYPE_DEVICE;
    return result;
}

/* ---- modules and launches ---- */
status cuModuleLoadDataEx(void **module, const char *ptx, unsigned count, void *options, void **values) {
    return SERVE((*module = module_load(ptx)) ? SUCCESS : INVALID_PTX);
}
status cuModuleGetFunction(void **kernel, void *module, const char *name) {
    return SERVE((*kernel = module_kernel(module, name)) ? SUCCESS : NOT_FOUND);
}
status cuLaunchKernel(void *kernel, uint32_t blocks_x, uint32_t blocks_y, uint32_t blocks_z, uint32_t threads_x,
                      uint32_t threads_y, uint32_t threads_z, unsigned dynamic_shared, void *stream, void **arguments,
                      void **extra) {
    const uint32_t blocks[] = {blocks_x, blocks_y, blocks_z}, threads[] = {threads_x, threads_y, threads_z};
    return SERVE(launch(kernel, blocks, threads, arguments));
}
status cuFuncGetAttribute(int *value, unsigned attribute, void *kernel) { return *value = 0, SUCCESS; }
status cuFuncSetAttribute(void *kernel, unsigned attribute, int value) { return SUCCESS; }
status cuOccupancyMaxActiveBlocksPerMultiprocessor(int *count, void *kernel, int threads, size_t shared) {
    return *count = BLOCKS, SUCCESS;
}

/* ---- looked up, never needed: managed memory, and what draws on the screen ---- */
#define ABSENT(name) \
    status name(void) { return NOT_SUPPORTED; }
ABSENT(cuMemAllocManaged)
ABSENT(cuImportExternalMemory)
ABSENT(cuImportExternalSemaphore)
ABSENT(cuExternalMemoryGetMappedBuffer)
ABSENT(cuExternalMemoryGetMappedMipmappedArray)
ABSENT(cuMipmappedArrayGetLevel)
ABSENT(cuSurfObjectCreate)
ABSENT(cuSignalExternalSemaphoresAsync)
ABSENT(cuWaitExternalSemaphoresAsync)
