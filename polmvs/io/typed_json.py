"""JSON files of typed results: dataclasses are written, and read back with their types."""

from __future__ import annotations

import json
import math
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

from polmvs.config import to_plain
from polmvs.errors import MAX_QUOTED
from polmvs.io.images import write_bytes

T = TypeVar("T")
Pairs = Callable[[list[tuple[str, Any]]], Any]


def json_bytes(content: Any) -> bytes:
    """Dataclasses, mappings and sequences as JSON; NaN becomes null."""
    return (json.dumps(to_plain(content), indent=1, allow_nan=False) + "\n").encode()


def write_json(path: Path, content: Any) -> None:
    """Write :func:`json_bytes`, whole or not at all."""
    write_bytes(path, json_bytes(content))


def parse_json(text: str, pairs: Pairs | None = None) -> Any:
    """The value of a JSON text.

    Parameters
    ----------
    pairs : converts an object's keys and values, instead of a dictionary.

    Raises
    ------
    ValueError
        It is not JSON, nested too deeply, or has an integer of thousands of digits.
    """
    try:
        return json.loads(text, object_pairs_hook=pairs)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def from_json(kind: type[T], value: Any, where: str = "") -> T:
    """A value of a type from its JSON form.

    Parameters
    ----------
    kind : a dataclass, or a type of its fields: ``bool``, ``int``, ``float``, ``str``, ``Path``,
        enums, tuples, mappings, other dataclasses, ``Any``, and each of these or None.
    value : from ``json.loads``. A null is None, or NaN for a float.
    where : path of the value in the file, for messages.

    Raises
    ------
    ValueError
        A key is missing or unknown, or a value is of another type; the message names it.
    """
    return typing.cast(T, _decode(kind, value, where))


def _decode(kind: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return value
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in arguments:
            return None
        return _decode(next(a for a in arguments if a is not type(None)), value, where)
    if is_dataclass(kind) and isinstance(kind, type):
        return _decode_dataclass(kind, value, where)
    if origin is tuple:
        return _decode_tuple(arguments, value, where)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        items = _expect(value, dict, where).items()
        return {
            _decode(arguments[0], key, where): _decode(arguments[1], item, f"{where}.{key}")
            for key, item in items
        }
    if kind is float:
        number = math.nan if value is None else _expect(value, (int, float), where)
        return float(number)
    if isinstance(kind, type) and issubclass(kind, Enum | Path):
        return kind(_expect(value, (str, int), where))
    return _expect(value, kind, where)


def _decode_dataclass(kind: Any, value: Any, where: str) -> Any:
    content = _expect(value, dict, where)
    hints = typing.get_type_hints(kind)
    names = {field.name for field in fields(kind)}
    if unknown := sorted(content.keys() - names):
        raise ValueError(f"{_place(where)} has an unknown key {unknown[0][:MAX_QUOTED]!r}")
    if missing := sorted(names - content.keys()):
        raise ValueError(f"{_place(where)} lacks {missing[0]!r}")
    return kind(
        **{name: _decode(hints[name], item, f"{where}.{name}") for name, item in content.items()}
    )


def _decode_tuple(elements: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    items = _expect(value, list, where)
    if Ellipsis in elements:
        elements = (elements[0],) * len(items)
    if len(items) != len(elements):
        raise ValueError(f"{_place(where)} has {len(items)} elements, not {len(elements)}")
    pairs = zip(elements, items, strict=True)
    return tuple(_decode(kind, item, f"{where}[{i}]") for i, (kind, item) in enumerate(pairs))


def _expect(value: Any, kind: Any, where: str) -> Any:
    """Return the value if it has that type; true and false do not count as numbers."""
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{_place(where)} cannot be {str(value)[:MAX_QUOTED]!r}")
    return value


def _place(where: str) -> str:
    return where.lstrip(".")[:MAX_QUOTED] or "the file"
