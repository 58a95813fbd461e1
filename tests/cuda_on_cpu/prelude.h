/* What each translated module begins with: PTX instructions that are no operator of C. Rounding is to nearest, and the
 * approximate instructions (div.approx, rcp.approx, sin.approx...) are those of the processor and of libm. */
#include <math.h>
#include <string.h>

#include "device.h"

static struct thread *T;
uint64_t globals; /* device address of the module's variables */
void bind(struct thread *thread, uint64_t address) { T = thread, globals = address; }

#define INLINE static inline __attribute__((always_inline))

/* ---- memory ---- */
INLINE char *resolve(uint64_t address, int bytes) {
    uint64_t offset = address - DEVICE_BASE;
    if (__builtin_expect(offset < DEVICE_SPAN && ALLOCATED[offset >> PAGE_BITS] && !(address & (bytes - 1)), 1))
        return (char *)(address + SHIFT);
    if (address - T->stack_low < T->stack_high - T->stack_low || address - (uint64_t)T->shared < SHARED_BYTES)
        return (char *)address;
    T->wrong_address(address, bytes);
    return 0;
}
#define CHECKED(type, address) (*(type *)resolve(address, sizeof(type)))
#define OWN(type, address) (*(type *)(address)) /* parameters, locals, shared: places known while compiling */

/* ---- bits ---- */
INLINE uint32_t bits_f32(float x) {
    uint32_t y;
    memcpy(&y, &x, 4);
    return y;
}
INLINE uint64_t bits_f64(double x) {
    uint64_t y;
    memcpy(&y, &x, 8);
    return y;
}
INLINE float f32_bits(uint32_t x) {
    float y;
    memcpy(&y, &x, 4);
    return y;
}
INLINE double f64_bits(uint64_t x) {
    double y;
    memcpy(&y, &x, 8);
    return y;
}
INLINE uint32_t clz_b32(uint32_t x) { return x ? __builtin_clz(x) : 32; }
INLINE uint32_t clz_b64(uint64_t x) { return x ? __builtin_clzll(x) : 64; }
INLINE uint32_t popc_b32(uint32_t x) { return __builtin_popcount(x); }
INLINE uint32_t popc_b64(uint64_t x) { return __builtin_popcountll(x); }
INLINE uint64_t brev_b64(uint64_t x) {
    uint64_t y = 0;
    for (int i = 0; i < 64; i++) y |= (x >> i & 1) << (63 - i);
    return y;
}
INLINE uint32_t brev_b32(uint32_t x) { return brev_b64(x) >> 32; }
INLINE uint32_t prmt_b32(uint32_t a, uint32_t b, uint32_t selector) {
    uint64_t both = (uint64_t)b << 32 | a, out = 0;
    for (int i = 0; i < 4; i++) {
        uint32_t choice = selector >> 4 * i & 15, byte = both >> 8 * (choice & 7) & 255;
        out |= (uint64_t)(choice & 8 ? (byte & 128 ? 255 : 0) : byte) << 8 * i;
    }
    return out;
}
INLINE uint32_t shf_l(uint32_t low, uint32_t high, uint32_t n) { return ((uint64_t)high << 32 | low) << n >> 32; }
INLINE uint32_t shf_r(uint32_t low, uint32_t high, uint32_t n) { return ((uint64_t)high << 32 | low) >> n; }
/* A field of `length` bits from `start` on; the sign is that of its last bit inside the word. */
INLINE uint64_t field(uint64_t x, uint32_t start, uint32_t length, int bits, int is_signed) {
    uint64_t out = 0, sign = 0;
    start &= 255, length &= 255;
    if (is_signed && length) sign = x >> (start + length - 1 < bits - 1 ? start + length - 1 : bits - 1) & 1;
    for (int i = 0; i < bits; i++) out |= (i < length && start + i < bits ? x >> (start + i) & 1 : sign) << i;
    return out;
}
INLINE uint64_t insert(uint64_t part, uint64_t into, uint32_t start, uint32_t length, int bits) {
    for (uint32_t i = 0; i < (length & 255) && (start & 255) + i < bits; i++)
        into = (into & ~(1ull << (start + i))) | (part >> i & 1) << (start + i);
    return into;
}

/* ---- arithmetic ---- */
#define INTEGERS(X) X(s16, int16_t) X(u16, uint16_t) X(s32, int32_t) X(u32, uint32_t) X(s64, int64_t) X(u64, uint64_t)
#define X(name, type) \
    INLINE type min_##name(type a, type b) { return a < b ? a : b; } \
    INLINE type max_##name(type a, type b) { return a > b ? a : b; } \
    INLINE type abs_##name(type a) { return a < 0 ? -a : a; } \
    INLINE type div_##name(type a, type b) { \
        return !b ? (type) - 1 : b == (type) - 1 && (type) - 1 < 0 ? -a : a / b; \
    } \
    INLINE type rem_##name(type a, type b) { return !b ? a : b == (type) - 1 && (type) - 1 < 0 ? 0 : a % b; }
INTEGERS(X)
#undef X
/* Of a number and a NaN the number; -0 is below +0. */
#define REALS(name, type, bits, suffix) \
    INLINE type min_##name(type a, type b) { \
        return a != a ? b : b != b ? a : a == b ? (signbit(a) ? a : b) : a < b ? a : b; \
    } \
    INLINE type max_##name(type a, type b) { \
        return a != a ? b : b != b ? a : a == b ? (signbit(a) ? b : a) : a > b ? a : b; \
    } \
    INLINE type abs_##name(type a) { return __builtin_fabs##suffix(a); } \
    INLINE type fma_##name(type a, type b, type c) { return __builtin_fma##suffix(a, b, c); } \
    INLINE type sqrt_##name(type a) { return __builtin_sqrt##suffix(a); } \
    INLINE type rsqrt_##name(type a) { return 1 / __builtin_sqrt##suffix(a); } \
    INLINE type rcp_##name(type a) { return 1 / a; } \
    INLINE type sin_##name(type a) { return sin##suffix(a); } \
    INLINE type cos_##name(type a) { return cos##suffix(a); } \
    INLINE type lg2_##name(type a) { return log2##suffix(a); } \
    INLINE type ex2_##name(type a) { return exp2##suffix(a); } \
    INLINE type tanh_##name(type a) { return tanh##suffix(a); } \
    INLINE type copysign_##name(type sign, type size) { return __builtin_copysign##suffix(size, sign); } \
    INLINE type saturated_##name(type a) { return a > 0 ? (a < 1 ? a : 1) : 0; }
REALS(f32, float, uint32_t, f)
REALS(f64, double, uint64_t, )

/* A real number becomes the nearest integer that there is; NaN becomes 0. */
#define X(name, type) \
    INLINE type to_##name(double x) { \
        const type least = (type) - 1 < 0 ? (type)(1ull << (8 * sizeof(type) - 1)) : 0, most = ~least; \
        return x != x ? 0 : x <= (double)least ? least : x >= (double)most ? most : (type)x; \
    }
INTEGERS(X)
X(s8, int8_t) X(u8, uint8_t)
#undef X
