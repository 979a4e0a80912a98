/* Asked by CPUID and XGETBV: __builtin_cpu_supports needs compiler-rt or libgcc, without which (zig) it says no to
 * everything, so that kernels would be scalar without a word. */
#include "processor.h"

#ifdef __x86_64__

#include <cpuid.h>
#include <stdatomic.h>
#include <stdint.h>

typedef struct {
    uint32_t eax, ebx, ecx, edx;
} cpuid_leaf;

/* All zero where the processor has no such leaf. */
static cpuid_leaf read_leaf(uint32_t leaf) {
    cpuid_leaf r = {0, 0, 0, 0};
    if (!__get_cpuid_count(leaf, 0, &r.eax, &r.ebx, &r.ecx, &r.edx)) {
        r = (cpuid_leaf){0, 0, 0, 0};
    }
    return r;
}

static int has_bits(uint32_t word, uint32_t bits) { return (word & bits) == bits; }

/* Whether the operating system keeps these parts of the registers (bits of XCR0) when threads take turns. */
static int system_keeps(uint32_t parts) {
    if (!has_bits(read_leaf(1).ecx, bit_OSXSAVE)) {
        return 0;
    }
    uint32_t low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    (void)high;
    return has_bits(low, parts);
}

enum {
    XMM_AND_YMM = 0x06,
#ifdef __APPLE__
    AVX512_STATE = XMM_AND_YMM /* macOS sets the other bits at a thread's first AVX-512 instruction only */
#else
    AVX512_STATE = 0xe6 /* masks, the upper halves of zmm0 to zmm15, and zmm16 to zmm31 */
#endif
};

static int runs_avx2(void) {
    return has_bits(read_leaf(1).ecx, bit_AVX | bit_POPCNT) && has_bits(read_leaf(7).ebx, bit_AVX2) &&
           system_keeps(XMM_AND_YMM);
}

static int runs_avx512bw(void) {
    return runs_avx2() && system_keeps(AVX512_STATE) &&
           has_bits(read_leaf(7).ebx, bit_AVX512F | bit_AVX512DQ | bit_AVX512BW | bit_AVX512VL);
}

static int runs_avx512(void) {
    const cpuid_leaf leaf = read_leaf(7);
    return runs_avx512bw() && has_bits(leaf.ebx, bit_AVX512IFMA) &&
           has_bits(leaf.ecx, bit_AVX512VBMI | bit_AVX512VPOPCNTDQ);
}

/* What was found is kept: on a virtual machine CPUID takes tens of microseconds, and every call of a kernel asks.
 * Threads that ask at the same time find the same. */
typedef _Atomic int answer;

enum { UNKNOWN, NO, YES };

static int kept(answer *known, int (*ask)(void)) {
    int found = atomic_load_explicit(known, memory_order_relaxed);
    if (found == UNKNOWN) {
        found = ask() ? YES : NO;
        atomic_store_explicit(known, found, memory_order_relaxed);
    }
    return found == YES;
}

int processor_has_avx2(void) {
    static answer known;
    return kept(&known, runs_avx2);
}

int processor_has_avx512bw(void) {
    static answer known;
    return kept(&known, runs_avx512bw);
}

int processor_has_avx512(void) {
    static answer known;
    return kept(&known, runs_avx512);
}

#endif
