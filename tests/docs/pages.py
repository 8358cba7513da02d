"""The code blocks of the README and of the documentation's pages."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
FENCE = re.compile(
    r"(?:^<!-- not run: (?P<why>[^\n]+) -->\n)?"
    r"^(?P<fence>```+)(?P<kind>[^\n]*)\n(?P<text>.*?)^(?P=fence)$",
    re.MULTILINE | re.DOTALL,
)
# A page of its own kind is tested elsewhere: directives by the strict build.
DATA = ("text", "bibtex")
RUN = ("sh", "python", "toml")


@dataclass(frozen=True)
class Block:
    """A code block.

    Attributes
    ----------
    kind : of its fence, such as ``sh``.
    text : its lines.
    why_not : why it is not run; None where it is.
    """

    kind: str
    text: str
    why_not: str | None

    @property
    def lines(self) -> list[str]:
        """Command lines of a shell block, without comments."""
        whole = self.text.replace("\\\n", " ").splitlines()
        return [stripped for line in whole if (stripped := re.sub(r"\s+#.*", "", line).strip())]


def pages() -> list[Path]:
    """All pages: the README, those of ``docs`` with its records, and what they include."""
    return [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "CHANGELOG.md",
        ROOT / "data" / "README.md",
        *sorted((ROOT / "docs").rglob("*.md")),
    ]


def blocks(page: Path) -> list[Block]:
    """The code blocks of a page, in its order, without Sphinx's directives."""
    found = FENCE.finditer(page.read_text(encoding="utf-8"))
    return [
        Block(kind=match["kind"].strip(), text=match["text"], why_not=match["why"])
        for match in found
        if not match["kind"].startswith("{")
    ]
