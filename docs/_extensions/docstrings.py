"""Docstrings as this package writes them, for numpydoc: what is returned may be prose."""

import re
from typing import Any

from sphinx.application import Sphinx

ITEM = re.compile(r"[\w*, ]+ : ")


def join_returns(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Make one line of a section ``Returns`` that is prose: numpydoc makes an item of each line."""
    if "Returns" not in lines or lines.index("Returns") + 1 == len(lines):
        return
    start = lines.index("Returns") + 2
    end = next((i for i in range(start, len(lines)) if not lines[i].strip()), len(lines))
    text = lines[start:end]
    if not any(ITEM.match(line) or line.startswith(" ") for line in text):
        lines[start:end] = [" ".join(text)]


def setup(app: Sphinx) -> dict[str, bool]:
    """Come before numpydoc, which has the usual priority."""
    app.connect("autodoc-process-docstring", join_returns, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
