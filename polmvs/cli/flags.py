"""The command line's grammar: flags, help and usage errors, made by cyclopts from the options.

cyclopts gets one signature for each command, made of the fields of the command's groups. cyclopts
parses and reports errors of the syntax; the dataclasses check the values.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Group, Parameter
from cyclopts.exceptions import (
    CycloptsError,
    MissingArgumentError,
    RepeatArgumentError,
    UnusedCliTokensError,
)
from cyclopts.token import Token

import polmvs
from polmvs.cli.call import Call, FileOptions, RecordingOptions, TerminalOptions
from polmvs.config import (
    ExperimentOptions,
    FieldInfo,
    OptionGroup,
    Options,
    PlaneOptions,
    RunOptions,
    describe_fields,
    groups_of,
    show_value,
)
from polmvs.simulation.options import Simulation

_NAMED_IN_MESSAGES: tuple[type[OptionGroup], ...] = (
    *groups_of(Options).values(),
    *(RunOptions, PlaneOptions, ExperimentOptions),
    *(FileOptions, RecordingOptions, TerminalOptions),
    *groups_of(Simulation).values(),
)

HELP_ALL = "--help-all"


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command.

    Attributes
    ----------
    help_text : description, one line.
    run : a function of the call and the terminal that gives the exit status, or
        ``"module:function"``, which is imported when the command is run.
    groups : its options, in the order of its help; the first may hold its arguments.
    earlier : options of earlier stages, which its help shows on request.
    more : further text of its help.
    name : as it is typed; empty if the program has only this command.
    """

    help_text: str
    run: str | Callable[[Call, Any], int]
    groups: tuple[type[OptionGroup], ...]
    earlier: tuple[type[OptionGroup], ...] = ()
    more: str = ""
    name: str = ""

    @property
    def tables(self) -> tuple[type[OptionGroup], ...]:
        """Groups that may be tables of a file of options."""
        return tuple(cls for cls in (*self.groups, *self.earlier) if cls.in_files)


class UsageError(Exception):
    """The command line is invalid.

    Attributes
    ----------
    prog : program and command.
    message : the reason, one line.
    """

    def __init__(self, prog: str, message: str) -> None:
        super().__init__(message)
        self.prog = prog
        self.message = message


@dataclass(frozen=True, kw_only=True)
class Parsed:
    """A parsed command line.

    Attributes
    ----------
    prog : program and command, for messages.
    command : to be run with ``call``; None for the help or the version.
    call : its arguments and options.
    show : function that shows the help or the version.
    """

    prog: str
    command: Command | None = None
    call: Call | None = None
    show: Callable[[], Any] | None = None


def parse(commands: Sequence[Command], tokens: Sequence[str], prog: str, about: str = "") -> Parsed:
    """Read a command line.

    Parameters
    ----------
    commands : all commands; a single one without a name is the program itself.
    tokens : the command line after the program's name.
    prog : name of the program.
    about : description of the program, for its help.

    Raises
    ------
    UsageError
        A command, flag, argument or value is unknown, missing, malformed or repeated.
    """
    words = ["--help" if token == HELP_ALL else token for token in tokens]
    show_all = HELP_ALL in tokens
    named = {command.name: command for command in commands}
    chosen = named.get("") or named.get(words[0] if words else "")
    name = prog if chosen is None or not chosen.name else f"{prog} {chosen.name}"
    app = _app(prog, about)
    for rank, command in enumerate(commands):
        place = app if not command.name else _app(command.name, rank=rank)
        if command is chosen:  # the others' flags are not needed
            _complete(place, command, name, show_all=show_all)
        else:
            place.help = command.help_text
        if place is not app:
            app.command(place)
    try:
        if not words and not named.get(""):
            raise UsageError(name, f"a command is needed: {', '.join(named)}")
        function, bound, _ = app.parse_args(words, print_error=False, exit_on_error=False)
    except CycloptsError as error:
        raise UsageError(name, _message(error)) from error
    if chosen is None or not isinstance(function, _Signature):
        return Parsed(prog=name, show=lambda: function(*bound.args, **bound.kwargs))
    infos = [info for cls in (*chosen.groups, *chosen.earlier) for info in describe_fields(cls)]
    values = bound.arguments
    given = {info.path: values[_key(info)] for info in infos if _key(info) in values}
    for info in infos:  # cyclopts accepts an empty list of arguments
        if info.default is dataclasses.MISSING and info.path not in given:
            raise UsageError(name, f"{metavar_of(info)} is missing")
    call = Call(given=given, tables=chosen.tables, command_line=[prog, *tokens])
    return Parsed(prog=name, command=chosen, call=call)


def in_flags(text: str) -> str:
    """A message in which each option's path, between backquotes, is replaced by its flag."""
    flags = {info.path: info.flag for cls in _NAMED_IN_MESSAGES for info in describe_fields(cls)}

    def flag(found: re.Match[str]) -> str:
        group, _, name = found[1].partition(".")
        if group == "arguments":  # of whichever command; each has its own
            return "--" + name.replace("_", "-")
        return flags.get(found[1], found[1])

    return re.sub(r"`(\w+\.\w+)`", flag, text)


class _Signature:
    """Stands for a command's function: cyclopts reads its signature, and nobody calls it."""

    def __init__(self, parameters: Iterable[inspect.Parameter]) -> None:
        self.__signature__ = inspect.Signature(list(parameters))
        self.__annotations__ = {
            p.name: p.annotation for p in self.__signature__.parameters.values()
        }
        self.__name__ = "command"
        self.__doc__ = None

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing."""


def _app(name: str, about: str = "", *, rank: int = 0) -> App:
    app = App(
        name=name,
        help=about,
        help_format="plaintext",
        version=f"polmvs {polmvs.__version__}",
        version_format="plaintext",
        sort_key=rank,
    )
    app["--help"].group = app["--version"].group = Group("Help", sort_key=1000)
    return app


def _complete(app: App, command: Command, prog: str, *, show_all: bool) -> None:
    """Give an app the flags and the help of a command."""
    hidden = () if show_all else command.earlier
    lines = [command.help_text[0].upper() + command.help_text[1:] + "."]
    if hidden:
        names = ", ".join(cls.group for cls in hidden)
        lines.append(f"Options of earlier stages ({names}): {HELP_ALL}.")
    app.help = "\n\n".join([*lines, command.more] if command.more else lines)
    app.usage = f"Usage: {prog} {arguments_line(command)}[OPTIONS]"
    parameters = []
    for rank, cls in enumerate((*command.groups, *command.earlier)):
        panel = Group(group_title(cls), sort_key=rank, show=cls not in hidden)
        infos = describe_fields(cls)
        if any(info.positional for info in infos):
            app.group_arguments = panel  # in place of cyclopts' own of this name
        parameters += [_parameter(info, panel, is_setting=cls.in_files) for info in infos]
    app.default(_Signature(sorted(parameters, key=lambda p: p.kind)))


def arguments_line(command: Command) -> str:
    """The command's arguments in its usage line."""
    infos = [info for cls in command.groups for info in describe_fields(cls) if info.positional]
    texts = [metavar_of(info) + " ..." * _is_list(info.kind) for info in infos]
    required = [info.default is dataclasses.MISSING for info in infos]
    return "".join(
        f"{text} " if needed else f"[{text}] " for text, needed in zip(texts, required, strict=True)
    )


def group_title(cls: type[OptionGroup]) -> str:
    """Heading of a group of options."""
    text = (cls.__doc__ or "").splitlines()[0].rstrip(".")
    return f"{cls.group}: {text}" if cls.in_files else text


def _key(info: FieldInfo) -> str:
    """Name of its parameter: the help shows that of an argument in capitals."""
    return info.name if info.positional else info.path.replace(".", "__")


def _parameter(info: FieldInfo, group: Group, *, is_setting: bool) -> inspect.Parameter:
    """Parameter of a field, without a default, so that only given options count.

    Parameters
    ----------
    info : the field.
    group : panel of the help.
    is_setting : a file or an earlier run may have set it, so that a switch must turn off as well.
    """
    is_required = info.default is dataclasses.MISSING
    text = in_flags(info.help_text)
    if info.default not in (None, dataclasses.MISSING):
        text += f" [default: {show_value(info.default)}]"
    negative = info.kind is bool and (is_setting or info.default is True)
    common: dict[str, Any] = {
        "group": group,
        "help": text,
        "show_default": False,
        "show_choices": False,
        "negative": f"--no-{info.flag[2:]}" if negative else (),
        "allow_repeating": False,
    }
    if not info.positional:
        common["name"] = (info.flag, "-v") if info.flag == "--verbose" else info.flag
    if info.kind is not bool:
        common["metavar"] = metavar_of(info)
    if isinstance(info.kind, type) and issubclass(info.kind, StrEnum):
        # cyclopts would read members by their names, with a hyphen between digit and letter.
        common["name_transform"] = _choice_of_member
    kind: Any = info.kind
    place: Any = inspect.Parameter.KEYWORD_ONLY
    elements = typing.get_args(kind) if typing.get_origin(kind) is tuple else ()
    if info.positional:
        place = inspect.Parameter.POSITIONAL_ONLY
        if elements:
            kind, place = elements[0], inspect.Parameter.VAR_POSITIONAL
    elif kind is int:
        common["converter"] = _read_integer
    if kind in (Path, Path | None):
        common["converter"] = _read_path
    elif _is_list(kind):
        common |= {
            "converter": partial(_read_several, elements[0]),
            "n_tokens": 1,
            "consume_multiple": True,
        }
    elif elements and not _is_mixed(kind):
        numbers = elements[0] in (int, float)  # the first of them may be negative
        common |= {"converter": partial(_read_one, kind), "n_tokens": 1}
        common |= {"allow_leading_hyphen": numbers}
        # The converter checks the length.
        kind = types.GenericAlias(tuple, (elements[0], ...))
    has_default = not is_required and place is not inspect.Parameter.VAR_POSITIONAL
    return inspect.Parameter(
        _key(info),
        place,
        default=None if has_default else inspect.Parameter.empty,
        # If pydantic is loaded, cyclopts uses it to check the default as well.
        annotation=Annotated[kind | None if has_default else kind, Parameter(**common)],
    )


def _choice_of_member(name: str) -> str:
    return name.lower().replace("_", "-")


def _is_mixed(kind: Any) -> bool:
    """Whether a tuple's elements differ in type, so that each is an argument of its own."""
    elements = typing.get_args(kind)
    return len(set(elements)) > 1 and Ellipsis not in elements


def _is_list(kind: Any) -> bool:
    """Whether a kind is a tuple of tuples or of paths: any number of texts."""
    elements = typing.get_args(kind) if typing.get_origin(kind) is tuple else ()
    return bool(elements) and (elements[0] is Path or typing.get_origin(elements[0]) is tuple)


def _read_integer(_: Any, tokens: Sequence[Token]) -> int:
    """Read an integer; cyclopts would round a fraction."""
    text = tokens[0].value
    try:
        return int(text)
    except ValueError as error:
        raise ValueError(f"{text!r} cannot be read as {_name(int)}") from error


def _read_path(_: Any, tokens: Sequence[Token]) -> Path:
    """Reads a path; an empty one would be the current directory."""
    text = tokens[0].value
    if not text:
        raise ValueError("'' is no path; the current directory is '.'")
    return Path(text)


def _read_one(kind: Any, _: Any, tokens: Sequence[Token]) -> tuple[Any, ...]:
    """Reads a list with commas."""
    return _read_list(kind, tokens[0].value)


def _read_several(kind: Any, _: Any, tokens: Sequence[Token]) -> tuple[Any, ...]:
    """Reads several lists with commas."""
    return tuple(_read_list(kind, token.value) for token in tokens)


def _read_list(kind: Any, text: str) -> tuple[Any, ...]:
    """Read a tuple from a comma-separated list; ValueError states the expected form."""
    elements = typing.get_args(kind)
    try:
        values = tuple(elements[0](part.strip()) for part in text.split(","))
    except ValueError as error:
        raise ValueError(f"{text!r} cannot be read as {_name(kind)}") from error
    if Ellipsis not in elements and len(values) != len(elements):
        raise ValueError(f"{text!r} is no {_name(kind)}")
    return values


def metavar_of(info: FieldInfo) -> str:
    """Placeholder for the value of an option or argument."""
    if isinstance(info.metavar, tuple):
        return " ".join(info.metavar)
    return info.metavar or (info.name.upper() if info.positional else _name(info.kind))


def _name(kind: Any) -> str:
    """Name of a value's type, in the help and in messages."""
    if typing.get_origin(kind) is tuple:
        elements = typing.get_args(kind)
        dots = ",..." if Ellipsis in elements else ""
        return ",".join(_name(item) for item in elements if item is not Ellipsis) + dots
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return "|".join(kind)
    return {int: "INT", float: "NUMBER", Path: "PATH"}.get(kind, "NAME")


def _message(error: CycloptsError) -> str:
    """Message of an error of cyclopts, in one line."""
    if isinstance(error, UnusedCliTokensError):
        return f"unexpected argument: {' '.join(error.unused_tokens or [])}"
    if isinstance(error, MissingArgumentError) and error.argument is not None:
        name = error.argument.name
        if error.keyword is None:
            return f"{name} is missing"
        if str(error).rstrip(".").endswith("requires an argument"):
            return f"{name} needs a value"
    if isinstance(error, RepeatArgumentError):
        name = error.token.keyword or ""
        other = f"--{name[5:]}" if name.startswith("--no-") else f"--no-{name[2:]}"
        if other in (error.root_input_tokens or ()):  # a switch, on and off
            return f"{other} and {name} exclude each other"
    error.verbose = False
    text = " ".join(str(error).split())
    name = error.argument.name if error.argument is not None else ""
    if name not in text:  # of several values cyclopts does not say whose they are
        text = f"invalid value for {name}: {text}"
    if not text.endswith("..."):
        text = text.removesuffix(".")
    return text[0].lower() + text[1:]
