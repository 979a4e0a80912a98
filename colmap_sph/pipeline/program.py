"""Which code a result was made by: a digest of the modules that its maker reaches by import, and of the kernels.

A hand-kept version would be forgotten, and a result of yesterday's code taken for today's. A digest of the whole
package would make everything anew for the edit of a help text. What a stage says of its costs stands beside its
maker, and changes the digest, too.
"""

import ast
import platform
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813
import simplejpeg

import colmap_sph
from colmap_sph import _native
from colmap_sph.pipeline.digests import digest, file_digest
from colmap_sph.project.colmap_library import COLMAP_VERSION

_ROOT = Path(__file__).parents[1]


@cache
def program_digest(module: str) -> str:
    """Digest of all that a module of this package runs: what it reaches by import, and the libraries' versions.

    Parameters
    ----------
    module : str
        Such as "colmap_sph.stereo.matching".
    """
    files = {name: file_digest(_source_of(name)) for name in reached_modules(module)}
    return digest(files, file_digest(Path(_native.__file__)), list(_libraries().values()))


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
            waiting += _imported_by(name)
            package, _, _ = name.rpartition(".")
            waiting += [package] if package else []
    return sorted(reached)


def _imported_by(module: str) -> Iterator[str]:
    return filter(_is_ours, _names_imported(_source_of(module).read_bytes()))


@cache
def _names_imported(source: bytes) -> tuple[str, ...]:
    """Full names of all that a module's code imports, of ``from a import b`` both ``a`` and ``a.b``."""
    names: list[str] = []
    for node in _running(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return tuple(names)


def _running(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes below one but those in ``if TYPE_CHECKING:``."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and isinstance(child.test, ast.Name) and child.test.id == "TYPE_CHECKING":
            children: list[ast.AST] = [*child.orelse]
        else:
            children = [child]
        for each in children:
            yield each
            yield from _running(each)


def _is_ours(module: str) -> bool:
    return module.partition(".")[0] == _ROOT.name and _source_of(module).is_file()


def _source_of(module: str) -> Path:
    path = _ROOT.joinpath(*module.split(".")[1:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
