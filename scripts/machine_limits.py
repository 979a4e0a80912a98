"""What one core of this machine can do at most: bytes and vector instructions per second of processor time."""

import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

_COPY_BYTES = 256 << 20  # far beyond any cache

# Twelve chains of min and add: none waits for another, and all stay in the 16 registers with two constants. The
# empty asm keeps the compiler from moving all mins before all adds, for which the registers would not do.
_VECTOR_PROGRAM = r"""
#include <immintrin.h>
#include <stdio.h>
#include <time.h>

#if BYTES == 64
typedef __m512i vector;
#define SET _mm512_set1_epi8
#define MIN _mm512_min_epu8
#define ADD _mm512_add_epi8
#define XOR _mm512_xor_si512
#define LOW(v) _mm_cvtsi128_si32(_mm512_castsi512_si128(v))
#define SUPPORTED __builtin_cpu_supports("avx512bw")
#else
typedef __m256i vector;
#define SET _mm256_set1_epi8
#define MIN _mm256_min_epu8
#define ADD _mm256_add_epi8
#define XOR _mm256_xor_si256
#define LOW(v) _mm_cvtsi128_si32(_mm256_castsi256_si128(v))
#define SUPPORTED __builtin_cpu_supports("avx2")
#endif

#define TWELVE(DO) DO(0) DO(1) DO(2) DO(3) DO(4) DO(5) DO(6) DO(7) DO(8) DO(9) DO(10) DO(11)
#define START(i) vector v##i = SET((char)(argc + i));
#define STEP(i) \
    v##i = ADD(MIN(v##i, limit), one); \
    __asm__ volatile("" : "+x"(v##i));
#define GATHER(i) sum = XOR(sum, v##i);

static int run(int argc) {
    const long rounds = 100000000;
    const vector limit = SET((char)(argc + 200)), one = SET((char)argc);
    TWELVE(START)
    struct timespec start, end;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &start);
    for (long r = 0; r < rounds; r++) {
        TWELVE(STEP)
    }
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &end);
    vector sum = SET(0);
    TWELVE(GATHER)
    const double seconds = (double)(end.tv_sec - start.tv_sec) + 1e-9 * (double)(end.tv_nsec - start.tv_nsec);
    /* The sum is printed so that the work cannot be left out. */
    printf("%.6g %d\n", 24.0 * (double)rounds / seconds, LOW(sum));
    return 0;
}

int main(int argc, char **argv) {
    (void)argv;
    return SUPPORTED ? run(argc) : 2;
}
"""
_FLAGS = {32: ("AVX2", "-mavx2"), 64: ("AVX-512", "-mavx512bw")}


def copy_bandwidth(runs: int = 5) -> float:
    """Bytes read and written per second when one thread copies large arrays; the best of `runs`."""
    source = np.ones(_COPY_BYTES, dtype=np.uint8)
    target = np.zeros_like(source)
    seconds = []
    for _ in range(runs):
        start = time.process_time()
        np.copyto(target, source)
        seconds.append(time.process_time() - start)
    return 2 * _COPY_BYTES / min(seconds)


def vector_throughput(register: int, runs: int = 3) -> float | str:
    """Independent vector instructions per second of one core, the best of `runs`; or why that is unknown.

    Parameters
    ----------
    register : int
        Bytes of a vector: 32 or 64.
    runs : int
        Times to measure.

    Returns
    -------
    float or str
        Instructions per second, or a sentence where there is no C compiler or no such vector.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        return "there is no C compiler (cc)"
    name, flag = _FLAGS[register]
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "vectors"
        source = program.with_suffix(".c")
        source.write_text(_VECTOR_PROGRAM, encoding="utf-8")
        built = subprocess.run(
            [compiler, "-O2", flag, f"-DBYTES={register}", source, "-o", program], capture_output=True
        )
        if built.returncode:
            return f"the C compiler knows no {name}"
        results = [subprocess.run([program], capture_output=True, text=True) for _ in range(runs)]
    if any(result.returncode for result in results):
        return f"the processor has no {name}"
    return max(float(result.stdout.split()[0]) for result in results)
