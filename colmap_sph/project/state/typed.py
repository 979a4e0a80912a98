"""JSON, or plain values of it → values of a type that is checked, in any thread.

msgspec works out a type when it is first asked for it, and another thread that asks meanwhile for the same type
ends the process. So types are made known one at a time here, and nobody else calls msgspec to read.
"""

from threading import Lock
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")

_ONE_AT_A_TIME = Lock()
_known: set[Any] = set()


def from_json(data: bytes | msgspec.Raw, kind: type[T]) -> T:
    """Read JSON.

    Parameters
    ----------
    data : bytes or msgspec.Raw
    kind : type
        What it must hold: a plain type, dataclass or `msgspec.Struct`, whose fields' types are checked.

    Returns
    -------
    object
        Of type `kind`.

    Raises
    ------
    msgspec.MsgspecError, UnicodeDecodeError, RecursionError
        It holds anything else.
    """
    _make_known(kind)
    return msgspec.json.decode(data, type=kind)


def from_plain(value: object, kind: type[T]) -> T:
    """Read what JSON was read as already; see `from_json`."""
    _make_known(kind)
    return msgspec.convert(value, kind)


def _make_known(kind: Any) -> None:
    with _ONE_AT_A_TIME:
        if kind not in _known:
            msgspec.json.Decoder(kind)  # works out all the types in it
            _known.add(kind)
