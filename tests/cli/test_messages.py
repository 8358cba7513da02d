"""The library names options by their fields; only the command line knows flags."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import polmvs
from polmvs.cli.commands import COMMANDS
from polmvs.config import describe_fields

PACKAGE = Path(polmvs.__file__).parent
LIBRARY = [path for path in sorted(PACKAGE.rglob("*.py")) if "cli" not in path.parts]
PATHS = {
    info.path
    for command in COMMANDS
    for cls in (*command.groups, *command.earlier)
    for info in describe_fields(cls)
}


def texts(path: Path) -> Iterator[str]:
    """Strings of a module, f-strings' parts too, without its docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docstrings = {
        node.body[0].value
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
        and isinstance(node.body[0].value, ast.Constant)
    }
    for node in ast.walk(tree):
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if is_text and node not in docstrings:
            yield node.value


def test_no_message_of_the_library_spells_a_flag() -> None:
    found = [
        f"{path.relative_to(PACKAGE)}: {text}"
        for path in LIBRARY
        for text in texts(path)
        if re.search(r"(^|[\s(])--[a-z]", text)
        and not text.startswith(("--model", "--box-marker="))
    ]
    assert found == []


def test_every_option_that_a_message_names_is_one() -> None:
    named = {
        (path.name, name)
        for path in LIBRARY
        for text in texts(path)
        for name in re.findall(r"`([a-z]+\.[a-z_]+)`", text)
    }
    assert len(named) > 20
    assert {pair for pair in named if pair[1] not in PATHS} == set()


@pytest.mark.parametrize("command", COMMANDS, ids=[command.name for command in COMMANDS])
def test_help_texts_name_options_of_their_own_command(command) -> None:
    own = {i.path for cls in (*command.groups, *command.earlier) for i in describe_fields(cls)}
    for cls in (*command.groups, *command.earlier):
        for info in describe_fields(cls):
            assert set(re.findall(r"`([a-z]+\.[a-z_]+)`", info.help_text)) <= own
