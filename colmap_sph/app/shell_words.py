"""Arguments → the command as one types it into a shell, to repeat it."""

from collections.abc import Sequence
from pathlib import Path

from colmap_sph.errors import shell_word


def as_typed(arguments: Sequence[str]) -> str:
    r"""A line for bash or zsh that calls this program with these arguments.

    Characters that cannot be seen are written as ``$'\x1b'``, so that a line of a log can be copied from it.

    Examples
    --------
    >>> print(as_typed(["run", "--model", "my block/sparse/0", "--images", "a\x1bb"]))
    colmap_sph run --model 'my block/sparse/0' --images $'a\x1bb'
    """
    return " ".join(["colmap_sph", *map(shell_word, arguments)])


def to_repeat(arguments: Sequence[str]) -> str:
    """The same from any folder, as paths in the arguments belong to the current one."""
    return f"cd {shell_word(Path.cwd())} && {as_typed(arguments)}"
