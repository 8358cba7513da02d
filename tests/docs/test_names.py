"""Names of modules, classes and functions in the documents are those of the code."""

from __future__ import annotations

import importlib
import re

import pytest
from pages import ROOT, pages

RECORDS = ROOT / "docs" / "records"  # names of the versions that were measured
CURRENT = [page for page in pages() if RECORDS not in page.parents and page.name != "CHANGELOG.md"]
NAMES = sorted(
    {
        name
        for page in CURRENT
        for name in re.findall(r"`(polmvs(?:\.\w+)+)(?:\(\))?`", page.read_text(encoding="utf-8"))
        if name != "polmvs.log"  # a file of a run
    }
)
# The table of the energy names members of one folder.
SHORT = ("docs/how_it_works.md", "polmvs.surface")


def resolve(name: str) -> None:
    """Import what a dotted name names; AttributeError or ImportError if there is no such thing."""
    words = name.split(".")
    for count in range(len(words), 0, -1):
        try:
            found = importlib.import_module(".".join(words[:count]))
        except ModuleNotFoundError:
            continue
        for word in words[count:]:
            found = getattr(found, word)
        return
    raise ImportError(name)


def test_there_are_some() -> None:
    assert "polmvs.surface.hollows.find_hollows" in NAMES
    with pytest.raises(AttributeError):
        resolve("polmvs.surface.hollows.find_nothing")


@pytest.mark.parametrize("name", NAMES)
def test_name(name: str) -> None:
    resolve(name)


def test_short_names_of_the_energy() -> None:
    page, package = SHORT
    text = (ROOT / page).read_text(encoding="utf-8")
    names = re.findall(r"`((?:terms|labels|observations|solver)\.\w+)`", text)
    assert len(names) >= 10
    for name in names:
        resolve(f"{package}.{name}")
    from polmvs.surface.observations import Observations

    members = {*vars(Observations), *Observations.__dataclass_fields__}
    assert set(re.findall(r"`Observations\.(\w+)`", text)) <= members


@pytest.mark.parametrize("page", CURRENT, ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_files_that_are_named_exist(page) -> None:
    """Paths of Python files, from the root of the repository or of the package."""
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`([\w/]+/[\w/]+\.py)`", text):
        assert (ROOT / name).is_file() or (ROOT / "polmvs" / name).is_file(), name
