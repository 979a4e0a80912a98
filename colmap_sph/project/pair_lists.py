"""COLMAP's lists of images and pairs in a dense workspace: ``fusion.cfg`` and ``patch-match.cfg``."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import atomic_file
from colmap_sph.scene import SourceImages


def fusion_cfg(names: Iterable[str]) -> bytes:
    """Content of ``fusion.cfg``: the images that fusion reads, one name per line, without comments."""
    return "".join(f"{name}\n" for name in names).encode()


def write_fusion_cfg(path: Path, names: Iterable[str]) -> str:
    """Write ``fusion.cfg``, see `fusion_cfg`; returns the `files.whole_digest` of the file."""
    with atomic_file(path) as file:
        file.write(fusion_cfg(names))
        return file.digest


def write_patch_match_cfg(path: Path, sources: Mapping[str, SourceImages]) -> None:
    """Write ``patch-match.cfg``: for each reference image its source images.

    Parameters
    ----------
    path : Path
        Target file.
    sources : mapping of str to list of str, int or "__all__"
        Names of the source images, or a number (COLMAP chooses that many), or ``"__all__"``. COLMAP cannot
        process a reference without sources, so an empty list is left out.
    """
    lines = []
    for reference, source in sources.items():
        if source != []:
            lines += [reference, _source_line(source)]
    with atomic_file(path) as file:
        file.write("".join(f"{line}\n" for line in lines).encode())


def _source_line(source: SourceImages) -> str:
    if isinstance(source, int):
        return f"__auto__, {source}"
    return source if isinstance(source, str) else ", ".join(source)


def read_patch_match_cfg(path: Path) -> dict[str, SourceImages]:
    """Read ``patch-match.cfg``: pairs of lines, a reference image and its sources.

    Returns
    -------
    dict
        For each reference image an explicit list of names, or an int N for ``__auto__, N``, or ``"__all__"``.

    Raises
    ------
    InputError
        The file cannot be read or is malformed; the message names the line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read ({reason_of(error)}); mend or delete it.") from error
    numbered = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in numbered if line and not line.startswith("#")]
    if len(lines) % 2:
        number, name = lines[-1]
        raise InputError(f"{path}, line {number}: the source images of {name!r} are missing.")
    sources: dict[str, SourceImages] = {}
    for (number, reference), (source_number, line) in zip(lines[::2], lines[1::2], strict=True):
        if reference in sources:
            raise InputError(f"{path}, line {number}: {reference!r} is listed twice; keep one of them.")
        if reference.startswith("__"):
            raise InputError(f"{path}, line {number}: {reference!r} stands where an image name is expected.")
        sources[reference] = _parse_sources(line, reference, f"{path}, line {source_number}")
    return sources


def _parse_sources(line: str, reference: str, where: str) -> SourceImages:
    words = [word.strip() for word in line.split(",")]
    if words == ["__all__"]:
        return "__all__"
    if words[0] == "__auto__":
        if len(words) != 2 or not words[1].isdecimal() or int(words[1]) < 1:
            raise InputError(f"{where}: {line!r} should read '__auto__, N' with a number N above 0.")
        return int(words[1])
    names = [word for word in words if word]
    if not names or any(name.startswith("__") for name in names):
        raise InputError(f"{where}: {line!r} is not a list of image names, '__auto__, N' or '__all__'.")
    if reference in names:
        raise InputError(f"{where}: {reference!r} is listed as its own source image; remove it.")
    return list(dict.fromkeys(names))
