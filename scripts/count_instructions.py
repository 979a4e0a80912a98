"""Instructions of the kernels: NEON's, under emulation, against AVX2's.

    apt install gcc-aarch64-linux-gnu qemu-user valgrind        # and clang for another column
    python scripts/count_instructions.py --output FOLDER [--compiler gcc clang]

Builds tests/kernel_hashes for both processors, and prints what one more call of a kernel takes per pixel, or per
slot where pixels have 64 of them. Of AVX2 valgrind counts the instructions, of NEON a plugin of qemu.
"""

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarking import table

ROOT = Path(__file__).resolve().parents[1]
KERNELS = (
    *("census", "cost", "aggregation", "selection", "match", "fit_offsets", "mean_offsets", "depth_candidates"),
    *("vote_depth", "compare_depths", "fit_planes", "add_patch_equations"),
)
COMPILERS = {"gcc": ["aarch64-linux-gnu-gcc"], "clang": ["clang", "--target=aarch64-linux-gnu"]}

# Debian's qemu comes without plugins and without their header.
PLUGIN = """
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
struct qemu_plugin_tb;
void qemu_plugin_register_vcpu_tb_trans_cb(uint64_t, void (*)(uint64_t, struct qemu_plugin_tb *));
size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb *);
void qemu_plugin_register_vcpu_tb_exec_inline(struct qemu_plugin_tb *, int, void *, uint64_t);
void qemu_plugin_register_atexit_cb(uint64_t, void (*)(uint64_t, void *), void *);
int qemu_plugin_version = 1;
static uint64_t count;
static void add(uint64_t id, struct qemu_plugin_tb *block) {
    (void)id;
    qemu_plugin_register_vcpu_tb_exec_inline(block, 0, &count, qemu_plugin_tb_n_insns(block));
}
static void print(uint64_t id, void *none) {
    (void)id;
    (void)none;
    fprintf(stderr, "Collected : %llu\\n", (unsigned long long)count);
}
int qemu_plugin_install(uint64_t id, const void *info, int count_, char **arguments) {
    (void)info;
    (void)count_;
    (void)arguments;
    qemu_plugin_register_vcpu_tb_trans_cb(id, add);
    qemu_plugin_register_atexit_cb(id, print, NULL);
    return 0;
}
"""


def run(command: Sequence[str | os.PathLike[str]]) -> str:
    """What a command writes; the program ends where it fails."""
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"error: {command[0]}: {done.stdout}{done.stderr}")
    return done.stdout + done.stderr


def build(folder: Path, *options: str) -> Path:
    """tests/kernel_hashes built in a folder."""
    fixed = ["-DCOLMAP_SPH_MODULE=OFF", "-DCOLMAP_SPH_KERNEL_HASHES=ON", "-DCMAKE_BUILD_TYPE=Release"]
    run(["cmake", "-S", ROOT, "-B", folder, *fixed, *options])
    run(["cmake", "--build", folder])
    return folder / "kernel_hashes"


def build_for_aarch64(folder: Path, compiler: Sequence[str]) -> Path:
    """The same for aarch64."""
    options = [f"-DCMAKE_C_COMPILER={compiler[0]}", f"-DCMAKE_C_FLAGS={' '.join(compiler[1:])}"]
    return build(folder, "-DCMAKE_SYSTEM_NAME=Linux", "-DCMAKE_SYSTEM_PROCESSOR=aarch64", *options)


def count(runner: Sequence[str | os.PathLike[str]], program: Path, version: str, kernel: str) -> float:
    """Instructions per pixel or slot of a kernel."""
    counts = []
    for calls in ("1", "3"):
        written = run([*runner, program, "--run", version, kernel, calls])
        size = int(written.split(maxsplit=1)[0])
        counts.append(int(re.findall(r"Collected : (\d+)", written)[0]))
    return (counts[1] - counts[0]) / 2 / size


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--compiler", nargs="+", choices=COMPILERS, default=["gcc"])
    arguments = parser.parse_args()
    output: Path = arguments.output
    output.mkdir(parents=True, exist_ok=True)
    source, plugin = output / "plugin.c", output / "libcount.so"
    source.write_text(PLUGIN)
    run(["cc", "-O1", "-shared", "-fPIC", "-o", plugin, source])
    valgrind = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null"]
    qemu: list[str | os.PathLike[str]] = [
        "qemu-aarch64",
        "-plugin",
        plugin.resolve(),
        "-L",
        "/usr/aarch64-linux-gnu",
    ]
    here = build(output / "here")
    there = [build_for_aarch64(output / name, COMPILERS[name]) for name in arguments.compiler]
    rows = []
    for kernel in KERNELS:
        avx2 = count(valgrind, here, "avx2", kernel)
        row = [kernel, f"{avx2:.2f}"]
        for program in there:
            neon = count(qemu, program, "neon", kernel)
            row += [f"{neon:.2f}", f"{neon / avx2:.2f}"]
        rows.append(row)
    header = ["kernel", "AVX2"]
    for name in arguments.compiler:
        header += [f"NEON, {name}", "ratio"]
    print(table(header, rows))


if __name__ == "__main__":
    main()
