"""The platforms that have wheels, and Intel Macs: what tools call them, and what to expect of them."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Target:
    """A platform.

    Attributes
    ----------
    platform : str
        As Python's `sysconfig.get_platform` says it, or pip's tag of it.
    zig : str
        zig's name, with the oldest version of the system.
    system, processor : str
        CMake's names.
    file_format : str
        llvm-objdump's name.
    libraries : str
        Pattern of the libraries that a module may take from.
    kernels : dict
        Instruction set → pattern of what only its kernels have in llvm-objdump's listing.
    emulator : {"native", "qemu", "wine", ""}
        What runs its programs on Linux x86-64; "" where nothing does.
    """

    platform: str
    zig: str
    system: Literal["Linux", "Darwin", "Windows"]
    processor: str
    file_format: str
    libraries: str
    kernels: dict[str, str]
    emulator: Literal["native", "qemu", "wine", ""]

    @property
    def name(self) -> str:
        """Of the platform in the name of a wheel."""
        return self.platform.replace("-", "_").replace(".", "_")

    @property
    def module(self) -> str:
        """File name of the module."""
        return "_native.pyd" if self.system == "Windows" else "_native.abi3.so"

    @property
    def program_suffix(self) -> str:
        """Ending of a program's file name."""
        return ".exe" if self.system == "Windows" else ""


_X86 = {"avx2": r"%ymm\d", "avx512": r"%zmm\d"}
_ARM = {"neon": r"<_?\w+_neon>:"}  # NEON's registers are in all code
_GLIBC = r"lib[cm]\.so\.6|ld-linux-.*|libpthread\.so\.0"
_MACOS = r"/usr/lib/libSystem\.B\.dylib|/usr/lib/dyld|_native\.abi3\.so"  # the last: its own name
_WINDOWS = r"python3\.dll|KERNEL32\.dll|ntdll\.dll|api-ms-win-crt-.*\.dll"

TARGETS = (
    Target(
        "manylinux_2_28_x86_64", "x86_64-linux-gnu.2.28", "Linux", "x86_64", "elf64-x86-64", _GLIBC, _X86, "native"
    ),
    Target(
        "manylinux_2_28_aarch64",
        "aarch64-linux-gnu.2.28",
        "Linux",
        "aarch64",
        "elf64-littleaarch64",
        _GLIBC,
        _ARM,
        "qemu",
    ),
    Target("win-amd64", "x86_64-windows-gnu", "Windows", "AMD64", "coff-x86-64", _WINDOWS, _X86, "wine"),
    Target("macosx-14.0-arm64", "aarch64-macos.14.0", "Darwin", "arm64", "mach-o arm64", _MACOS, _ARM, ""),
    Target(
        "macosx-14.0-x86_64", "x86_64-macos.14.0", "Darwin", "x86_64", "mach-o 64-bit x86-64", _MACOS, _X86, ""
    ),
)
