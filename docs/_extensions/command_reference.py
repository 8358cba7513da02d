"""The command reference, written from the options themselves where a page says ``%COMMANDS%``."""

import dataclasses
from collections.abc import Iterator

from sphinx.application import Sphinx

from polmvs.cli.commands import COMMANDS
from polmvs.cli.flags import Command, arguments_line, group_title, in_flags, metavar_of
from polmvs.config import FieldInfo, OptionGroup, describe_fields, show_value

COMMANDS_MARK, OPTIONS_MARK = "%COMMANDS%", "%OPTIONS%"


def commands_text() -> str:
    """A section for each command: usage, what it does, its own arguments, its groups."""
    return "\n".join(line for command in COMMANDS for line in _command(command))


def options_text() -> str:
    """A section for each group of options that several commands share or a file may set."""
    groups = {cls.group: cls for command in COMMANDS for cls in _shared(command)}
    return "\n".join(line for cls in groups.values() for line in _group(cls))


def _shared(command: Command) -> list[type[OptionGroup]]:
    groups = (*command.groups, *command.earlier)
    return [cls for cls in groups if cls.in_files or cls.group in ("file", "terminal")]


def _command(command: Command) -> Iterator[str]:
    yield f"### polmvs {command.name}\n"
    yield f"```text\npolmvs {command.name} {arguments_line(command)}[OPTIONS]\n```\n"
    text = command.help_text[0].upper() + command.help_text[1:]
    yield f"{text}. {in_flags(command.more)}\n"
    shared = _shared(command)
    own = [cls for cls in command.groups if cls not in shared]
    infos = [info for cls in own for info in describe_fields(cls)]
    if infos:
        yield from _table(infos)
    links = [f"[{cls.group}](#group-{cls.group})" for cls in shared if cls not in command.earlier]
    if links:
        yield f"Options: {', '.join(links)}.\n"
    if command.earlier:
        links = [f"[{cls.group}](#group-{cls.group})" for cls in command.earlier]
        yield f"Those of earlier stages, shown by `--help-all`: {', '.join(links)}.\n"


def _group(cls: type[OptionGroup]) -> Iterator[str]:
    yield f"(group-{cls.group})="
    yield f"### {group_title(cls)}\n"
    if cls.in_files:
        yield f"Table `[{cls.group}]` of a file given with `--config`.\n"
    yield from _table(describe_fields(cls))


def _table(infos: list[FieldInfo]) -> Iterator[str]:
    yield "| option | meaning | default |"
    yield "| --- | --- | --- |"
    for info in infos:
        name = metavar_of(info) if info.positional else info.flag
        if not info.positional and info.kind is not bool:
            name += f" {metavar_of(info)}"
        given = info.default not in (None, dataclasses.MISSING, ())
        default = f"`{show_value(info.default)}`" if given else ""
        if info.default is dataclasses.MISSING:
            default = "required"
        if info.name == "workers":
            default = "one for each core, at most 8"
        cells = [f"`{name}`", in_flags(info.help_text), default]
        yield "| " + " | ".join(_cell(cell) for cell in cells) + " |"
    yield ""


def _cell(text: str) -> str:
    return (
        text.replace("|", "\\|").replace("<", "&lt;")
        if "`" not in text[:1]
        else text.replace("|", "\\|")
    )


def _replace(app: Sphinx, name: str, source: list[str]) -> None:
    if COMMANDS_MARK in source[0]:
        source[0] = source[0].replace(COMMANDS_MARK, commands_text())
        source[0] = source[0].replace(OPTIONS_MARK, options_text())


def setup(app: Sphinx) -> dict[str, bool]:
    """Take part in the reading of pages."""
    app.connect("source-read", _replace)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
