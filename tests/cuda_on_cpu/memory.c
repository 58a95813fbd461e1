/* Device memory: whole pages in the forbidden window, a page that belongs to nobody between one piece and the next. */
#define _GNU_SOURCE
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>

#include "driver.h"

enum { SMALL = 1024 }; /* pages: pieces up to this size are used again, larger ones leave their addresses for good */

static uint8_t *const allocated = (uint8_t *)ALLOCATED;
static uint64_t next_page = 1, used_pages, limit_pages;
static uint32_t *pages_of; /* length of the piece that starts at a page */
static uint64_t
    free_pieces[SMALL + 1]; /* by length, the first page of a free piece, which holds the number of the next */
static int poison;

static char *page_memory(uint64_t page) { return (char *)(DEVICE_BASE + SHIFT + page * PAGE); }

static void *reserve(uint64_t address, uint64_t bytes, int access) {
    void *at = mmap((void *)address, bytes, access,
                    MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE | (address ? MAP_FIXED_NOREPLACE : 0), -1, 0);
    if (at == MAP_FAILED || (address && at != (void *)address))
        stop("no room for %llu GB of addresses", (unsigned long long)bytes >> 30);
    return at;
}

void memory_start(void) {
    const int open = PROT_READ | PROT_WRITE;
    reserve(DEVICE_BASE, DEVICE_SPAN, PROT_NONE);
    madvise(reserve(DEVICE_BASE + SHIFT, DEVICE_SPAN, open), DEVICE_SPAN, MADV_NOHUGEPAGE);
    reserve((uint64_t)ALLOCATED, DEVICE_SPAN / PAGE, open);
    pages_of = reserve(0, DEVICE_SPAN / PAGE * sizeof *pages_of, open);
    limit_pages = ((uint64_t)option("MEMORY_MB", 8192) << 20) / PAGE;
    poison = option("POISON", 0);
}

enum result memory_give(void **out, size_t bytes) {
    uint64_t pages = bytes ? (bytes + PAGE - 1) / PAGE : 1, page;
    if (used_pages + pages > limit_pages) return OUT_OF_MEMORY;
    if (pages <= SMALL && free_pieces[pages]) {
        page = free_pieces[pages];
        memcpy(&free_pieces[pages], page_memory(page), sizeof page);
    } else {
        page = next_page;
        if ((page + pages + 1) * PAGE > DEVICE_SPAN) return OUT_OF_MEMORY;
        next_page += pages + 1;
    }
    memset(allocated + page, 1, pages);
    pages_of[page] = pages, used_pages += pages;
    if (poison && pages <= SMALL)
        memset(page_memory(page), 0xff, pages * PAGE); /* NaN as real numbers, -1 as integers */
    *out = (void *)(DEVICE_BASE + page * PAGE);
    counters.allocations++;
    return SUCCESS;
}

enum result memory_take_back(void *device) {
    uint64_t offset = (uint64_t)device - DEVICE_BASE, page = offset / PAGE;
    if (!device) return SUCCESS;
    if (offset >= DEVICE_SPAN || offset % PAGE || !pages_of[page]) {
        fprintf(stderr, "cuda_on_cpu: %p is freed, but was not given out\n", device);
        return INVALID_VALUE;
    }
    uint64_t pages = pages_of[page];
    memset(allocated + page, 0, pages);
    pages_of[page] = 0, used_pages -= pages;
    if (pages <= SMALL) {
        memcpy(page_memory(page), &free_pieces[pages], sizeof page);
        free_pieces[pages] = page;
    } else {
        madvise(page_memory(page), pages * PAGE, MADV_DONTNEED);
    }
    counters.frees++;
    return SUCCESS;
}

int memory_is_device(const void *address) {
    uint64_t offset = (uint64_t)address - DEVICE_BASE;
    return offset < DEVICE_SPAN && allocated[offset / PAGE];
}

/* Turns an address of the device into the place where its memory lies; 0 if there is none. */
static int reach(const void **address, size_t bytes) {
    const char *first = *address;
    if (!bytes) return 1;
    *address = first + SHIFT;
    if (memory_is_device(first) && memory_is_device(first + bytes - 1)) return 1;
    fprintf(stderr, "cuda_on_cpu: %zu bytes at %p are copied or filled, which are not the device's\n", bytes,
            (void *)first);
    return 0;
}

enum result memory_copy(void *to, const void *from, size_t bytes, int to_device, int from_device) {
    const void *target = to, *source = from;
    if ((to_device && !reach(&target, bytes)) || (from_device && !reach(&source, bytes))) return INVALID_VALUE;
    memmove((void *)target, source, bytes);
    if (to_device && from_device) counters.copies_on_device++, counters.bytes_on_device += bytes;
    else if (to_device) counters.copies_to_device++, counters.bytes_to_device += bytes;
    else counters.copies_to_host++, counters.bytes_to_host += bytes;
    return SUCCESS;
}

enum result memory_fill(void *device, uint32_t value, size_t count, int bytes_each) {
    const void *target = device;
    if (!reach(&target, count * bytes_each)) return INVALID_VALUE;
    if (bytes_each == 1 || !value) memset((void *)target, value, count * bytes_each);
    else
        for (size_t i = 0; i < count; i++) memcpy((char *)target + i * bytes_each, &value, bytes_each);
    counters.fills++;
    return SUCCESS;
}

void memory_left(size_t *unused, size_t *total) {
    *total = limit_pages * PAGE;
    *unused = (limit_pages - used_pages) * PAGE;
}

const char *memory_complaint(uint64_t address, int bytes) {
    if (address < PAGE) return "a null pointer";
    if (memory_is_device((void *)address)) return "not aligned";
    if (address - DEVICE_BASE < DEVICE_SPAN) return "past the end of an array, or in one that was freed";
    return "not the device's memory: a pointer of the host?";
}
