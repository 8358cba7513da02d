"""The way through `reconstruct` that CONTRIBUTING.md names."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from pages import ROOT

FEW = 25  # files a newcomer reads at most


def reading_list() -> list[str]:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    _, found, after = text.partition("To follow `reconstruct`")
    assert found
    steps = re.findall(r"^\d\. .*$", after.split("\n## ")[0], re.MULTILINE)
    return [name for step in steps for name in re.findall(r"`([\w/]+\.py)`", step)]


def imported_by(path: Path) -> set[str]:
    """Modules of polmvs that a file imports, anywhere, as paths below the package."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("polmvs"):
            base = (node.module or "").split(".")[1:]
            found.add("/".join(base) + ".py")
            found |= {"/".join([*base, alias.name]) + ".py" for alias in node.names}
    return found


def test_each_file_is_used_by_one_before() -> None:
    names = reading_list()
    assert 20 <= len(names) <= FEW
    known = {names[0]}
    for name in names:
        assert name in known, name
        known |= imported_by(ROOT / "polmvs" / name)
