"""Completion in shells: the parser writes it with the spellings that it knows; everyday options get short ones."""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout

from colmap_sph.app.spelling import SHORT

_ASKING = "--tyro-print-completion"


@contextmanager
def short_completion(arguments: Sequence[str]) -> Iterator[None]:
    """Where a script for completion is asked for, print it with the short spellings."""
    if not any(argument.startswith(_ASKING) for argument in arguments):
        yield
        return
    script = io.StringIO()
    try:
        with redirect_stdout(script):
            yield
    finally:
        text = script.getvalue()
        for place, flag in SHORT.items():
            text = text.replace(f"--{place.replace('_', '-')}", flag)
        print(text, end="", flush=True)
