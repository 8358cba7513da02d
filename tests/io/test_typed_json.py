"""JSON into dataclasses and back: every type that records hold, and what does not fit."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import pytest

from polmvs.io.typed_json import from_json, parse_json, write_json


class Colour(StrEnum):
    RED = "red"


@dataclass(frozen=True)
class Inner:
    number: int


@dataclass(frozen=True)
class Everything:
    share: float
    pair: tuple[int, str]
    many: tuple[float, ...]
    table: Mapping[str, Inner]
    colour: Colour
    place: Path
    maybe: Inner | None
    whatever: Any


CONTENT = {
    "share": 1,
    "pair": [3, "a"],
    "many": [1.5, 2, 3.25],
    "table": {"one": {"number": 1}, "two": {"number": 2}},
    "colour": "red",
    "place": "/a/b",
    "maybe": None,
    "whatever": {"x": [1, None, "y"]},
}
VALUE = Everything(
    share=1.0,
    pair=(3, "a"),
    many=(1.5, 2.0, 3.25),
    table={"one": Inner(1), "two": Inner(2)},
    colour=Colour.RED,
    place=Path("/a/b"),
    maybe=None,
    whatever={"x": [1, None, "y"]},
)


def test_every_type_is_read():
    found = from_json(Everything, CONTENT)
    assert found == VALUE
    assert isinstance(found.share, float)
    assert from_json(Everything, {**CONTENT, "maybe": {"number": 7}}).maybe == Inner(7)


def test_what_is_written_is_read(tmp_path: Path):
    write_json(tmp_path / "a.json", VALUE)
    assert from_json(Everything, parse_json((tmp_path / "a.json").read_text())) == VALUE


def test_what_is_no_number_is_null():
    assert math.isnan(from_json(Everything, {**CONTENT, "share": None}).share)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"pair": [3]}, "pair has 1 elements, not 2"),
        ({"pair": [3, "a", 4]}, "pair has 3 elements, not 2"),
        ({"many": 1.0}, "many"),
        ({"many": [1.0, "x"]}, r"many\[1\]"),
        ({"table": {"one": {"number": True}}}, "table.one.number"),
        ({"table": {"one": {}}}, "table.one lacks 'number'"),
        ({"table": {"one": {"number": 1, "more": 2}}}, "table.one has an unknown key 'more'"),
        ({"colour": "blue"}, "blue"),
        ({"maybe": 3}, "maybe"),
        ({"share": "1"}, "share"),
    ],
)
def test_what_does_not_fit_is_named(change, words):
    with pytest.raises(ValueError, match=words):
        from_json(Everything, {**CONTENT, **change})
