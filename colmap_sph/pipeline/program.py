"""Which code a result was made by: a digest of the modules that its maker reaches by import, and of the kernels.

A hand-kept version would be forgotten, and a result of yesterday's code taken for today's. A digest of the whole
package would make everything anew for the edit of a help text. What a stage says of its costs stands beside its
maker, and changes the digest, too.
"""

import os
import platform
import re
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813
import simplejpeg

import colmap_sph
from colmap_sph import _native
from colmap_sph.pipeline.digests import digest, file_digest, new_digest
from colmap_sph.project.colmap_library import COLMAP_VERSION

_ROOT = Path(__file__).parents[1]
# Import statements of formatted code, from the end of a line on, which is found quicker than the start of one: to
# parse all code would take ten times as long.
_IMPORT = re.compile(r"\n[ \t]*(?:from[ \t]+([\w.]+)[ \t]+)?import[ \t]+(\([^)]*\)|.*)")
_COMMENT = re.compile(r"#.*")
# What only type checkers import: the statement, and all lines that are further in, or empty.
_FOR_TYPES = re.compile(rb"^([ \t]*)if TYPE_CHECKING:.*\n(?:\1[ \t]+.*\n|[ \t]*\n)*", re.MULTILINE)


@cache
def program_digest(module: str) -> str:
    """Digest of all that a module of this package runs: what it reaches by import, and the libraries' versions.

    Parameters
    ----------
    module : str
        Such as "colmap_sph.stereo.matching".
    """
    files = {name: _looked_at(_ROOT, name)[0] for name in reached_modules(module)}
    return digest(files, _kernels_digest(), list(_libraries().values()))


@cache
def _kernels_digest() -> str:
    return file_digest(Path(_native.__file__))


def versions() -> dict[str, str]:
    """Versions of this program, of Python, and of the libraries that results depend on, by their names."""
    return {"colmap_sph": colmap_sph.__version__, "Python": platform.python_version(), **_libraries()}


def _libraries() -> dict[str, str]:
    return {
        "OpenCV": cv2.__version__,
        "NumPy": np.__version__,
        "COLMAP": COLMAP_VERSION,
        "OpenImageIO": oiio.__version__,
        "simplejpeg": simplejpeg.__version__,
    }


def reached_modules(module: str) -> list[str]:
    """Sorted names of the package's Python modules which importing a module runs, itself among them.

    Imports inside of functions count, those for type checkers only do not.
    """
    reached: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += _looked_at(_ROOT, name)[1]
            package, _, _ = name.rpartition(".")
            waiting += [package] if package else []
    return sorted(reached)


@cache
def _looked_at(root: Path, module: str) -> tuple[str, frozenset[str]]:
    """Digest of a module's code, and the names of this package's modules that it imports."""
    sources = _sources(root)
    code = sources[module].read_bytes()
    state = new_digest()
    state.update(code)
    return state.hexdigest(), frozenset(_ours_imported(code)) & sources.keys()


def _ours_imported(source: bytes) -> tuple[str, ...]:
    """Full names of what a module's code imports of this package, of ``from a import b`` also ``a.b``."""
    names: list[str] = []
    if b"TYPE_CHECKING" in source:  # few are: the search takes longer than all else
        source = _FOR_TYPES.sub(b"", source)
    for package, imported in _IMPORT.findall("\n" + source.decode()):
        modules = [name.split()[0] for name in _COMMENT.sub("", imported).strip("()").split(",") if name.strip()]
        names += [package, *(f"{package}.{name}" for name in modules)] if package else modules
    return tuple(name for name in names if name.partition(".")[0] == _ROOT.name)


@cache
def _sources(root: Path) -> dict[str, Path]:
    """Files of the package's modules, by the modules' full names."""
    sources: dict[str, Path] = {}
    for folder, _, files in os.walk(root):
        package = ".".join([root.name, *Path(folder).relative_to(root).parts])
        modules = {name: f"{package}.{name.removesuffix('.py')}" for name in files if name.endswith(".py")}
        sources |= {module.removesuffix(".__init__"): Path(folder, name) for name, module in modules.items()}
    return sources
