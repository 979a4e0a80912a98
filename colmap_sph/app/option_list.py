"""The options of commands with their texts, read from the records: for their help and for docs/options.md."""

import ast
import inspect
import io
from collections.abc import Iterable, Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from pathlib import Path
from textwrap import dedent, fill
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from colmap_sph.app.spelling import flag_of


@dataclass(frozen=True)
class Option:
    """An option of the command line.

    Attributes
    ----------
    flag : str
        As it is typed; of a positional argument the word that stands for it.
    values : str
        What it takes: a kind of value, or a choice of words; empty where it takes none.
    default : str
        Empty where there is none to speak of.
    text : str
        What it does, in whole sentences.
    place : str
        In the records, such as "vote.min_support".
    kind : type
        Of its values.
    is_switch : bool
        Whether it is typed without a value.
    is_required, is_positional : bool
    """

    flag: str
    values: str
    default: str
    text: str
    place: str
    kind: Any
    is_switch: bool = False
    is_required: bool = False
    is_positional: bool = False

    @property
    def full_flag(self) -> str:
        """The flag that the records give it, which is how the parser knows it."""
        return f"--{self.place.replace('_', '-')}"

    @property
    def text_with_default(self) -> str:
        """The text, and the default where there is one."""
        return f"{self.text} Default: {self.default}." if self.default else self.text


@dataclass(frozen=True)
class OptionGroup:
    """The options of one record, with what the record says of itself; named as in the flags, or ""."""

    name: str
    text: str
    options: tuple[Option, ...]


# Characters of help that an option and its values take, beside its text.
_WIDEST = 48
# Records whose options have no prefix.
TAKEN_APART = ("project", "options", "georeference")


def option_groups(record: type) -> Iterator[OptionGroup]:
    """The options of a command's record: those without a prefix first, then stage by stage.

    Parameters
    ----------
    record : type
        A dataclass whose fields are options, records that are taken apart, or stages' records.
    """
    plain: list[Option] = []
    stages: list[OptionGroup] = []
    _take_apart(record, plain, stages)
    yield OptionGroup("", _one_paragraph(inspect.getdoc(record) or ""), tuple(plain))
    yield from stages


def _take_apart(
    record: type, plain: list[Option], stages: list[OptionGroup], *, has_switches: bool = True
) -> None:
    types = get_type_hints(record, include_extras=True)
    texts = _texts_of(record)
    for field in fields(record):
        kind, marks = without_marks(types[field.name])
        if not (isinstance(kind, type) and is_dataclass(kind)):
            option = _option(field.name, kind, field, texts[field.name], is_switch=has_switches and kind is bool)
            plain.append(_positional(option) if tyro.conf.Positional in marks else option)
        elif field.name in TAKEN_APART:
            _take_apart(kind, plain, stages, has_switches=tyro.conf.FlagConversionOff not in marks)
        else:
            stages.append(_stage_group(field.name, kind))


def without_marks(annotated: Any) -> tuple[Any, tuple[Any, ...]]:
    """A kind of values, and how it is marked for the parser."""
    marks = getattr(annotated, "__metadata__", ())
    return (get_args(annotated)[0] if marks else annotated), marks


def _stage_group(name: str, record: type) -> OptionGroup:
    types = get_type_hints(record)
    texts = _texts_of(record)
    options = (
        _option(f"{name}.{field.name}", types[field.name], field, texts[field.name]) for field in fields(record)
    )
    return OptionGroup(name, _one_paragraph(inspect.getdoc(record) or ""), tuple(options))


def _option(place: str, kind: Any, field: "Field[Any]", text: str, *, is_switch: bool = False) -> Option:
    is_told = field.default not in (None, "", MISSING, ()) and not (is_switch and not field.default)
    default = _words_of(field.default) if is_told else ""
    values = "" if is_switch else _values_of(kind)
    return Option(flag_of(place), values, default, text, place, kind, is_switch, field.default is MISSING)


def _positional(option: Option) -> Option:
    return replace(option, flag=option.place.upper(), values="", is_positional=True)


def _words_of(default: object) -> str:
    return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)


def _values_of(kind: Any) -> str:
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        return f"{_values_of(kinds[0])} ..." if kinds[-1] is Ellipsis else " ".join(map(_values_of, kinds))
    if get_origin(kind) is Literal:
        return "{" + ",".join(map(str, get_args(kind))) + "}"
    if get_origin(kind) in (UnionType, Union):
        return "|".join(_values_of(each) for each in get_args(kind) if each is not NoneType)
    return {int: "N", float: "X", bool: "{True,False}", Path: "PATH", str: "TEXT"}[kind]


def _texts_of(record: type) -> dict[str, str]:
    """The docstring below each field of a dataclass."""
    (definition,) = ast.parse(dedent(inspect.getsource(record))).body
    assert isinstance(definition, ast.ClassDef)
    texts = {}
    for field, text in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            assert isinstance(text.value, ast.Constant)
            texts[field.target.id] = _one_paragraph(str(text.value.value))
    return texts


def _one_paragraph(text: str) -> str:
    return " ".join(text.split())


# ---- help --------------------------------------------------------------------------------------------------


def help_of(name: str, command: type) -> str:
    """What a command does, and all its options.

    Parameters
    ----------
    name : str
    command : type
        The record of its options, none of them of a stage.
    """
    (group,) = option_groups(command)
    places = [option for option in group.options if option.is_positional]
    others = [option for option in group.options if not option.is_positional]
    needed = [f"{option.flag} {option.values}" for option in others if option.is_required]
    words = [option.flag if option.is_required else f"[{option.flag} ...]" for option in places]
    usage = " ".join(["usage: colmap_sph", name, *needed, "[OPTIONS]", *words])
    text = io.StringIO()
    console = Console(file=text)
    console.print(f"{usage}\n\n{group.text}\n", highlight=False, markup=False)
    print_options([*places, *others], console)
    return text.getvalue().rstrip()


def print_options(options: Iterable[Option], console: Console) -> None:
    """Print options, each with its text beside it."""
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column()
    for option in options:
        table.add_row(Text(_as_typed(option)), Text(option.text_with_default))
    console.print(table)


def _as_typed(option: Option) -> str:
    if option.is_switch and option.default:
        return f"  {option.flag.replace('--', '--[no-]', 1)}"
    typed = f"  {option.flag} {option.values}".rstrip()
    if len(typed) <= _WIDEST:
        return typed
    # Many words to choose from take several lines.
    return fill(typed.replace(",", ", "), _WIDEST, subsequent_indent="    ").replace(", ", ",")
