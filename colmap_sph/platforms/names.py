"""Names of images, as models have them, that this system cannot give to a file, or gives to the same one."""

import sys
import unicodedata

# Of Windows, whatever stands behind a dot.
_DEVICES = frozenset(
    {"con", "prn", "aux", "nul", "conin$", "conout$"}
    | {f"{port}{number}" for port in ("com", "lpt") for number in "0123456789¹²³"}
)
_FORBIDDEN = '<>:"|?*\\'
_IS_WINDOWS = sys.platform == "win32"
_FOLDS_CASE = sys.platform in ("win32", "darwin")
_LONGEST_PATH = 259


def name_problem(name: str, *, windows: bool = _IS_WINDOWS) -> str | None:
    r"""Say why no file can have a name on this system, for ``which …``; None where it can.

    Windows would take some for another file, another drive or a device, without a word.

    Parameters
    ----------
    name : str
        With folders before it, each with a / behind.
    windows : bool
        Whether to ask for Windows.

    Examples
    --------
    >>> name_problem("a/aux.jpg", windows=True)
    "is a device of Windows ('aux')"
    >>> name_problem("C:a.jpg", windows=True)
    "has a ':', which names of files on Windows cannot have"
    """
    if not windows:
        return None
    for each in _FORBIDDEN:
        if each in name:
            return f"has a {each!r}, which names of files on Windows cannot have".replace(r"\\", "\\")
    if any(ord(each) < 32 for each in name):
        return "has a character that cannot be seen, which names of files on Windows cannot have"
    for part in name.split("/"):
        if part not in ("", ".", "..") and part[-1] in ". ":
            return "ends, or has a folder that ends, with a dot or a space, which Windows leaves out"
        if part.partition(".")[0].rstrip(" ").casefold() in _DEVICES:
            return f"is a device of Windows ({part.partition('.')[0]!r})"
    return None


def same_file_name(name: str, *, folds_case: bool = _FOLDS_CASE) -> str:
    """What names have in common that this system takes for the same file.

    Windows and macOS do not tell capital letters from small ones, macOS not how accents are written either.
    """
    return unicodedata.normalize("NFC", name).casefold() if folds_case else name


def longest_path() -> int | None:
    """Characters that the path of a file may have, where the system does not say so when one is too long."""
    if sys.platform == "win32":
        import ctypes

        ask = getattr(ctypes.WinDLL("ntdll"), "RtlAreLongPathsEnabled", None)  # since Windows 10
        return None if ask is not None and ask() & 0xFF else _LONGEST_PATH
    return None
