"""The command lines and flags that the README and the documentation name are understood."""

import re
import shlex
from pathlib import Path

import pytest
from pages import blocks, pages

from polmvs.cli.commands import ABOUT, COMMANDS
from polmvs.cli.flags import UsageError, parse
from polmvs.config import describe_fields

# What is optional stands in brackets.
LINES = sorted(
    {
        part.replace("[", "").replace("]", "").strip()
        for page in pages()
        for block in blocks(page)
        if block.kind == "sh"
        for line in block.lines
        for part in line.split("&&")
        if part.strip().startswith("polmvs ")
    }
)
INLINE = sorted(
    {
        f"polmvs {text}"
        for page in pages()
        for text in re.findall(r"`polmvs ([a-z]\w* [^`]*)`", page.read_text(encoding="utf-8"))
    }
)
# Flags of scripts, of pip and of Python.
OTHERS = {
    "--check",
    "--help",
    "--help-all",
    "--version",
    "--estimators",
    "--way",
    "--group",
    "--no",
}


def test_there_are_some() -> None:
    assert len(LINES) >= 20
    assert "polmvs demo" in LINES


@pytest.mark.parametrize("line", LINES)
def test_command_line(line: str) -> None:
    assert _command_of(line) == line.split()[1]


@pytest.mark.parametrize("line", INLINE)
def test_command_in_a_sentence(line: str) -> None:
    """It may be named without its arguments."""
    try:
        assert _command_of(line) == line.split()[1]
    except UsageError as error:
        if not error.message.endswith("is missing"):
            raise


def _command_of(line: str) -> str:
    words = shlex.split(line.replace("fx,fy,cx,cy", "1,1,1,1"))[1:]
    parsed = parse(COMMANDS, words, "polmvs", ABOUT)
    assert parsed.command is not None
    return parsed.command.name


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_every_flag_that_is_named_is_one(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    flags = set(re.findall(r"`(--[a-z][a-z-]*[a-z])", text))
    known = set(OTHERS)
    for command in COMMANDS:
        for name in _flags(command):
            known |= {name, f"--no-{name[2:]}"}
    assert flags - known == set()


def _flags(command) -> list[str]:
    groups = (*command.groups, *command.earlier)
    return [i.flag for cls in groups for i in describe_fields(cls) if not i.positional]
