/* What the stand-in for the driver and the kernels translated to C both know: addresses, and the thread that runs. */
#ifndef CUDA_ON_CPU_DEVICE_H
#define CUDA_ON_CPU_DEVICE_H
#include <stdint.h>

/* Device addresses are numbers in a window that stays forbidden in this process: a host that follows one is stopped by
 * the processor. What lies "there" is kept SHIFT bytes further on, where only the driver and kernels look. */
#define DEVICE_BASE 0x100000000000ull
#define DEVICE_SPAN (1ull << 39)
#define SHIFT 0x010000000000ull
#define PAGE_BITS 12
#define PAGE (1ull << PAGE_BITS)
#define ALLOCATED \
    ((const uint8_t *)0x0f0000000000ull) /* one byte for each page of the window: 1 where memory was given out */
enum { SHARED_BYTES = 48 << 10 };

enum exchange { SHUFFLE_UP, SHUFFLE_DOWN, SHUFFLE_XOR, SHUFFLE_INDEX, VOTE_BALLOT, VOTE_ANY, VOTE_ALL, WARP_BARRIER };

struct thread { /* the thread that runs, and what the driver does for it */
    uint32_t tid[3], ntid[3], ctaid[3], nctaid[3], lane;
    uint64_t stack_low, stack_high; /* where its locals lie */
    char *shared;                   /* memory shared by its block */
    void (*leave)(void);            /* exit */
    void (*stop)(const char *why);  /* ends the process, naming the kernel */
    void (*wrong_address)(uint64_t address, int bytes);
    void (*assertion)(uint64_t message, uint64_t file, uint32_t line, uint64_t function);
    uint32_t (*print)(uint64_t format, uint64_t arguments);
    void (*barrier)(void);
    uint32_t (*exchange)(enum exchange what, uint32_t members, uint32_t value, uint32_t operand, uint32_t limits,
                         int *valid);
};

enum { MAX_PARAMETERS = 8 };

struct entry { /* a kernel of a translated module */
    void (*run)(char *parameters);
    int exchanges; /* whether its threads wait for one another */
    int count, bytes[MAX_PARAMETERS], offset[MAX_PARAMETERS];
};
#endif
