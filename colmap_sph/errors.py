"""Errors a user can cause and mend: one base class, a few named causes.

The command line prints the message as one sentence and exits with `exit_code`; it never shows a traceback
for these. A message names the file or option and says what to do.
"""

import os
import re
import shlex
import unicodedata
from collections.abc import Callable

# Categories of characters that move the cursor, reorder or hide text, or are no characters at all.
_UNPRINTABLE = frozenset({"Cc", "Cf", "Cn", "Co", "Cs", "Zl", "Zp"})
# Of other categories, but without width or ink: two names that differ in them look alike.
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef]"
)


class ColmapSphError(Exception):
    """Base of every error this package raises on purpose."""

    exit_code = 1


class InputError(ColmapSphError):
    """A model, image, workspace or configuration file that is missing, damaged or does not fit the rest."""

    exit_code = 2


class DamageError(InputError):
    """A file of our own that holds something else than was written to it."""


class OptionError(ColmapSphError, ValueError):
    """An option out of its bounds, or options that contradict each other.

    Parameters
    ----------
    message : str
    *names : str
        The options that the message names: fields of their record, such as "num_pairs".
    """

    exit_code = 2

    def __init__(self, message: str, *names: str) -> None:
        super().__init__(message)
        self.names = names

    def spelled(self, spell: Callable[[str], str]) -> "OptionError":
        """The same error with the options called otherwise: as parts of a larger record, or as typed."""
        message = str(self)
        for name in self.names:
            found = re.search(rf"(?<![\w.-]){re.escape(name)}\b", message)
            if found:
                message = message[: found.start()] + spell(name) + message[found.end() :]
        return OptionError(message, *map(spell, self.names))


class OutputError(ColmapSphError):
    """An output that cannot be written: permissions, a full disk, a path in the way."""

    exit_code = 3


class NoResultError(ColmapSphError):
    """Valid input from which nothing can be computed: no overlapping pair, no point that survives."""

    exit_code = 4


class OutOfMemoryError(ColmapSphError):
    """The system refuses memory or threads."""

    exit_code = 6

    def __init__(
        self,
        words: str = "There is not enough memory; give fewer --threads or a smaller --max-image-size, "
        "or end other programs.",
    ) -> None:
        super().__init__(words)


class LostWorkersError(ColmapSphError):
    """The machines of a cluster are gone, or die of the work."""

    exit_code = 6


class RectificationError(ColmapSphError):
    """A pair that cannot be rectified on the chosen surface; the pair is skipped and reported."""


def counted(count: int, what: str) -> str:
    """So many of something, as in a sentence.

    Examples
    --------
    >>> print(counted(1, "image"), counted(1234, "image"), sep=", ")
    1 image, 1,234 images
    """
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"


def percent(share: float, digits: int = 1) -> str:
    """A share of the whole, as in a sentence or a table.

    Examples
    --------
    >>> print(percent(0.9176), percent(0.5, 0), sep=", ")
    91.8 %, 50 %
    """
    return f"{100 * share:.{digits}f} %"


def reason_of(error: BaseException | None) -> str:
    """Say in one line why something failed, for the brackets of a message that names the file itself.

    Of the system's errors these are its own words, such as "Permission denied", without number and path.
    """
    words = getattr(error, "strerror", None) or " ".join(str(error).split())
    return words or type(error).__name__


def unwritable(path: object, error: OSError | RuntimeError) -> OutputError:
    """The error of a file that cannot be written, with what may help."""
    if isinstance(error, IsADirectoryError):
        remedy = "remove the folder, the file goes there"
    elif isinstance(error, FileNotFoundError):
        remedy = "its folder is not there, or not any more: leave it in place while the program is at work"
    else:
        remedy = "check space and permissions"
    return OutputError(f"{path} cannot be written ({reason_of(error)}); {remedy}.")


def printable(text: object) -> str:
    r"""Text for a terminal or a log: one line, without characters that steer a terminal or cannot be seen.

    Names of files come from strangers. A line break in them would forge a line of the log, an escape sequence
    retitle or rewrite the terminal. Such characters are written as in Python's strings; letters of all languages
    stay.

    Examples
    --------
    >>> print(printable("Köln 東京\x1b]0;title\x07\u202egpj.exe"))
    Köln 東京\x1b]0;title\x07\u202egpj.exe
    """
    return "".join(_visible(character) for character in str(text))


def _visible(character: str) -> str:
    if unicodedata.category(character) in _UNPRINTABLE or _INVISIBLE.match(character):
        return character.encode("unicode_escape").decode("ascii")
    return character


def shell_word(text: object) -> str:
    r"""Text or a path as one word for bash or zsh, in which nothing is hidden: it can be copied from a message.

    Examples
    --------
    >>> print(shell_word("my block"), shell_word("a\x1bb"))
    'my block' $'a\x1bb'
    """
    word = str(text)
    if printable(word) == word:
        return shlex.quote(word)
    return f"$'{''.join(map(_escaped, word))}'"


def _escaped(character: str) -> str:
    if character in "\\'":
        return f"\\{character}"
    if printable(character) == character:
        return character
    return "".join(f"\\x{byte:02x}" for byte in os.fsencode(character))
