/* Modules: PTX is translated and compiled by module.py once, and kept by its text; the next process loads the library.
 *
 * Taichi's names of kernels hold counters of the process, so kernels are renamed by their place before anything else.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include "driver.h"

/* given by build.py: the folder of the compiled modules, the interpreter, the translator */
#ifndef FOLDER
#error "build with build.py"
#endif

enum { MOST_KERNELS = 1 << 16, MOST_ENTRIES = 256 };

struct module {
    struct kernel *kernels[MOST_ENTRIES]; /* Taichi asks for a kernel at each launch */
    char *names[MOST_ENTRIES], *ptx;
    int count, flushes_denormals;
    const struct entry *entries;
};

int cuda_on_cpu_kernel_count;
struct kernel *cuda_on_cpu_kernels[MOST_KERNELS];
extern char **environ;

static int is_word(char c) {
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '_' || c == '$';
}

static void find_entries(struct module *module, const char *ptx) {
    for (const char *at = ptx; (at = strstr(at, ".entry ")) && module->count < MOST_ENTRIES;) {
        at += strlen(".entry ");
        size_t length = 0;
        while (is_word(at[length])) length++;
        module->names[module->count++] = strndup(at, length);
    }
}

/* A copy of the text without comments, kernels and their parameters named kernel0, kernel0_param_0, ... */
static char *rename_entries(const struct module *module, const char *ptx) {
    size_t room = strlen(ptx) + 64;
    char *out = malloc(room * 2), *end = out;
    for (const char *at = ptx; *at;) {
        if (at[0] == '/' && at[1] == '/') {
            at += strcspn(at, "\n");
            continue;
        }
        size_t length = 0;
        while (is_word(at[length])) length++;
        for (int k = 0; length && k < module->count; k++) {
            size_t named = strlen(module->names[k]);
            if (strncmp(at, module->names[k], named) || (length > named && strncmp(at + named, "_param_", 7))) continue;
            end += sprintf(end, "kernel%d", k);
            at += named, length -= named;
            break;
        }
        if (!length && !is_word(*at)) length = 1;
        memcpy(end, at, length), end += length, at += length;
    }
    *end = 0;
    return out;
}

static uint64_t hash(const char *text, uint64_t seed) {
    for (; *text; text++) seed = (seed ^ (unsigned char)*text) * 0x100000001b3ull; /* FNV-1a */
    return seed;
}

static int write_file(const char *path, const char *text) {
    FILE *file = fopen(path, "w");
    if (!file) return -1;
    int status = fputs(text, file);
    return fclose(file) || status < 0 ? -1 : 0;
}

/* Makes `library` from `ptx`; files get their names at the end, because other processes look for them at the same time.
 */
static int compile(const char *ptx, const char *kept, const char *library) {
    char source[4096], target[4096];
    snprintf(source, sizeof source, "%s/%d.ptx", FOLDER, getpid()),
        snprintf(target, sizeof target, "%s/%d.so", FOLDER, getpid());
    if (write_file(source, ptx)) return -1;
    char *command[] = {PYTHON, "-S", "-E", TRANSLATOR, source, target, 0};
    pid_t child;
    int status;
    if (posix_spawn(&child, PYTHON, 0, 0, command, environ)) return -1;
    waitpid(child, &status, 0);
    if (status) fprintf(stderr, "cuda_on_cpu: %s cannot be translated\n", source);
    counters.compiled_modules++;
    return status || rename(source, kept) || rename(target, library) ? -1 : 0;
}

struct module *module_load(const char *ptx) {
    struct module *module = calloc(1, sizeof *module);
    char library[4096], kept[4096];
    find_entries(module, ptx);
    char *renamed = rename_entries(module, ptx);
    uint64_t first = hash(renamed, 0xcbf29ce484222325ull), second = hash(renamed, 0x9e3779b97f4a7c15ull);
    snprintf(library, sizeof library, "%s/%016lx%016lx.so", FOLDER, first, second);
    snprintf(kept, sizeof kept, "%s/%016lx%016lx.ptx", FOLDER, first, second);
    int failed = access(library, R_OK) && compile(renamed, kept, library);
    free(renamed);
    void *loaded = failed ? 0 : dlopen(library, RTLD_NOW | RTLD_LOCAL);
    if (!loaded) {
        fprintf(stderr, "cuda_on_cpu: %s\n", failed ? "a module cannot be compiled" : dlerror());
        return 0;
    }
    module->ptx = strdup(kept);
    module->entries = dlsym(loaded, "entries");
    module->flushes_denormals = *(int *)dlsym(loaded, "flushes_denormals");
    int bytes = *(int *)dlsym(loaded, "global_bytes");
    void *globals = 0;
    if (bytes && (memory_give(&globals, bytes) || memory_copy(globals, dlsym(loaded, "initial"), bytes, 1, 0)))
        return 0;
    if (*(int *)dlsym(loaded, "entry_count") != module->count || *(int *)dlsym(loaded, "shared_bytes") > SHARED_BYTES) {
        fprintf(stderr, "cuda_on_cpu: %s does not fit its module\n", library);
        return 0;
    }
    ((void (*)(struct thread *, uint64_t))dlsym(loaded, "bind"))(&thread, (uint64_t)globals);
    counters.modules++;
    return module;
}

struct kernel *module_kernel(struct module *module, const char *name) {
    for (int k = 0; k < module->count; k++) {
        if (strcmp(module->names[k], name)) continue;
        if (module->kernels[k]) return module->kernels[k];
        struct kernel *kernel = malloc(sizeof *kernel);
        *kernel = (struct kernel){module->names[k], 0, module->ptx, module->entries + k, module->flushes_denormals};
        module->kernels[k] = kernel;
        if (cuda_on_cpu_kernel_count < MOST_KERNELS) cuda_on_cpu_kernels[cuda_on_cpu_kernel_count++] = kernel;
        return kernel;
    }
    return 0;
}
