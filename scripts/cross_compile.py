"""Compile this program for every platform that has wheels, look into what comes out, and run what can be run here.

    pip install ziglang cmake ninja scikit-build-core abi3audit
    apt install llvm qemu-user libc6-arm64-cross wine64
    python scripts/cross_compile.py --output FOLDER

For each target, zig's clang makes a wheel, and of its kernels the program of tests/kernel_hashes; a warning is an
error. Checked of the wheel's module: the file's format; that it exports PyInit__native, takes of Python only the
stable interface (abi3audit) and of other libraries only the system's, of glibc what 2.28 has; and that it holds
what only the kernels of the target's instruction sets have (llvm-objdump). The program runs here, under qemu-user
and Wine: it compares the versions of kernels with the scalar ones, and must say the same on every target.

Exit code 0: all passed, 1: something failed, 2: nothing failed, but something was not checked, for want of a
program of those above. What no program can check here, macOS's kernels at work, is said and no failure.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cross.python_headers import write_headers, write_import_library
from cross.targets import TARGETS, Target

_REPOSITORY = Path(__file__).resolve().parents[1]
_ARM_LIBRARIES = Path("/usr/aarch64-linux-gnu")  # of libc6-arm64-cross
_WINE = ("wine64", "/usr/lib/wine/wine64", "wine")
_FEW = 5  # finds of an instruction set: fewer are no kernels
_OLDEST_GLIBC = (2, 28)
# zig knows no bundles, which CMake makes of macOS's modules; Python takes shared libraries as well. CMake asks for
# libdl, which Linux's Python needs that runs this.
_COMPILER = """\
#!/bin/sh
for word do
    shift
    case $word in
    -bundle) set -- "$@" -shared ;;
    -ldl) ;;
    *) set -- "$@" "$word" ;;
    esac
done
exec "{python}" -m ziglang cc -target {target} "$@"
"""


class CheckError(Exception):
    """Something is wrong, in a sentence."""


class MissingProgramError(Exception):
    """A check cannot be made for want of a program: its name."""


@dataclass(frozen=True)
class Build:
    """A target, and the folder of all that is made for it."""

    target: Target
    folder: Path

    @property
    def program(self) -> Path:
        return self.folder / "wheel" / f"kernel_hashes{self.target.program_suffix}"

    @property
    def module(self) -> Path:
        return self.folder / self.target.module


# ---- building ----------------------------------------------------------------------------------------------


def run(
    command: Sequence[str | Path], environment: Mapping[str, str] | None = None, *, with_errors: bool = False
) -> str:
    """What a command prints, also as errors; raises `CheckError` with its last lines where it fails."""
    done = subprocess.run(
        [str(word) for word in command],
        cwd=_REPOSITORY,
        env={**os.environ, **(environment or {})},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
    )
    if done.returncode:
        said = "\n".join((done.stdout + done.stderr).splitlines()[-30:])
        raise CheckError(f"{Path(command[0]).name} {command[1]} ended with {done.returncode}:\n{said}")
    return done.stdout + done.stderr if with_errors else done.stdout


def definitions(build: Build) -> dict[str, str]:
    """CMake's variables for a target."""
    compiler = build.folder / "cc"
    compiler.write_text(_COMPILER.format(python=sys.executable, target=build.target.zig))
    compiler.chmod(0o755)
    return {
        "CMAKE_C_COMPILER": str(compiler),
        "CMAKE_SYSTEM_NAME": build.target.system,
        "CMAKE_SYSTEM_PROCESSOR": build.target.processor,
        "CMAKE_COMPILE_WARNING_AS_ERROR": "ON",
        "COLMAP_SPH_KERNEL_HASHES": "ON",
        "CMAKE_LINK_DEPENDS_USE_LINKER": "OFF",  # zig's linker writes no such lists
    }


def build_wheel(build: Build) -> Path:
    """The target's wheel, made as `pip wheel` would make it there; and, of its kernels, `Build.program`."""
    defined = {**definitions(build), "Python_INCLUDE_DIR": str(write_headers(build.folder, build.target))}
    if build.target.system == "Windows":
        defined["Python_SABI_LIBRARY"] = str(
            write_import_library(build.folder, _REPOSITORY / "colmap_sph/_native")
        )
    settings = {f"cmake.define.{name}": value for name, value in defined.items()}
    settings |= {"build-dir": str(build.program.parent), "install.strip": "false"}
    call = f"from scikit_build_core.build import build_wheel as b; print(b({str(build.folder)!r}, {settings!r}))"
    environment = {"_PYTHON_HOST_PLATFORM": build.target.platform, "CMAKE_GENERATOR": "Ninja"}
    wheel = build.folder / run([sys.executable, "-c", call], environment).splitlines()[-1]
    if not wheel.name.endswith(f"-cp311-abi3-{build.target.name}.whl"):
        raise CheckError(f"the wheel is called {wheel.name}")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        module = f"colmap_sph/{build.target.module}"
        if module not in names:
            raise CheckError(f"the wheel has {[name for name in names if '_native' in name]}, not {module}")
        build.module.write_bytes(archive.read(module))
    return wheel


# ---- looking at what comes out -----------------------------------------------------------------------------


def program(*names: str) -> str:
    """The first of some programs that is installed."""
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        raise MissingProgramError(names[0])
    return found


def check_interface(build: Build) -> str:
    """What the module exports, and the libraries it takes."""
    headers = run([program("llvm-objdump"), "-p", build.module])
    if f"file format {build.target.file_format}" not in headers:
        raise CheckError(f"the module is no {build.target.file_format}: {headers[:200]}")
    exported = headers
    if build.target.system != "Windows":
        which = "-D" if build.target.system == "Linux" else "-g"
        exported = run([program("llvm-nm"), "--defined-only", which, build.module])
    if not re.search(r"\b_?PyInit__native\b", exported):
        raise CheckError("the module does not export PyInit__native")
    libraries = set(re.findall(r"(?:NEEDED|DLL Name:|^\s+name)\s+(\S+)", headers, re.MULTILINE))
    foreign = sorted(name for name in libraries if not re.fullmatch(build.target.libraries, name))
    if foreign:
        raise CheckError(f"the module takes from {', '.join(foreign)}")
    glibc = {(int(a), int(b)) for a, b in re.findall(r"GLIBC_(\d+)\.(\d+)", headers)}
    if glibc and max(glibc) > _OLDEST_GLIBC:
        raise CheckError(f"the module takes symbols of glibc {max(glibc)}")
    newest = f", glibc {'.'.join(map(str, max(glibc)))} at the newest" if glibc else ""
    return f"{build.target.file_format}, exports PyInit__native, takes from {', '.join(sorted(libraries))}{newest}"


def check_stable_interface(build: Build, wheel: Path) -> str:
    """Whether Python 3.11's stable interface is all that the module takes from Python."""
    run([program("abi3audit", str(Path(sys.executable).with_name("abi3audit"))), "--strict", "--summary", wheel])
    return "only Python's stable interface"


def check_kernels(build: Build) -> str:
    """How often the code has what only an instruction set's kernels have."""
    code = run([program("llvm-objdump"), "-d", "--no-show-raw-insn", build.module])
    counts = {name: len(re.findall(pattern, code)) for name, pattern in build.target.kernels.items()}
    lacking = [name for name, count in counts.items() if count < _FEW]
    if lacking:
        raise CheckError(f"the module has no {' and no '.join(lacking)} kernels ({counts})")
    return "kernels " + ", ".join(f"{name} ({count} finds)" for name, count in counts.items())


# ---- running -----------------------------------------------------------------------------------------------


def run_program(build: Build) -> str:
    """What the target's program prints: hashes of the results of all kernels, and the versions that it ran."""
    environment = {}
    before: list[str] = []
    if build.target.emulator == "qemu":
        before = [program("qemu-aarch64"), "-L", str(_ARM_LIBRARIES)]
        if not _ARM_LIBRARIES.is_dir():
            raise MissingProgramError("libc6-arm64-cross")
    elif build.target.emulator == "wine":
        before = [program(*_WINE)]
        environment = {
            "WINEPREFIX": str(build.folder / "wine"),
            "WINEDEBUG": "-all",
            "WINEDLLOVERRIDES": "mscoree,mshtml=",
        }
    return run([*before, build.program], environment, with_errors=True)


def compare(said: str, others: dict[str, list[str]], target: Target) -> str:
    """How many results are those of the targets before; raises `CheckError` where one is not.

    It does, too, where the program took its processor for a lesser one.
    """
    versions = re.findall(r"^kernels: (\w+)", said, re.MULTILINE)
    has_avx2 = " avx2 " in Path("/proc/cpuinfo").read_text()
    needed = "neon" if "neon" in target.kernels else "avx2" if has_avx2 else "scalar"
    if needed not in versions:
        raise CheckError(f"the program ran {', '.join(versions)} alone, where the processor has {needed}")
    results = re.findall(r"^\w+(?: \d+){4} [0-9a-f]{16}$", said, re.MULTILINE)  # Wine has words of its own, too
    known = ", ".join(others)
    for other, expected in others.items():
        if results != expected:
            different = [line for line in results if line not in expected]
            raise CheckError(f"results differ from those on {other}: {'; '.join(different[:5])}")
    others[target.name] = results
    same = f", the same as on {known}" if known else ""
    return f"{len(results)} results of kernels, the same by {', '.join(versions)}{same}"


# ---- all of it ---------------------------------------------------------------------------------------------


def check_target(build: Build, hashes: dict[str, list[str]]) -> tuple[list[str], list[str]]:
    """Build and check a target: sentences of what is right, and what was not checked for want of programs."""
    right, missing = [], []
    build.folder.mkdir(parents=True, exist_ok=True)
    wheel = build_wheel(build)
    right.append(f"built {wheel.name} without a warning")
    checks: list[Callable[[], str]] = [
        lambda: check_interface(build),
        lambda: check_stable_interface(build, wheel),
        lambda: check_kernels(build),
    ]
    if build.target.emulator:
        checks.append(lambda: compare(run_program(build), hashes, build.target))
    for check in checks:
        try:
            right.append(check())
        except MissingProgramError as error:
            missing.append(f"not checked for want of {error}")
    return right, missing


def main() -> int:
    """Build for the chosen targets, and say how it went; the exit code."""
    names = [target.name for target in TARGETS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder for wheels and all that is built")
    parser.add_argument("--target", nargs="+", choices=names, default=names, help="default: all")
    arguments = parser.parse_args()
    failed = unchecked = False
    hashes: dict[str, list[str]] = {}
    for target in (target for target in TARGETS if target.name in arguments.target):
        print(f"{target.name}:", flush=True)
        try:
            right, missing = check_target(Build(target, arguments.output.resolve() / target.name), hashes)
        except CheckError as error:
            failed = True
            print(f"  FAILED: {error}", flush=True)
            continue
        for sentence in right + missing:
            print(f"  {sentence}", flush=True)
        print("" if target.emulator else "  NOT RUN: nothing here runs its programs\n", end="", flush=True)
        unchecked |= bool(missing)
    return 1 if failed else 2 if unchecked else 0


if __name__ == "__main__":
    sys.exit(main())
