"""The first notebook as a page of the site, where a page says ``%NOTEBOOK%``."""

import json
from pathlib import Path

from sphinx.application import Sphinx

MARK = "%NOTEBOOK%"
NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "first_steps.ipynb"


def notebook_text(path: Path = NOTEBOOK) -> str:
    """Text and code of a notebook's cells as Markdown; it is stored without what they print."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"]).strip()
        parts.append(f"```python\n{source}\n```" if cell["cell_type"] == "code" else source)
    return "\n\n".join(parts)


def _fill_in(app: Sphinx, name: str, source: list[str]) -> None:
    if MARK in source[0]:
        source[0] = source[0].replace(MARK, notebook_text())


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect with Sphinx."""
    app.connect("source-read", _fill_in)
    return {"parallel_read_safe": True}
