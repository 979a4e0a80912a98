"""The options of `run` with their texts, read from the records: for its help and for docs/options.md."""

import ast
import inspect
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from textwrap import dedent
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from colmap_sph.app.spelling import flag_of


@dataclass(frozen=True)
class Option:
    """An option of the command line.

    Attributes
    ----------
    flag : str
        As it is typed.
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
    """

    flag: str
    values: str
    default: str
    text: str
    place: str
    kind: Any

    @property
    def is_switch(self) -> bool:
        """Whether it is typed without a value."""
        return "." not in self.place and self.kind is bool

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


def option_groups(record: type) -> Iterator[OptionGroup]:
    """The options of a command's record: those without a prefix first, then stage by stage.

    Parameters
    ----------
    record : type
        A dataclass whose fields are options, records that are taken apart (called "project" or "options"), or
        stages' records.
    """
    plain: list[Option] = []
    stages: list[OptionGroup] = []
    _take_apart(record, plain, stages)
    yield OptionGroup("", _one_paragraph(inspect.getdoc(record) or ""), tuple(plain))
    yield from stages


def _take_apart(record: type, plain: list[Option], stages: list[OptionGroup]) -> None:
    types = get_type_hints(record)
    texts = _texts_of(record)
    for field in fields(record):
        kind = types[field.name]
        if not (isinstance(kind, type) and is_dataclass(kind)):
            plain.append(_option(field.name, kind, field.default, texts[field.name]))
        elif field.name in ("project", "options"):
            _take_apart(kind, plain, stages)
        else:
            stages.append(_stage_group(field.name, kind))


def _stage_group(name: str, record: type) -> OptionGroup:
    types = get_type_hints(record)
    texts = _texts_of(record)
    options = (
        _option(f"{name}.{field.name}", types[field.name], field.default, texts[field.name])
        for field in fields(record)
    )
    return OptionGroup(name, _one_paragraph(inspect.getdoc(record) or ""), tuple(options))


def _option(place: str, kind: Any, default: object, text: str) -> Option:
    is_switch = "." not in place and kind is bool
    shown = "" if default in (None, "", MISSING) or is_switch else str(default)
    return Option(flag_of(place), "" if is_switch else _values_of(kind), shown, text, place, kind)


def _values_of(kind: Any) -> str:
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
