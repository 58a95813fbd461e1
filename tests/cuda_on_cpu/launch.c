/* Runs the threads of a launch: one after the other, or, where they exchange values, as coroutines that wait in turn.
 *
 * Coroutines are entered once by a context of their own stack; from then on they change places by setjmp and longjmp,
 * which, unlike swapcontext, does not ask the operating system. */
#include <setjmp.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <ucontext.h>
#include <xmmintrin.h>

#include "driver.h"

enum { MOST_THREADS = 1024, WARP = 32, STACK = 256 << 10, FLUSH_DENORMALS = 0x8040 };
enum state { FRESH, READY, IN_EXCHANGE, AT_BARRIER, OVER };

struct coroutine {
    enum state state;
    jmp_buf place;
    enum exchange what; /* what it offers to its warp, and what it gets */
    uint32_t members, value, operand, limits, result;
    int valid;
};

struct thread thread;
static struct coroutine coroutines[MOST_THREADS];
static char shared[SHARED_BYTES] __attribute__((aligned(256))), parameters[4096] __attribute__((aligned(256)));
static char *stacks;
static jmp_buf scheduler, next_thread;
static struct kernel *running;
static int as_coroutines, current, thread_count, reversed;
static long reverse_each;

static void leave(void) {
    if (!as_coroutines) longjmp(next_thread, 1);
    coroutines[current].state = OVER;
    longjmp(scheduler, 1);
}

static void wait(enum state state) {
    coroutines[current].state = state;
    if (!_setjmp(coroutines[current].place)) _longjmp(scheduler, 1);
}

static void barrier(void) { wait(AT_BARRIER); }

static uint32_t exchange(enum exchange what, uint32_t members, uint32_t value, uint32_t operand, uint32_t limits,
                         int *valid) {
    struct coroutine *own = &coroutines[current];
    own->what = what, own->members = members, own->value = value, own->operand = operand, own->limits = limits;
    wait(IN_EXCHANGE);
    *valid = coroutines[current].valid;
    return coroutines[current].result;
}

static void wrong_address(uint64_t address, int bytes) {
    stop("%d bytes at %p: %s", bytes, (void *)address, memory_complaint(address, bytes));
}

static const char *text(uint64_t device) { return device ? (const char *)(device + SHIFT) : ""; }
static void assertion(uint64_t message, uint64_t file, uint32_t line, uint64_t function) {
    stop("assertion %s, %s:%u %s", text(message), text(file), line, text(function));
}
static uint32_t print(uint64_t format, uint64_t arguments) {
    stop("printing from kernels is not part of the stand-in: %s", text(format));
    return 0;
}
static void stop_kernel(const char *why) { stop("%s", why); }

void launch_start(void) {
    thread = (struct thread){.shared = shared,
                             .leave = leave,
                             .stop = stop_kernel,
                             .wrong_address = wrong_address,
                             .assertion = assertion,
                             .print = print,
                             .barrier = barrier,
                             .exchange = exchange};
    reverse_each = option("REVERSE", 0);
}

static void take_place(int number) {
    current = number;
    thread.tid[0] = number % thread.ntid[0];
    thread.tid[1] = number / thread.ntid[0] % thread.ntid[1];
    thread.tid[2] = number / thread.ntid[0] / thread.ntid[1];
    thread.lane = number % WARP;
}

static void run_in_turn(void) {
    char here;
    volatile int k = 0;
    thread.stack_high = (uint64_t)&here + PAGE, thread.stack_low = (uint64_t)&here - (1 << 20);
    if (_setjmp(next_thread)) k++; /* a thread left by exit */
    for (; k < thread_count; k++) {
        take_place(reversed ? thread_count - 1 - k : k);
        running->entry->run(parameters);
    }
}

static void coroutine(void) {
    running->entry->run(parameters);
    leave();
}

static void enter(int number) {
    static ucontext_t fresh;
    char *stack = stacks + (size_t)number * STACK;
    take_place(number);
    thread.stack_low = (uint64_t)stack, thread.stack_high = thread.stack_low + STACK;
    if (_setjmp(scheduler)) return;
    if (coroutines[number].state == READY) _longjmp(coroutines[number].place, 1);
    coroutines[number].state = READY;
    getcontext(&fresh);
    fresh.uc_stack.ss_sp = stack, fresh.uc_stack.ss_size = STACK, fresh.uc_link = 0;
    makecontext(&fresh, coroutine, 0);
    setcontext(&fresh);
}

/* What lane `own` of a warp gets; `all` are its coroutines, `present` the lanes that take part. */
static void settle_one(struct coroutine *all, int own, uint32_t present) {
    struct coroutine *lane = all + own;
    uint32_t ballot = 0;
    for (int k = 0; k < WARP; k++)
        if (present >> k & 1 && all[k].value) ballot |= 1u << k;
    int segment = lane->limits >> 8 & 31, clamp = lane->limits & 31, by = lane->operand & 31, from = own;
    int first = own & segment, last = first | (clamp & ~segment);
    switch (lane->what) {
    case SHUFFLE_UP:
        from = own - by;
        lane->valid = from >= last;
        break; /* here the limit is the first lane */
    case SHUFFLE_DOWN:
        from = own + by;
        lane->valid = from <= last;
        break;
    case SHUFFLE_XOR:
        from = own ^ by;
        lane->valid = from <= last;
        break;
    case SHUFFLE_INDEX:
        from = first | (by & ~segment);
        lane->valid = from <= last;
        break;
    case VOTE_BALLOT: lane->result = ballot; return;
    case VOTE_ANY: lane->result = ballot != 0; return;
    case VOTE_ALL: lane->result = ballot == present; return;
    case WARP_BARRIER: return;
    }
    if (!lane->valid || !(present >> from & 1)) from = own;
    lane->result = all[from].value;
}

/* Serves the groups of a warp whose members have all arrived; returns how many threads may go on. */
static int settle(struct coroutine *all, int lanes) {
    int served = 0;
    for (int own = 0; own < lanes; own++) {
        if (all[own].state != IN_EXCHANGE) continue;
        uint32_t present = 0;
        int complete = 1;
        for (int k = 0; k < lanes; k++) {
            if (!(all[own].members >> k & 1) || all[k].state == OVER) continue;
            present |= 1u << k;
            complete &= all[k].state == IN_EXCHANGE && all[k].what == all[own].what;
        }
        if (!complete) continue;
        for (int k = 0; k < lanes; k++)
            if (present >> k & 1) settle_one(all, k, present);
        for (int k = 0; k < lanes; k++)
            if (present >> k & 1) all[k].state = READY, served++;
    }
    return served;
}

static void run_together(void) {
    if (!stacks)
        stacks = mmap(0, (size_t)MOST_THREADS * STACK, PROT_READ | PROT_WRITE,
                      MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    for (int k = 0; k < thread_count; k++) coroutines[k].state = FRESH;
    as_coroutines = 1;
    for (int left = thread_count; left;) {
        int moved = 0, waiting = 0;
        for (int k = 0; k < thread_count; k++) {
            int number = reversed ? thread_count - 1 - k : k;
            if (coroutines[number].state <= READY) enter(number), moved++;
        }
        for (int k = 0; k < thread_count; k += WARP)
            moved += settle(coroutines + k, thread_count - k < WARP ? thread_count - k : WARP);
        left = 0;
        for (int k = 0; k < thread_count; k++)
            left += coroutines[k].state != OVER, waiting += coroutines[k].state == AT_BARRIER;
        if (waiting && waiting == left) {
            for (int k = 0; k < thread_count; k++)
                if (coroutines[k].state == AT_BARRIER) coroutines[k].state = READY;
        } else if (left && !moved) {
            stop("the threads of a block wait for one another for ever");
        }
    }
    as_coroutines = 0;
}

enum result launch(struct kernel *kernel, const uint32_t blocks[3], const uint32_t threads[3], void **arguments) {
    const struct entry *entry = kernel->entry;
    uint32_t count = blocks[0] * blocks[1] * blocks[2];
    thread_count = threads[0] * threads[1] * threads[2];
    if (!count || !thread_count || thread_count > MOST_THREADS) {
        fprintf(stderr, "cuda_on_cpu: %s is launched with %u blocks of %u threads\n", kernel->name, count,
                thread_count);
        return INVALID_VALUE;
    }
    for (int k = 0; k < entry->count; k++) memcpy(parameters + entry->offset[k], arguments[k], entry->bytes[k]);
    memcpy(thread.nctaid, blocks, sizeof thread.nctaid), memcpy(thread.ntid, threads, sizeof thread.ntid);
    unsigned rounding = _mm_getcsr();
    if (kernel->flushes_denormals) _mm_setcsr(rounding | FLUSH_DENORMALS);
    running = kernel;
    reversed = reverse_each && counters.launches % reverse_each == 0;
    for (uint32_t k = 0; k < count; k++) {
        uint32_t block = reversed ? count - 1 - k : k;
        thread.ctaid[0] = block % blocks[0], thread.ctaid[1] = block / blocks[0] % blocks[1],
        thread.ctaid[2] = block / blocks[0] / blocks[1];
        if (entry->exchanges) run_together();
        else run_in_turn();
    }
    running = 0;
    _mm_setcsr(rounding);
    kernel->launches++, counters.launches++;
    return SUCCESS;
}

const char *launch_running(void) { return running ? running->name : 0; }
