"""What a build of the kernels must hold, and what it finds out about its processor; each wheel is asked."""

import ctypes
import importlib
import logging
import platform
import re
import sys
from pathlib import Path

import pytest

from colmap_sph import _native
from colmap_sph.stereo import kernels

AVX2 = {"avx", "avx2", "popcnt"}
AVX512BW = AVX2 | {f"avx512{part}" for part in ("f", "bw", "dq", "vl")}
AVX512 = AVX512BW | {f"avx512{part}" for part in ("vbmi", "ifma", "_vpopcntdq")}
IS_X86 = platform.machine().lower() in ("x86_64", "amd64")
IS_ARM = platform.machine().lower() in ("aarch64", "arm64")


def test_a_build_has_all_kernels_of_its_processor():
    assert _native.missing() == []
    assert kernels.shortcoming() == ""


@pytest.mark.skipif(not (IS_X86 and sys.platform == "linux"), reason="asks Linux about an x86-64 processor")
def test_processors_are_taken_for_what_linux_says_they_are():
    """Its flags are those of the processor whose registers it keeps."""
    flags = set(re.findall(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)[0].split())
    needed = {"avx512": AVX512, "avx512bw": AVX512BW, "avx2": AVX2, "scalar": set()}
    assert _native.backends() == [name for name, extensions in needed.items() if flags >= extensions]


@pytest.mark.skipif(not (IS_X86 and sys.platform == "win32"), reason="asks Windows about an x86-64 processor")
def test_processors_are_taken_for_what_windows_says_they_are():
    avx2_instructions_available = 40
    known = ctypes.CDLL("kernel32").IsProcessorFeaturePresent(avx2_instructions_available)
    assert ("avx2" in _native.backends()) == bool(known)


@pytest.mark.skipif(not IS_ARM, reason="every 64-bit ARM processor has NEON")
def test_arm_has_neon():
    assert _native.backends() == ["neon", "scalar"]


def test_a_build_that_lacks_kernels_says_so(monkeypatch, caplog):
    monkeypatch.setattr(_native, "missing", lambda: ["avx512", "avx2"])
    with caplog.at_level(logging.WARNING):
        importlib.reload(kernels)
    (said,) = caplog.messages
    assert "no kernels for avx512 and avx2" in said and "gcc or clang" in said
