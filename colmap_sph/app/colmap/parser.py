"""COLMAP's way to write options, on the command line and in project files → values by name."""

import argparse
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from colmap_sph.app.colmap.options import ColmapCommand, ColmapOption, Value, is_default
from colmap_sph.app.colmap.settings import WrongOptionError
from colmap_sph.errors import InputError, printable, reason_of
from colmap_sph.project.files import read_small

logger = logging.getLogger(__name__)

_MAX_PROJECT_BYTES = 1 << 20
_TRUE = frozenset({"1", "true", "yes", "on"})
_FALSE = frozenset({"0", "false", "no", "off"})


class ParseError(WrongOptionError):
    """Options that COLMAP would not take."""

    def __init__(self, words: str) -> None:
        super().__init__(f"Failed to parse options - {words}.")


@dataclass(frozen=True)
class Given:
    """What a user gave to a command.

    Attributes
    ----------
    plain : mapping of str to value
        Options without a section, all of them: COLMAP's defaults where nothing was given.
    sectioned : mapping of str to value
        Options of the command's section that were given, by name without the section.
    idle : tuple of str
        Flags of those that were given and have no effect here.
    """

    plain: Mapping[str, Value]
    sectioned: Mapping[str, Value]
    idle: tuple[str, ...]


def parse(command: ColmapCommand, arguments: Sequence[str]) -> Given | None:
    """Read a command's arguments; None where help is asked for.

    What is on the command line counts as given, be it COLMAP's default or not. Project files hold all options, as
    COLMAP writes them: what is at its default there was not chosen.

    Raises
    ------
    ParseError
        As COLMAP words it.
    """
    flags = command.flags()
    parser = _Parser(prog="colmap", add_help=False, allow_abbrev=True, argument_default=argparse.SUPPRESS)
    parser.add_argument("-h", "--help", action="store_true")
    for flag in ("project_path", *flags):
        parser.add_argument(f"--{flag}", dest=flag, action="append")
    typed = vars(parser.parse_args(_glued(arguments)))
    if typed.pop("help", False):
        return None
    for flag, values in typed.items():
        if len(values) > 1:
            raise ParseError(f"option '--{flag}' cannot be specified more than once")
    words = {flag: values[0] for flag, values in typed.items()}
    project = words.pop("project_path", None)
    values = {} if project is None else _chosen(flags, _read_project(Path(project), command, flags))
    values |= {flag: convert(flag, flags[flag], word) for flag, word in words.items()}
    for name in command.required:
        if not values.get(name):
            raise ParseError(f"the option '--{name}' is required but missing")
    return given_from(command, values)


def given_from(command: ColmapCommand, values: Mapping[str, Value]) -> Given:
    """Sort the values of flags."""
    start = f"{command.section}."
    plain = {option.name: values.get(option.name, option.default) for option in command.plain}
    sectioned = {flag.removeprefix(start): value for flag, value in values.items() if flag.startswith(start)}
    flags = command.flags()
    idle = [flag for flag in values if not flags[flag].acts]
    return Given(plain, sectioned, tuple(idle))


def convert(flag: str, option: ColmapOption, word: str) -> Value:
    """Read the value of an option; `ParseError` where it is none."""
    kind = type(option.default)
    try:
        if kind is bool:
            if word.lower() not in _TRUE | _FALSE:
                raise ValueError
            return word.lower() in _TRUE
        return kind(word)
    except ValueError:
        raise ParseError(f"the argument ('{printable(word)}') for option '--{flag}' is invalid") from None


class _Parser(argparse.ArgumentParser):
    """Speaks as COLMAP's parser does."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong."""
        raise ParseError(_as_colmap(message))

    def parse_args(self, arguments: Any = None, namespace: Any = None) -> Any:
        """Read all arguments."""
        known, unknown = self.parse_known_args(arguments, namespace)
        if unknown:
            name = unknown[0].partition("=")[0]
            if not name.startswith("-"):
                raise ParseError(f"'{printable(name)}' is not an option, which begin with --")
            raise ParseError(f"unrecognised option '{printable(name)}'")
        return known


def _as_colmap(message: str) -> str:
    """What `argparse` says of a flag without a value, with one too many, or short for several, as COLMAP does."""
    flag = message.removeprefix("argument ").partition(":")[0]
    if "ignored explicit argument" in message:
        return f"option '{flag.rpartition('/')[2]}' does not take any arguments"
    if "expected one argument" in message:
        return f"the required argument for option '{flag}' is missing"
    return f"option {printable(message).replace('ambiguous option: ', '', 1)}"


def _glued(arguments: Sequence[str]) -> list[str]:
    """Arguments in which values that begin with a dash, as -1,0 does, stand behind an equals sign."""
    glued: list[str] = []
    for argument in arguments:
        is_value = argument[:1] == "-" and argument[1:2].isdigit()
        if is_value and glued and glued[-1].startswith("--") and "=" not in glued[-1]:
            glued[-1] = f"{glued[-1]}={argument}"
        else:
            glued.append(argument)
    return glued


def _read_project(path: Path, command: ColmapCommand, flags: Mapping[str, ColmapOption]) -> dict[str, Value]:
    """Values of a project file of COLMAP: ``name=value`` lines, those of commands below their ``[Section]``."""
    try:
        text = read_small(path, _MAX_PROJECT_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read ({reason_of(error)}); check --project_path.") from None
    values: dict[str, Value] = {}
    section = ""
    for number, line in enumerate(text.split("\n"), 1):
        line = line.partition("#")[0].strip()
        if not line:
            continue
        if line.startswith("[") and line.endswith("]"):
            section = line[1:-1].strip()
            continue
        name, equals, word = (part.strip() for part in line.partition("="))
        if not equals:
            raise InputError(f"{path}, line {number}: {line!r} is not name=value; mend it.")
        flag = f"{section}.{name}" if section else name
        if flag in flags:
            values[flag] = convert(flag, flags[flag], word)
        elif section == command.section:
            logger.warning("%s, line %d: COLMAP's %s has no option %s; ignored", path, number, command.name, flag)
    return values


def _chosen(flags: Mapping[str, ColmapOption], values: Mapping[str, Value]) -> dict[str, Value]:
    return {flag: value for flag, value in values.items() if not is_default(flags[flag], value)}
