"""Python's headers and import library for another platform, from those of the Python that runs this.

Its headers are the same everywhere but for pyconfig.h, of which the stable interface needs a few lines.
"""

import ctypes
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from cross.targets import Target

_COMMON = """\
#define SIZEOF_SHORT 2
#define SIZEOF_INT 4
#define SIZEOF_LONG_LONG 8
#define SIZEOF_VOID_P 8
#define SIZEOF_SIZE_T 8
#define SIZEOF_FLOAT 4
#define SIZEOF_DOUBLE 8
#define HAVE_STDDEF_H 1
#define HAVE_STDINT_H 1
#define HAVE_INTTYPES_H 1
#define HAVE_SYS_TYPES_H 1
#define HAVE_SYS_STAT_H 1
#define HAVE_WCHAR_H 1
#define WITH_THREAD 1
"""
_UNIX = """\
#define SIZEOF_LONG 8
#define SIZEOF_WCHAR_T 4
#define HAVE_SSIZE_T 1
#define HAVE_UNISTD_H 1
"""
_WINDOWS = """\
#define SIZEOF_LONG 4
#define SIZEOF_WCHAR_T 2
#define MS_WINDOWS 1
#define MS_WIN32 1
#define MS_WIN64 1
#define NT_THREADS 1
#define HAVE_DECLSPEC_DLL 1
#define Py_ENABLE_SHARED 1
#define HAVE_PY_SSIZE_T 1
typedef long long Py_ssize_t;
"""


def write_headers(folder: Path, target: Target) -> Path:
    """Write Python's headers for a target below a folder; their own folder."""
    headers = folder / "include"
    shutil.rmtree(headers, ignore_errors=True)
    shutil.copytree(sysconfig.get_path("include"), headers)
    (headers / "pyconfig.h").write_text(_COMMON + (_WINDOWS if target.system == "Windows" else _UNIX))
    return headers


def write_import_library(folder: Path, sources: Path) -> Path:
    """Write what a linker must know of Windows's python3.dll below a folder: names that sources use."""
    words: set[str] = set()
    for path in [*sources.rglob("*.[ch]"), *Path(sysconfig.get_path("include")).glob("*.h")]:
        words.update(re.findall(r"\b_?Py[A-Z_]\w+", path.read_text(encoding="utf-8")))
    names = sorted(word for word in words if hasattr(ctypes.pythonapi, word))
    definition = folder / "python3.def"
    definition.write_text("\n".join(["LIBRARY python3.dll", "EXPORTS", *names]) + "\n")
    library = folder / "python3.lib"
    tool = [sys.executable, "-m", "ziglang", "dlltool"]
    subprocess.run([*tool, "-m", "i386:x86-64", "-d", str(definition), "-l", str(library)], check=True)
    return library
