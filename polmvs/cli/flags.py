"""Flags made from the options' dataclass fields, and options from flags, a file and a record."""

from __future__ import annotations

import argparse
import tomllib
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from polmvs.config import Options, RunOptions
from polmvs.errors import DataError, OptionError
from polmvs.option_values import (
    FieldInfo,
    describe_fields,
    from_plain,
    mixed_kinds,
    parse_text,
    to_plain,
)
from polmvs.pipeline.record import read_options
from polmvs.pipeline.run_folder import RunFolder

T = TypeVar("T")

# Groups of options, as they are called in ``Options``, in TOML files and in ``run.json``.
GROUPS: dict[str, type] = {info.name: info.kind for info in describe_fields(Options)}
RUN_GROUP = "run"


class Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        """End the program with status 2."""
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def add_flags(parser: argparse.ArgumentParser, groups: Iterable[str]) -> None:
    """Add the flags of some groups of options, and ``--config``."""
    names = tuple(groups)
    for name in names:
        cls = GROUPS[name]
        section = parser.add_argument_group(name, _first_line(cls))
        for info in describe_fields(cls):
            _add_flag(section, name, info)
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help=f"TOML file with options in tables named {', '.join(names)}; flags go before it",
    )
    parser.set_defaults(groups=names)


def add_run_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say how a run is carried out."""
    section = parser.add_argument_group("run", _first_line(RunOptions))
    for info in describe_fields(RunOptions):
        _add_flag(section, RUN_GROUP, info)


def run_options(args: argparse.Namespace) -> RunOptions:
    """How the run is carried out."""
    return RunOptions(**_given(args, RUN_GROUP, RunOptions))


def options_from(args: argparse.Namespace, recorded: Mapping[str, Any] | None = None) -> Options:
    """Options from, each before the next: flags, ``--config``, an earlier run, the defaults.

    Raises
    ------
    OptionError, DataError
        A value is unusable, or the file has an unknown key.
    """
    file = read_config(args.config, args.groups) if args.config is not None else {}
    layers = [recorded or {}, file]
    groups: dict[str, Any] = {}
    for name, cls in GROUPS.items():
        values: dict[str, Any] = {}
        for layer in layers:
            values |= layer.get(name, {})
        values |= to_plain(_given(args, name, cls))
        groups[name] = from_plain(cls, values, f"[{name}]")
    return Options(**groups)


def recorded_options(out: Path) -> Mapping[str, Any]:
    """Options of the run in a folder; empty where there is none."""
    return read_options(RunFolder(out))


def read_config(path: Path, groups: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Read a TOML file of options.

    Raises
    ------
    DataError
        It is missing, no TOML, or has an unknown table or key, which is named.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(path, f"cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise DataError(path, f"is no TOML file ({error}).") from error
    known = tuple(groups)
    for name, table in content.items():
        if name not in known or not isinstance(table, dict):
            raise DataError(path, f"unknown table {name!r}; known are {', '.join(known)}.")
        try:
            from_plain(GROUPS[name], table, f"[{name}]")
        except OptionError as error:
            raise DataError(path, str(error)) from error
    return content


def _add_flag(section: Any, group: str, info: FieldInfo) -> None:
    """One flag; without a default, so that only what was given counts."""
    common: dict[str, Any] = {
        "dest": f"{group}.{info.name}",
        "default": argparse.SUPPRESS,
        "help": f"{info.help_text} (default: {_show(info.default)})".replace("%", "%%"),
    }
    if info.kind is bool:
        section.add_argument(info.flag, action=argparse.BooleanOptionalAction, **common)
    elif isinstance(info.kind, type) and issubclass(info.kind, StrEnum):
        section.add_argument(info.flag, type=info.kind, choices=list(info.kind), **common)
    elif kinds := mixed_kinds(info.kind):
        common["metavar"] = info.metavar or tuple(map(_metavar, kinds))
        section.add_argument(info.flag, nargs=len(kinds), action=_StoreMixed, kinds=kinds, **common)
    else:
        metavar = _metavar(info.kind)
        section.add_argument(info.flag, type=_parser_of(info.kind), metavar=metavar, **common)


class _StoreMixed(argparse.Action):
    """Stores a mixed tuple; each element is read as its own type, which ``type=`` cannot."""

    def __init__(self, *args: Any, kinds: tuple[Any, ...], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.kinds = kinds

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Convert the texts and store them."""
        try:
            parts = [
                _parser_of(kind)(text) for kind, text in zip(self.kinds, values or (), strict=True)
            ]
        except argparse.ArgumentTypeError as error:
            raise argparse.ArgumentError(self, str(error)) from error
        setattr(namespace, self.dest, tuple(parts))


def _parser_of(kind: Any) -> Callable[[str], Any]:
    def parse(text: str) -> Any:
        try:
            return parse_text(kind, text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(
                f"{text!r} cannot be read as {_metavar(kind)}"
            ) from error

    return parse


def _metavar(kind: Any) -> str:
    if typing.get_origin(kind) is tuple:
        return f"{_metavar(typing.get_args(kind)[0])},..."
    return {int: "INT", float: "NUMBER", Path: "PATH"}.get(kind, "NAME")


def _show(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None else str(value)


def _given(args: argparse.Namespace, group: str, cls: type) -> dict[str, Any]:
    """What was given on the command line, by field."""
    values = vars(args)
    keys = {info.name: f"{group}.{info.name}" for info in describe_fields(cls)}
    return {name: values[key] for name, key in keys.items() if key in values}


def _first_line(cls: type) -> str:
    return (cls.__doc__ or "").splitlines()[0]
