"""Lists of a dense workspace: COLMAP's ``fusion.cfg`` and ``patch-match.cfg``, and the pairs matched in it."""

import re
from collections.abc import Container, Iterable, Mapping
from pathlib import Path

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import atomic_file, open_regular
from colmap_sph.project.given.image_names import KEYWORDS, WHITE
from colmap_sph.project.state.array_file import SUFFIX
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, SourceImages

_BYTE_ORDER_MARK = "\ufeff"
_LIKE_KEYWORD = re.compile("__[a-z]+__")
_PAIR_FILE = re.compile(rf"(\d+)-(\d+){re.escape(SUFFIX)}")


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


def read_lines(path: Path, remedy: str) -> list[str]:
    """Read the lines of a list as COLMAP does: without white space around them, which no name has.

    Raises
    ------
    InputError
        The file cannot be read; the message ends with the remedy.
    """
    try:
        with open_regular(path) as file:
            text = file.read().decode()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read ({reason_of(error)}); {remedy}.") from error
    # Not `splitlines`, which also splits at signs that a name may have.
    return [line.strip(WHITE) for line in text.removeprefix(_BYTE_ORDER_MARK).split("\n")]


def read_patch_match_cfg(path: Path, among: Container[str] | None = None) -> dict[str, SourceImages]:
    """Read ``patch-match.cfg``: pairs of lines, a reference image and its sources.

    Parameters
    ----------
    path : Path
    among : container of str, optional
        Names of the images that count; what is written of others is left out.

    Returns
    -------
    dict
        For each reference image an explicit list of names, or an int N for ``__auto__, N``, or ``"__all__"``.

    Raises
    ------
    InputError
        The file cannot be read or is malformed; the message names the line.
    """
    numbered = enumerate(read_lines(path, "mend or delete it"), start=1)
    lines = [(number, line) for number, line in numbered if line and not line.startswith("#")]
    if len(lines) % 2:
        number, name = lines[-1]
        raise InputError(f"{path}, line {number}: the source images of {name!r} are missing.")
    sources: dict[str, SourceImages] = {}
    for (number, reference), (source_number, line) in zip(lines[::2], lines[1::2], strict=True):
        if reference in sources:
            raise InputError(f"{path}, line {number}: {reference!r} is listed twice; keep one of them.")
        if reference in KEYWORDS:
            raise InputError(f"{path}, line {number}: {reference!r} stands where an image name is expected.")
        sources[reference] = _parse_sources(line, reference, f"{path}, line {source_number}")
    if among is None:
        return sources
    return {name: _only(partners, among) for name, partners in sources.items() if name in among}


def _only(sources: SourceImages, among: Container[str]) -> SourceImages:
    return [name for name in sources if name in among] if isinstance(sources, list) else sources


def _parse_sources(line: str, reference: str, where: str) -> SourceImages:
    words = [word.strip(WHITE) for word in line.split(",")]
    if words == ["__all__"]:
        return "__all__"
    if words[0] == "__auto__":
        if len(words) != 2 or not words[1].isdecimal() or int(words[1]) < 1:
            raise InputError(f"{where}: {line!r} should read '__auto__, N' with a number N above 0.")
        return int(words[1])
    names = [word for word in words if word]
    if not names or any(_LIKE_KEYWORD.fullmatch(name) for name in names):
        raise InputError(f"{where}: {line!r} is not a list of image names, '__auto__, N' or '__all__'.")
    if reference in names:
        raise InputError(f"{where}: {reference!r} is listed as its own source image; remove it.")
    return list(dict.fromkeys(names))


def pairs_on_disk(workspace: Workspace, scene: Scene) -> list[tuple[str, str]]:
    """Names of the images of each pair that this program has matched in a workspace."""
    name_of = {view.image_id: view.name for view in scene.views}
    pairs = []
    for path in sorted(workspace.pairs_dir.rglob(f"*{SUFFIX}"), key=lambda path: path.name):
        found = _PAIR_FILE.fullmatch(path.name)
        ids = [int(digits[:18]) for digits in found.groups()] if found else []
        # The largest first: a second map of the pair, the other way round.
        if ids and ids[0] < ids[1] and all(each in name_of for each in ids):
            pairs.append((name_of[ids[0]], name_of[ids[1]]))
    return pairs
