"""Where a model's images are, and what those that cannot be used have in common: one sentence in place of many."""

import logging
import os
import stat
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath

from colmap_sph.errors import InputError, shell_word
from colmap_sph.project.files import real_path
from colmap_sph.project.images.reading import Damaged, Problem, Unreadable, Unsupported, WrongSize

_Size = tuple[int, int]

logger = logging.getLogger(__name__)

# A folder with more entries than these, and than so many for each image of the model, is no folder of its images.
_MAX_ENTRIES = 20_000
_MAX_ENTRIES_PER_IMAGE = 100
_MAX_FACTOR = 16
# Of images with the same problem so many are told one by one; of more the first in one sentence.
_MOST_TOLD = 4
_UNDISTORT = "give the sparse model with --model to have them undistorted anew"
_REDUCED_ALONE = (
    "some versions of COLMAP's image_undistorter, given --max_image_size, reduce images of pinhole cameras and "
    "not the cameras; give the sparse model with --model and --max-image-size {longest} to have them undistorted "
    "anew"
)
_REMEDIES: dict[type[Problem], str] = {
    WrongSize: "give the images that the model was made from as --images",
    Damaged: "copy them again from where they came from",
    Unsupported: "convert them to PNG, under the same names",
    Unreadable: "check their permissions",
}
_SHARES = {2: "half", 3: "a third of", 4: "a quarter of", 8: "an eighth of"}
_SLASHES = (
    'python -c "import pycolmap; m = pycolmap.Reconstruction({model!r}); '
    "[setattr(i, 'name', i.name.replace(chr(92), '/')) for i in m.images.values()]; m.write({model!r})\""
)


def find_images(model_dir: Path, names: Sequence[str]) -> Path:
    """Find the image folder of a model by COLMAP's usual layouts.

    For the model ``X/sparse/0`` these are ``X/sparse/0/images``, ``X/sparse/images`` and ``X/images``. The folder
    that holds most of the model's images is taken, the first among equals: for the model ``X/dense/sparse`` of a
    workspace its own undistorted images, and not the originals in ``X/images``.

    Raises
    ------
    InputError
        None of the folders holds any image of the model; the message lists them, or says what one of them has
        under another spelling.
    """
    # Of a link to a model both where it is and where it leads to.
    places = (Path.cwd() / model_dir, real_path(model_dir))
    parents = [p for model in places for p in (model, model.parent, model.parent.parent)]
    folders = list(dict.fromkeys(parent / "images" for parent in parents))
    found = [sum(_may_be_file(folder / name) for name in names) for folder in folders]
    if max(found) > 0:
        return folders[found.index(max(found))]
    for folder in folders:
        files = files_below(folder, len(names))
        misspelled = None if files is None else _common_misspelling(model_dir, folder, files, names)
        if misspelled:
            raise InputError(misspelled)
    tried = ", ".join(str(folder) for folder in folders)
    raise InputError(f"The images of {model_dir} were not found in {tried}; give their folder as --images.")


def _may_be_file(path: Path) -> bool:
    """Whether a path is a file, or lies in a folder that may not be looked into: it is left out for that then."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except PermissionError:
        return True
    except OSError:
        return False


def tell_problems(
    model_dir: Path, folder: Path, problems: Mapping[str, Problem], num_images: int, *, undistorted: bool
) -> None:
    """Warn of images that are left out.

    Parameters
    ----------
    model_dir, folder : Path
        The model, and where its images are looked for.
    problems : mapping of str to Problem
        What is wrong with an image, by its name, as `image_problem` says it.
    num_images : int
        Of the model.
    undistorted : bool
        The images are those of a dense workspace, and not as they were taken.

    Raises
    ------
    InputError
        No image is left; the message says what is wrong with all of them, where that is one thing.
    """
    missing = [name for name in problems if not os.path.lexists(folder / name)]
    files = files_below(folder, num_images) if missing else []
    if files is None and len(missing) == num_images:
        raise InputError(
            f"None of the {num_images} images of {model_dir} is in {folder}, which has many thousands of other "
            "files; give the folder of the images as --images."
        )
    files = files or []
    if len(problems) == num_images:
        common = _common_size(folder, problems, undistorted) or _common_misspelling(
            model_dir, folder, files, missing
        )
        if common:
            raise InputError(common)
    spelled = other_spellings(files, missing)
    alike: dict[str, list[str]] = {}
    for name, problem in problems.items():
        instead = f", but there is {told_from(name, spelled[name])}" if name in spelled else ""
        alike.setdefault(f"{problem}{instead}", []).append(name)
    for words, names in alike.items():
        for name in names if len(names) <= _MOST_TOLD else ():
            logger.warning("%s %s; left out", folder / name, words)
        if len(names) > _MOST_TOLD:
            first = ", ".join(names[:_MOST_TOLD])
            logger.warning("%d images in %s, each of which %s; left out: %s, …", len(names), folder, words, first)
    if len(problems) == num_images:
        remedy = _UNDISTORT if undistorted else _remedy(problems.values())
        raise InputError(f"None of the model's {num_images} images in {folder} is usable; {remedy}.")


def _remedy(problems: Iterable[Problem]) -> str:
    """What to do about the most frequent kind of problem."""
    (kind, _), *_ = Counter(map(type, problems)).most_common(1)
    return _REMEDIES.get(kind, "check --images")


def other_spellings(files: Iterable[str], names: Iterable[str]) -> dict[str, str]:
    r"""Files whose names differ from those of images only in ways that other systems do not tell apart.

    Parameters
    ----------
    files : iterable of str
        Of the images' folder, relative to it.
    names : iterable of str
        Of images that are not there.

    Returns
    -------
    dict
        Name → file: with ``/`` in place of ``\``, in other case, or with its accents written in another way. Only
        where there is one such file.
    """
    wanted = {_folded(name) for name in names}
    alike: dict[str, list[str]] = {}
    for file in files:
        if _folded(file) in wanted:
            alike.setdefault(_folded(file), []).append(file)
    found = {name: alike.get(_folded(name), []) for name in names}
    return {name: those[0] for name, those in found.items() if len(those) == 1}


def files_below(folder: Path, num_images: int) -> list[str] | None:
    """The files of a folder and those below it, relative to it; None where there is much that is no image.

    Parameters
    ----------
    folder : Path
        Need not exist.
    num_images : int
        That the model has.
    """
    most = max(_MAX_ENTRIES, _MAX_ENTRIES_PER_IMAGE * num_images)
    files: list[str] = []
    for num_folders, (place, _, names) in enumerate(os.walk(folder), start=1):
        if num_folders + len(files) + len(names) > most:
            return None
        within = "" if place == str(folder) else f"{Path(place).relative_to(folder).as_posix()}/"
        files += [f"{within}{name}" for name in names]
    return files


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name.replace("\\", "/")).casefold()


def told_from(other: str, name: str) -> str:
    """A name in quotes; with code points where it looks like the other one, as accents written in two ways do."""
    same = unicodedata.normalize("NFC", name) == unicodedata.normalize("NFC", other)
    return ascii(name) if same else repr(name)


def _common_misspelling(model_dir: Path, folder: Path, files: Sequence[str], names: Sequence[str]) -> str | None:
    """Say how a folder spells the names of a model's images, of which it has none; None where it does not."""
    spelled = other_spellings(files, names)
    if not spelled:
        elsewhere = _other_folder(model_dir, folder, files, names)
        if elsewhere:
            return elsewhere
        spelled = _same_stems(files, names)
        if not spelled or 2 * len(spelled) < len(names):
            return None
        remedy = "rename the images in the model as their files, or give the folder of its images as --images"
    elif all("\\" in each and each.replace("\\", "/") == file for each, file in spelled.items()):
        remedy = f"write the names in the model with /: {_SLASHES.format(model=str(model_dir))}"
    else:
        remedy = "rename the files as the model has them"
    name = min(spelled)
    # As it is typed: `repr` doubles each \.
    called = told_from(spelled[name], name).replace(r"\\", "\\")
    return (
        f"The model {model_dir} calls an image {called}, and {folder} has {told_from(name, spelled[name])} "
        f"(so for {len(spelled)} of {len(names)} images); {remedy}."
    )


def _same_stems(files: Iterable[str], names: Iterable[str]) -> dict[str, str]:
    """Files called as images are, but for folders and endings: name → file, where one belongs to the other alone.

    Other programs write names without an ending, or the place that the image has on their machine.
    """
    by_stem: dict[str, list[str]] = {}
    for file in files:
        by_stem.setdefault(PurePosixPath(_folded(file)).stem, []).append(file)
    last = {name: PurePosixPath(_folded(name)) for name in names}
    alike = {name: by_stem.get(part.name) or by_stem.get(part.stem, []) for name, part in last.items()}
    found = {name: those[0] for name, those in alike.items() if len(those) == 1}
    wanted = Counter(found.values())
    return {name: file for name, file in found.items() if wanted[file] == 1}


def _other_folder(model_dir: Path, folder: Path, files: Sequence[str], names: Sequence[str]) -> str | None:
    """Say where the images are, if all in another folder than the model's names say."""
    there = set(files)
    wanted = set(names)
    for name in names:
        parts = PurePosixPath(name).parts
        # The model's names begin with folders above, or leave out folders below.
        if len(parts) > 1 and "/".join(parts[1:]) in there and _may_be_file(folder.parent / name):
            return (
                f"The model {model_dir} calls an image {name!r}, and {folder} has {'/'.join(parts[1:])!r}; "
                f"give --images {shell_word(folder.parent)}."
            )
    below = {file.partition("/")[0] for file in files if file.partition("/")[2] in wanted}
    if len(below) == 1:
        return (
            f"The images of {model_dir} are not in {folder}, but in {folder / below.pop()}; give that as --images."
        )
    return None


def _common_size(folder: Path, problems: Mapping[str, Problem], undistorted: bool) -> str | None:
    """Say how the sizes of images differ from those of their cameras, if all in one way."""
    wrong = {name: problem for name, problem in problems.items() if isinstance(problem, WrongSize)}
    if not wrong:
        return None
    name, example = min(wrong.items())
    sizes = [(each.found, each.wanted) for each in wrong.values()]
    longest = max(example.found)
    way, remedy = _way_and_remedy(sizes, longest)
    if undistorted:
        remedy = _UNDISTORT
        if all(_is_reduced_to(longest, wanted, found) for found, wanted in sizes):
            way, remedy = way or "are smaller than", _REDUCED_ALONE.format(longest=longest)
    if not way:
        return None
    return (
        f"All {len(wrong)} images in {folder} {way} their cameras (such as {name!r}, which {example}); {remedy}."
    )


def _way_and_remedy(sizes: list[tuple[_Size, _Size]], longest: int) -> tuple[str, str]:
    """Say how sizes found differ from those wanted, and what to do; empty where not all differ in one way."""
    if all(found == wanted[::-1] for found, wanted in sizes):
        return (
            "are turned by 90 degrees against",
            "give the images as they were when the model was made, before or after they were turned",
        )
    for factor in range(2, _MAX_FACTOR + 1):
        if all(_is_reduced(wanted, found, factor) for found, wanted in sizes):
            return (
                f"have exactly {_SHARES.get(factor, f'1/{factor} of')} the size of",
                f"give the folder of the full-size images as --images, and --max-image-size {longest} if they are "
                "to be as small as these",
            )
        if all(_is_reduced(found, wanted, factor) for found, wanted in sizes):
            return (
                f"have exactly {factor} times the size of",
                "give the folder of the reduced images, from which the model was made, as --images",
            )
    return "", ""


def _is_reduced_to(longest: int, full: _Size, reduced: _Size) -> bool:
    """Whether a size is another one in the same proportions, with so many pixels on its longer side."""
    return max(full) > longest and all(
        abs(f * longest / max(full) - r) <= 1 for f, r in zip(full, reduced, strict=True)
    )


def _is_reduced(full: _Size, reduced: _Size, factor: int) -> bool:
    """Whether a size is another one divided by a factor, rounded up or down."""
    return all(abs(f / factor - r) < 1 for f, r in zip(full, reduced, strict=True))
