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

#define TWELVE(DO) DO(0) DO(1) DO(2) DO(3) DO(4) DO(5) DO(6) DO(7) DO(8) DO(9) DO(10) DO(11)
#define START(i) __m256i v##i = _mm256_set1_epi8((char)(argc + i));
#define STEP(i) \
    v##i = _mm256_add_epi8(_mm256_min_epu8(v##i, limit), one); \
    __asm__ volatile("" : "+x"(v##i));
#define GATHER(i) sum = _mm256_xor_si256(sum, v##i);

int main(int argc, char **argv) {
    (void)argv;
    if (!__builtin_cpu_supports("avx2")) {
        return 2;
    }
    const long rounds = 100000000;
    const __m256i limit = _mm256_set1_epi8((char)(argc + 200)), one = _mm256_set1_epi8((char)argc);
    TWELVE(START)
    struct timespec start, end;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &start);
    for (long r = 0; r < rounds; r++) {
        TWELVE(STEP)
    }
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &end);
    __m256i sum = _mm256_setzero_si256();
    TWELVE(GATHER)
    const double seconds = (double)(end.tv_sec - start.tv_sec) + 1e-9 * (double)(end.tv_nsec - start.tv_nsec);
    /* The sum is printed so that the work cannot be left out. */
    printf("%.6g %d\n", 24.0 * (double)rounds / seconds, _mm256_extract_epi8(sum, 0));
    return 0;
}
"""


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


def vector_throughput(runs: int = 3) -> float | str:
    """Independent 32-byte vector instructions per second of one core, the best of `runs`; or why that is unknown.

    Returns
    -------
    float or str
        Instructions per second, or a sentence where there is no C compiler or no AVX2.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        return "there is no C compiler (cc)"
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "vectors"
        source = program.with_suffix(".c")
        source.write_text(_VECTOR_PROGRAM, encoding="utf-8")
        built = subprocess.run([compiler, "-O2", "-mavx2", source, "-o", program], capture_output=True)
        if built.returncode:
            return "the C compiler knows no AVX2"
        results = [subprocess.run([program], capture_output=True, text=True) for _ in range(runs)]
    if any(result.returncode for result in results):
        return "the processor has no AVX2"
    return max(float(result.stdout.split()[0]) for result in results)
