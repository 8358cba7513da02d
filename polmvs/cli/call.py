"""One call of a command: the given values, and the options that result."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from polmvs.config import (
    OptionGroup,
    Options,
    describe_fields,
    groups_of,
    in_table,
    option,
    require_table,
    values_from_plain,
)
from polmvs.errors import OptionError, as_data_error

Group = TypeVar("Group", bound=OptionGroup)


@dataclass(frozen=True, kw_only=True)
class FileOptions(OptionGroup, group="file", in_files=False):
    """Options from a file."""

    config: Path | None = option(
        None, "TOML file with options in tables named as the groups here; flags go before it"
    )


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(OptionGroup, group="recording", in_files=False):
    """A recording to look at."""

    rerun: Path | None = option(
        None,
        "recording to write for the Rerun viewer (extra 'rerun'): cameras, images, phases, clouds "
        "and the surface as it refines, stage by stage",
        metavar="FILE.rrd",
    )


@dataclass(frozen=True, kw_only=True)
class TerminalOptions(OptionGroup, group="terminal", in_files=False):
    """What is shown."""

    verbose: bool = option(False, "show every step")
    quiet: bool = option(False, "show errors and the result only: no progress, no warnings")
    json: bool = option(False, "print the result as JSON; nothing else but errors is shown")

    def check(self) -> None:
        """One or the other."""
        self.require(
            not (self.verbose and self.quiet), "verbose", "and `terminal.quiet` exclude each other"
        )


@dataclass(frozen=True, kw_only=True)
class Call:
    """A parsed command line.

    Attributes
    ----------
    given : values of the given arguments and flags, by path.
    tables : groups that may be tables of the file of ``--config``.
    command_line : as it was typed, for the record.
    """

    given: Mapping[str, Any]
    tables: tuple[type[OptionGroup], ...] = ()
    command_line: list[str] = field(default_factory=list)

    def get(self, cls: type[Group], recorded: Mapping[str, Any] | None = None) -> Group:
        """A group of options. Precedence: flags, the file, an earlier run, defaults.

        Parameters
        ----------
        cls : the group.
        recorded : values of an earlier run as JSON, by field; checked.

        Raises
        ------
        OptionError, DataError
            A value is unusable, or the file is.
        """
        flags = {
            info.name: self.given[info.path]
            for info in describe_fields(cls)
            if info.path in self.given
        }
        file = self.file.get(cls.group, {}) if cls.in_files else {}
        before = values_from_plain(cls, recorded or {})
        try:
            return cls(**{**before, **file, **flags})
        except OptionError as error:
            name = (error.field or "").partition(".")[2]
            if name in file and name not in flags:
                raise in_table(error, str(self.given["file.config"])) from error
            raise

    def options(self, recorded: Mapping[str, Any] | None = None) -> Options:
        """Options of all stages, with the same precedence.

        Parameters
        ----------
        recorded : those of an earlier run as JSON, by group and field; checked.
        """
        before = recorded or {}
        groups = groups_of(Options)
        made: dict[str, Any] = {name: self.get(c, before.get(name)) for name, c in groups.items()}
        return Options(**made)

    @cached_property
    def file(self) -> dict[str, dict[str, Any]]:
        """Values in the tables of the file of ``--config``; empty without one."""
        path = self.given.get("file.config")
        return {} if path is None else read_config(path, self.tables)


def read_config(path: Path, groups: tuple[type[OptionGroup], ...]) -> dict[str, dict[str, Any]]:
    """Values of a TOML file of options by table and key, in the fields' types.

    Parameters
    ----------
    path : the file.
    groups : allowed tables.

    Raises
    ------
    DataError
        It cannot be read.
    OptionError
        It is not TOML, or it has an unknown or repeated table or key or a value of a wrong type.
        The message names it.
    """
    from polmvs.io.plain_files import parse_toml, read_text  # not for --help

    try:
        with as_data_error(path, "read"):
            text = read_text(path)
    except UnicodeDecodeError as error:
        raise OptionError(f"{path}: is no TOML file (not UTF-8).") from error
    try:
        content = parse_toml(text)
    except ValueError as error:  # of the parser, or an integer of thousands of digits
        raise OptionError(f"{path}: is no TOML file ({error}{_line_of(text, error)}).") from error
    known = {cls.group: cls for cls in groups}
    values = {}
    for name, table in content.items():
        require_table(name, table, known, str(path))
        values[name] = values_from_plain(known[name], table, str(path))
    return values


def require_new(path: Path, *, overwrite: bool) -> None:
    """Refuse to replace an existing file unless the user asks for it.

    Raises
    ------
    OptionError
        It exists.
    """
    if path.exists() and not overwrite:
        raise OptionError(f"{path}: exists. Give `arguments.overwrite` to replace it.")


def _line_of(text: str, error: ValueError) -> str:
    """The line at fault: Python's message does not name the key that is there twice."""
    found = re.search(r"at line (\d+)", str(error))
    lines = text.splitlines()
    if found is None or int(found[1]) > len(lines):
        return ""
    return f": {lines[int(found[1]) - 1].strip()}"
