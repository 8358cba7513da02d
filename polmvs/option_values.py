"""Options as text, as TOML and JSON values, and back; the types of the dataclass fields decide.

A field may be ``bool``, ``int``, ``float``, ``str``, ``Path``, a ``StrEnum``, a tuple of numbers or
a mixed tuple such as ``tuple[str, str, float]``, each also ``| None``. On the command line a tuple
of numbers is one text with commas, a mixed tuple as many texts as it has elements.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from polmvs.errors import OptionError

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class FieldInfo:
    """One field of an options class.

    Attributes
    ----------
    name : of the field.
    kind : its type without ``None``: a class, or ``tuple[...]``.
    default : its default value.
    help_text : what it means, with the unit.
    metavar : names of a mixed tuple's elements, if it has any.
    """

    name: str
    kind: Any
    default: Any
    help_text: str
    metavar: tuple[str, ...] | None = None

    @property
    def flag(self) -> str:
        """Its flag on the command line."""
        return "--" + self.name.replace("_", "-")


def describe_fields(cls: type) -> tuple[FieldInfo, ...]:
    """Fields of an options class in order."""
    hints = typing.get_type_hints(cls)
    defaults = cls()
    return tuple(
        FieldInfo(
            name=f.name,
            kind=_without_none(hints[f.name]),
            default=getattr(defaults, f.name),
            help_text=f.metadata.get("help", ""),
            metavar=f.metadata.get("metavar"),
        )
        for f in fields(cls)
    )


def mixed_kinds(kind: Any) -> tuple[Any, ...]:
    """Types of the elements of a mixed tuple, in order; empty for every other type."""
    elements = typing.get_args(kind) if typing.get_origin(kind) is tuple else ()
    is_mixed = len(set(elements)) > 1 and Ellipsis not in elements
    return elements if is_mixed else ()


def parse_text(kind: Any, text: str) -> Any:
    """Value of a field from the command line; a tuple is a list with commas.

    Raises
    ------
    ValueError
        The text is no value of that type.
    """
    if typing.get_origin(kind) is tuple:
        element = typing.get_args(kind)[0]
        return tuple(parse_text(element, part.strip()) for part in text.split(","))
    value = kind(text)
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def to_plain(value: Any) -> Any:
    """A value, or a whole dataclass, in terms of JSON; NaN and infinity become None."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, Path):
        return str(value.absolute())  # a run may go on from another folder
    if hasattr(value, "item"):  # a NumPy scalar
        return to_plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def from_plain(cls: type[T], values: Mapping[str, Any], source: str) -> T:
    """An options object from JSON or TOML values; fields that are not named keep their default.

    Parameters
    ----------
    cls : the options class.
    values : by field name.
    source : what the values belong to, for messages.

    Raises
    ------
    OptionError
        A name is unknown, or a value is of the wrong type or out of range.
    """
    known = {info.name: info for info in describe_fields(cls)}
    converted = {}
    for name, value in values.items():
        if name not in known:
            raise OptionError(f"{source}: unknown key {name!r}; known are {', '.join(known)}.")
        info = known[name]
        # JSON has null for None, TOML leaves the key out.
        if value is None and info.default is None:
            continue
        try:
            converted[name] = _convert(info.kind, value)
        except (TypeError, ValueError) as error:
            raise OptionError(f"{source}: {name} cannot be {value!r} ({error}).") from error
    return cls(**converted)


def _convert(kind: Any, value: Any) -> Any:
    """One JSON or TOML value in the field's type; strict, so that a slip does not pass."""
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list | tuple):
            raise TypeError("a list is expected")
        if kinds := mixed_kinds(kind):
            if len(value) != len(kinds):
                raise TypeError(f"a list of {len(kinds)} is expected")
            return tuple(map(_convert, kinds, value))
        element = typing.get_args(kind)[0]
        return tuple(_convert(element, item) for item in value)
    expected: tuple[type, ...] = (kind,)
    if kind is float:
        expected = (int, float)
    elif issubclass(kind, StrEnum | Path):
        expected = (str, Path)
    if not isinstance(value, expected) or (isinstance(value, bool) and kind is not bool):
        raise TypeError(f"{_describe(kind)} is expected")
    converted = kind(value)
    if isinstance(converted, float) and not math.isfinite(converted):
        raise ValueError("a finite number is expected")
    return converted


def _describe(kind: type) -> str:
    names = {bool: "true or false", int: "a whole number", float: "a number"}
    return names.get(kind, "text")


def _without_none(hint: Any) -> Any:
    """``X`` of ``X | None``."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return next(arg for arg in typing.get_args(hint) if arg is not type(None))
    return hint
