"""The options of commands with their texts, read from the records: for their help and for docs/options.md."""

import ast
import inspect
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from textwrap import dedent, fill
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from rich.cells import cell_len
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from colmap_sph.app.spelling import flag_of


@dataclass(frozen=True)
class Option:
    """An option of the command line.

    Attributes
    ----------
    place : str
        In the records, such as "vote.min_support".
    kind : type
        Of its values.
    is_switch : bool
        Whether it is typed without a value.
    is_positional : bool
    record : type
        The dataclass it is a field of.
    field : dataclasses.Field
    """

    place: str
    kind: Any
    is_switch: bool
    is_positional: bool
    record: type
    field: "Field[Any]"

    @property
    def flag(self) -> str:
        """As it is typed; of a positional argument the word that stands for it."""
        return self.place.upper() if self.is_positional else flag_of(self.place)

    @property
    def full_flag(self) -> str:
        """The flag that the records give it, which is how the parser knows it."""
        return f"--{self.place.replace('_', '-')}"

    @property
    def is_required(self) -> bool:
        """Whether it has no default."""
        return self.field.default is MISSING and self.field.default_factory is MISSING

    @property
    def values(self) -> str:
        """What it takes: a kind of value, or a choice of words; empty where it takes none."""
        return "" if self.is_switch or self.is_positional else _values_of(self.kind)

    @property
    def default(self) -> str:
        """Empty where there is none to speak of."""
        default = self.field.default
        if default in (None, "", MISSING, ()) or (self.is_switch and not default):
            return ""
        return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)

    @property
    def text(self) -> str:
        """What it does, in whole sentences, in which other options of its record are called as they are typed."""
        texts = _texts_of(self.record)
        stage = self.place.rpartition(".")[0]
        flags = {name: flag_of(f"{stage}.{name}" if stage else name) for name in texts}
        return re.sub(r"`(\w+)`", lambda match: flags.get(match[1], match[0]), texts[self.field.name])

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
# And that are left for the text at least, where it stands beside these.
_NARROWEST = 30
# Records whose options have no prefix.
_TAKEN_APART = ("project", "options", "georeference")


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
    yield OptionGroup("", _text_of(record), tuple(plain))
    yield from stages


def _take_apart(
    record: type, plain: list[Option], stages: list[OptionGroup], *, has_switches: bool = True
) -> None:
    for field, kind, marks in _fields_of(record):
        if not (isinstance(kind, type) and is_dataclass(kind)):
            is_switch = has_switches and kind is bool
            plain.append(Option(field.name, kind, is_switch, tyro.conf.Positional in marks, record, field))
        elif field.name in _TAKEN_APART:
            _take_apart(kind, plain, stages, has_switches=tyro.conf.FlagConversionOff not in marks)
        else:
            options = (
                Option(f"{field.name}.{each.name}", its_kind, False, False, kind, each)
                for each, its_kind, _ in _fields_of(kind)
            )
            stages.append(OptionGroup(field.name, _text_of(kind), tuple(options)))


def _fields_of(record: type) -> Iterator[tuple["Field[Any]", Any, tuple[Any, ...]]]:
    """The fields of a dataclass, each with the kind of its values and how it is marked for the parser."""
    kinds = get_type_hints(record, include_extras=True)
    for field in fields(record):
        annotated = kinds[field.name]
        marks = getattr(annotated, "__metadata__", ())
        yield field, get_args(annotated)[0] if marks else annotated, marks


def _values_of(kind: Any) -> str:
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        return f"{_values_of(kinds[0])} ..." if kinds[-1] is Ellipsis else " ".join(map(_values_of, kinds))
    if get_origin(kind) is Literal:
        return "{" + ",".join(map(str, get_args(kind))) + "}"
    if get_origin(kind) in (UnionType, Union):
        return "|".join(_values_of(each) for each in get_args(kind) if each is not NoneType)
    return {int: "N", float: "X", bool: "{True,False}", Path: "PATH", str: "TEXT"}[kind]


@cache
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


def _text_of(record: type) -> str:
    return _one_paragraph(inspect.getdoc(record) or "")


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
    """Print options, each with its text."""
    print_explained([(_as_typed(option), option.text_with_default) for option in options], console)


def print_explained(rows: Sequence[tuple[str, str]], console: Console) -> None:
    """Print words with what they mean: beside them, or below where the console is too narrow for that."""
    widest = max((cell_len(line) for words, _ in rows for line in words.splitlines()), default=0)
    longest = max((cell_len(word) for _, meaning in rows for word in meaning.split()), default=0)
    if console.width - widest - 2 < max(longest, _NARROWEST):
        for words, meaning in rows:
            console.print(Text(words), soft_wrap=True)
            console.print(Padding(Text(meaning), (0, 0, 0, 6)))
        return
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column()
    for words, meaning in rows:
        table.add_row(Text(words), Text(meaning))
    console.print(table)


def _as_typed(option: Option) -> str:
    if option.is_switch and option.default:
        return f"  {option.flag.replace('--', '--[no-]', 1)}"
    typed = f"  {option.flag} {option.values}".rstrip()
    if len(typed) <= _WIDEST:
        return typed
    # Many words to choose from take several lines.
    return fill(typed.replace(",", ", "), _WIDEST, subsequent_indent="    ").replace(", ", ",")
