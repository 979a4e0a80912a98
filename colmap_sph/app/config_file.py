"""Options of `run` from a file: TOML that the user wrote, or the report of an earlier run."""

import json
import tomllib
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from colmap_sph.app.option_list import Option
from colmap_sph.app.spelling import full_flag
from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import read_small

_MAX_BYTES = 64 << 20
"""Reports of thousands of images have megabytes."""
_KINDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text in quotes",
    Path: "a path in quotes",
}


def arguments_of_file(path: Path, known: Mapping[str, Option]) -> list[str]:
    """The options in a file as arguments of the command line.

    Parameters
    ----------
    path : Path
        TOML with the long options, those of a stage in a table of its name; or, where it ends in ``.json``, the
        report of a run.
    known : mapping of str to Option
        The options there are, by their full flag.

    Returns
    -------
    list of str

    Raises
    ------
    InputError
        The file cannot be read, or holds what is no option or not a value of one.
    """
    arguments = []
    places: dict[str, str] = {}
    for key, value in _flat(_content(path)):
        option = known.get(full_flag("--" + key.replace("_", "-")))
        if option is None or option.place == "config":
            raise InputError(
                f"{path}: there is no option {key}{_nearest(key, known)}; see colmap_sph run --help-all."
            )
        other = places.setdefault(option.place, key)
        if other != key:
            raise InputError(f"{path}: {other} and {key} are the same option; leave out one of them.")
        if value is not None:
            arguments += _argument(path, key, option, value)
    return arguments


def _content(path: Path) -> dict[str, Any]:
    try:
        text = read_small(path, _MAX_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise InputError(
            f"The configuration {path} cannot be read ({reason_of(error)}); check --config."
        ) from error
    except UnicodeDecodeError:
        raise InputError(f"The configuration {path} is no text in UTF-8; check --config.") from None
    try:
        if path.suffix.lower() != ".json":
            return tomllib.loads(text)
        report = json.loads(text)
    except (ValueError, RecursionError) as error:
        kind = "JSON" if path.suffix.lower() == ".json" else "TOML"
        raise InputError(f"The configuration {path} is not valid {kind} ({reason_of(error)}).") from error
    options = report.get("options") if isinstance(report, dict) else None
    if not isinstance(options, dict):
        raise InputError(f"{path} is no report of a run: it has no options; give a run's report.json, or TOML.")
    return options


def _flat(content: Mapping[str, Any], stage: str = "") -> Iterator[tuple[str, Any]]:
    """Keys as "matching.p1"; a table in a stage's is a value, which no option takes."""
    for key, value in content.items():
        if isinstance(value, dict) and not stage:
            yield from _flat(value, f"{key}.")
        else:
            yield f"{stage}{key}", value


def _nearest(key: str, known: Mapping[str, Option]) -> str:
    options = [option for option in known.values() if option.place != "config"]
    names = {name: name for option in options for name in (option.place, option.flag[2:].replace("-", "_"))}
    found = get_close_matches(key.replace("-", "_"), names, 1)
    return f" (did you mean {found[0]}?)" if found else ""


def _argument(path: Path, key: str, option: Option, value: Any) -> list[str]:
    if not _fits(option.kind, value):
        raise InputError(f"{path}: {key} must be {_words(option.kind)}, not {json.dumps(value, default=str)}.")
    if option.is_switch:
        return [option.full_flag] if value else []
    return [f"{option.full_flag}={value}"]


def _fits(kind: Any, value: Any) -> bool:
    if get_origin(kind) in (UnionType, Union):
        return any(_fits(each, value) for each in get_args(kind))
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    return type(value) is {Path: str}.get(kind, kind)


def _words(kind: Any) -> str:
    if get_origin(kind) in (UnionType, Union):
        return " or ".join(_words(each) for each in get_args(kind) if each is not type(None))
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(map(str, get_args(kind)))
    return _KINDS[kind]
