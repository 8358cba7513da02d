"""The command lines of the README are understood."""

import re
import shlex
from pathlib import Path

import pytest

from polmvs.cli.commands import ABOUT, COMMANDS
from polmvs.cli.flags import parse
from polmvs.config import describe_fields

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
# What is optional stands in brackets; a comment follows two blanks.
LINES = [
    re.sub(r"\s+#.*", "", line).replace("[", "").replace("]", "")
    for block in BLOCKS
    for whole in block.replace("\\\n", " ").splitlines()
    for line in whole.split("&&")
    if line.strip().startswith("polmvs ")
]
INLINE = [f"polmvs {text}" for text in re.findall(r"`polmvs (\w+ [^`]*)`", README)]


def test_there_are_some() -> None:
    assert len(LINES) >= 10
    assert any(line.strip() == "polmvs demo" for line in LINES)


@pytest.mark.parametrize("line", [*LINES, *INLINE])
def test_command_line(line: str) -> None:
    words = shlex.split(line.replace("fx,fy,cx,cy", "1,1,1,1"))[1:]
    parsed = parse(COMMANDS, words, "polmvs", ABOUT)
    assert parsed.command is not None
    assert parsed.command.name == words[0]


def test_every_flag_that_it_names_is_one() -> None:
    text = re.sub(r"```.*?```", "", README, flags=re.DOTALL)
    flags = set(re.findall(r"`(--[a-z][a-z-]*)", text))
    known = {"--help", "--help-all", "--estimators", "--version"}
    for command in COMMANDS:
        for name in _flags(command):
            known |= {name, f"--no-{name[2:]}"}
    assert flags - known == set()


def _flags(command) -> list[str]:
    groups = (*command.groups, *command.earlier)
    return [i.flag for cls in groups for i in describe_fields(cls) if not i.positional]
