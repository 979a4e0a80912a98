"""Names of images: refused where they cannot be those of files, or where COLMAP's lists of names cannot hold them.

A name stands alone on a line of ``fusion.cfg`` and ``patch-match.cfg``, whose readers cut white space off at both
ends, skip what begins with # and take two words for something else. Anything that can be written there and be a
file is a good name: with spaces, commas, quotes, in any alphabet.
"""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from colmap_sph.errors import InputError
from colmap_sph.platforms.names import same_file_name
from colmap_sph.project.workspace import checked_name

# What COLMAP cuts off.
WHITE = " \t\n\v\f\r"
KEYWORDS = ("__all__", "__auto__")


def check_names(names: Sequence[str], sparse_dir: Path) -> None:
    """Raise `InputError` unless every image can have files of its own and stand in COLMAP's lists.

    Parameters
    ----------
    names : sequence of str
        Of all images of the model in `sparse_dir`.
    sparse_dir : Path
    """
    for name in names:
        problem = _problem(name)
        if problem is not None:
            raise InputError(
                f"The model in {sparse_dir} has an image named {name!r}, which {problem}; "
                "rename the image, its file and in the model."
            )
        checked_name(name)
    _check_places(names, sparse_dir)


def _problem(name: str) -> str | None:
    """Say why a name cannot be used, or return None."""
    if not name:
        return "is no name"
    if "\0" in name:
        return "no file can be called"
    if "\n" in name or "\r" in name:
        return "has a line break, and COLMAP's lists of images have one name on a line"
    if name != name.strip(WHITE):
        return "begins or ends with a space, which COLMAP's lists of images do not keep"
    if name.startswith("#"):
        return "begins with #, which makes it a comment in COLMAP's patch-match.cfg"
    if name in KEYWORDS:
        return "is a word with another meaning in COLMAP's patch-match.cfg"
    parts = PurePosixPath(name)
    if ".." not in parts.parts and not parts.is_absolute() and str(parts) != name:
        return f"is a roundabout way to write {str(parts)!r}"
    return None


def _check_places(names: Sequence[str], sparse_dir: Path) -> None:
    """Every image needs a place of its own; COLMAP ends the process where one lies in the other's."""
    known = set(names)
    if len(known) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"The model in {sparse_dir} has two images named {twice!r}; rename one of them.")
    alike: dict[str, str] = {}
    for name in names:
        other = alike.setdefault(same_file_name(name), name)
        if other != name:
            raise InputError(
                f"The model in {sparse_dir} has the images {other!r} and {name!r}, which are the same file on "
                "this system; rename one of them."
            )
    for name in names:
        inside = next((str(folder) for folder in PurePosixPath(name).parents if str(folder) in known), None)
        if inside is not None:
            raise InputError(
                f"The model in {sparse_dir} has the images {inside!r} and {name!r}, "
                "and a file cannot be a folder; rename one of them."
            )
