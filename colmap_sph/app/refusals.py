"""What is wrong with a command line that the parser refuses: one sentence, with options as they were typed."""

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from difflib import get_close_matches
from itertools import dropwhile, takewhile
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from colmap_sph.app.option_list import Option, option_groups
from colmap_sph.app.spelling import SHORT, full_flag
from colmap_sph.errors import InputError

_OPTION = re.compile(r"--?[^\W\d]")
# Lines, corners and colours of the parser's box, with or without Unicode.
_DRAWN = re.compile(r"[╭╮╰╯│─]|^[|+]|[|+]$|-{3,}|\x1b\[[\d;]*m")


@contextmanager
def refusals_in_words(arguments: Sequence[str], commands: Mapping[str, Any]) -> Iterator[None]:
    """Raise `InputError` in place of the parser's box and `SystemExit`.

    Parameters
    ----------
    arguments : sequence of str
        As they were typed.
    commands : mapping of str to type
        Each command's record of options by its name.
    """
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            yield
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(_reason(arguments, commands) or _without_box(said.getvalue())) from None


def refuse_empty_paths(arguments: Sequence[str], command: Any) -> None:
    """Raise `InputError` for a path that is empty: the parser takes it for the current folder.

    Parameters
    ----------
    arguments : sequence of str
        Of the command, in full.
    command : type
        The record of its options.
    """
    options, _ = _options_of(command)
    paths = {flag for flag, each in options.items() if _is_path(each.kind)}
    for before, word in zip(["", *arguments], arguments, strict=False):
        flag, equals, value = word.partition("=")
        if flag in paths and equals and not value:
            raise _empty(flag)
        if not word and (before in paths or not _OPTION.match(before)):
            raise _empty(before if before in paths else "A path")


def _empty(what: str) -> InputError:
    return InputError(
        f"{what} is empty; give a path, . for the current folder, or leave it out. Is a variable of the "
        "shell unset?"
    )


def _is_path(kind: Any) -> bool:
    return kind is Path or any(map(_is_path, get_args(kind)))


def _reason(arguments: Sequence[str], commands: Mapping[str, Any]) -> str | None:
    names = ", ".join(commands)
    if not arguments:
        return f"Name a command: {names}; colmap_sph --help tells more."
    command, *typed = arguments
    if command not in commands:
        return (
            f"There is no command {command!r}{_nearest(command, commands)}; the commands are {names}, "
            "and those of COLMAP."
        )
    problem = _problem(typed, *_options_of(commands[command]))
    more = "--help-all" if command == "run" else "--help"
    return problem and f"{problem}; see colmap_sph {command} {more}."


def _options_of(command: Any) -> tuple[dict[str, Option], list[Option]]:
    """The options of a command by their full flag, and its positional arguments."""
    every = [option for group in option_groups(command) for option in group.options]
    options = {option.full_flag: option for option in every if not option.is_positional}
    return options, [option for option in every if option.is_positional]


def _problem(typed: Sequence[str], options: Mapping[str, Option], places: Sequence[Option]) -> str | None:
    """Say what is wrong first; None where nothing is seen to be."""
    given = set()
    loose = []
    rest = list(typed)
    while rest:
        word = rest.pop(0)
        if not _OPTION.match(word):
            loose.append(word)
            continue
        flag, equals, value = word.partition("=")
        option = options.get(full_flag(flag)) or options.get(full_flag(flag.replace("--no-", "--", 1)))
        if option is None:
            return f"There is no option {flag}{_nearest(flag, [*SHORT.values(), *options])}"
        given.add(option.full_flag)
        kind = None if option.is_switch else option.kind
        values = [value] if equals else _taken(rest, kind)
        problem = _wrong_value(flag, kind, values)
        if problem:
            return problem
    return _wrong_number(loose, given, options, places)


def _taken(rest: list[str], kind: Any) -> list[str]:
    """Take the values of an option from the words behind it."""
    most = _most_values(kind)
    values: list[str] = []
    while rest and len(values) < most and not _OPTION.match(rest[0]):
        values.append(rest.pop(0))
    return values


def _most_values(kind: Any) -> float:
    if kind is None:
        return 0
    if get_origin(kind) in (UnionType, Union):
        return max(map(_most_values, get_args(kind)))
    if get_origin(kind) is not tuple:
        return 1
    return float("inf") if get_args(kind)[-1] is Ellipsis else len(get_args(kind))


def _wrong_value(flag: str, kind: Any, values: Sequence[str]) -> str | None:
    if get_origin(kind) in (UnionType, Union):
        problems = [_wrong_value(flag, each, values) for each in get_args(kind) if each is not NoneType]
        return problems[0] if all(problems) else None
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        if kinds[-1] is not Ellipsis and len(values) < len(kinds):
            return f"{flag} needs {len(kinds)} values"
        return next(filter(None, (_wrong_value(flag, kinds[0], [value]) for value in values)), None)
    if kind is None:
        return f"{flag} takes no value" if values else None
    if not values:
        return f"{flag} needs a value"
    words = _words(kind)
    return f"{flag} takes {words}, not {values[0]!r}" if words and not _fits(kind, values[0]) else None


def _words(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}"
    return {int: "a whole number", float: "a number", bool: "True or False"}.get(kind, "")


def _fits(kind: Any, value: str) -> bool:
    if get_origin(kind) is Literal:
        return value in map(str, get_args(kind))
    if kind is bool:
        return value in ("True", "False")
    try:
        kind(value)
    except ValueError:
        return False
    return True


def _wrong_number(
    loose: Sequence[str], given: set[str], options: Mapping[str, Option], places: Sequence[Option]
) -> str | None:
    """Say which argument is missing, or one too many."""
    most = sum(_most_values(each.kind) for each in places)
    is_model = "--model" in options and "--model" not in given and not places
    if len(loose) > most + is_model:
        return f"{loose[-1]!r} is one argument too many, or an option's name is missing before it"
    missing = [flag for flag, each in options.items() if each.is_required and flag not in given]
    missing += [f"a {each.place}" for each in places if each.is_required and not loose]
    return f"Give {' and '.join(missing)}" if missing else None


def _nearest(word: str, known: Sequence[str] | Mapping[str, Any]) -> str:
    close = get_close_matches(word.replace("_", "-"), list(known), 1, 0.7)
    return f" (did you mean {close[0]}?)" if close else ""


def _without_box(said: str) -> str:
    """The first part of what the parser says, in one line."""
    lines = [" ".join(_DRAWN.sub(" ", line).split()) for line in said.splitlines()]
    told = " ".join(takewhile(bool, dropwhile(lambda line: not line, lines[1:])))
    return f"The command line is not understood: {told or 'see colmap_sph --help.'}"
