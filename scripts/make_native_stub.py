"""Write `colmap_sph/_native.pyi` anew from what the compiled module says of its functions.

    python scripts/make_native_stub.py

Both come from the tables of arguments in `colmap_sph/_native/*/functions.c`; a test tells when they differ.
"""

import inspect
from pathlib import Path

from colmap_sph import _native

STUB = Path(__file__).resolve().parents[1] / "colmap_sph" / "_native.pyi"

HEAD = '''\
"""The compiled kernels; `scripts/make_native_stub.py` writes this from their own tables of arguments."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_Size = tuple[tuple[str | None, int], ...]
_Argument = tuple[str, str, str, _Size]

def backends() -> list[str]:
'''


def annotation(role: str, kind: str) -> str:
    """Python's type of an argument."""
    if role == "value":
        return kind
    # NumPy's own functions of float64 promise no more than a floating type.
    array = f"NDArray[np.{'floating[Any]' if (role, kind) == ('in', 'float64') else kind}]"
    return f"tuple[{array}, ...]" if role == "images" else array


def docstring(name: str) -> str:
    """A function's docstring as its body."""
    text = inspect.getdoc(getattr(_native, name)) or ""
    quoted = f'"""{text}\n"""' if "\n" in text else f'"""{text}"""'
    return "".join(f"    {line}".rstrip() + "\n" for line in quoted.splitlines())


def function_text(name: str, arguments: tuple[tuple[str, str, str, object], ...]) -> str:
    """One function of the stub, an argument a line."""
    taken = [
        f"    {argument}: {annotation(role, kind)},\n" for argument, role, kind, _ in arguments if role != "result"
    ]
    results = ", ".join(kind for _, role, kind, _ in arguments if role == "result")
    returned = f"tuple[{results}]" if results else "None"
    return f"def {name}(\n{''.join(taken)}    /,\n) -> {returned}:\n{docstring(name)}"


def stub() -> str:
    """The text of the stub."""
    missing = "def missing() -> list[str]:\n"
    signatures = "def signatures() -> list[tuple[str, tuple[_Argument, ...]]]:\n"
    texts = [HEAD + docstring("backends"), missing + docstring("missing"), signatures + docstring("signatures")]
    return "\n".join(texts + [function_text(*signature) for signature in _native.signatures()])


def main() -> None:
    """Entry point."""
    STUB.write_text(stub())


if __name__ == "__main__":
    main()
