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
# Tables whose names begin in a package: its name, and names that the table must have.
SHORT = {
    "docs/how_it_works.md": ("polmvs.surface", "terms|labels|observations|solver", 10),
    "docs/glossary.md": ("polmvs", "surface|polarization|normals|evaluation|scene", 20),
}


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
    assert "polmvs.surface.cavities.find_cavities" in NAMES
    with pytest.raises(AttributeError):
        resolve("polmvs.surface.cavities.find_nothing")


@pytest.mark.parametrize("name", NAMES)
def test_name(name: str) -> None:
    resolve(name)


@pytest.mark.parametrize("page", SHORT)
def test_short_names_of_a_table(page: str) -> None:
    package, first, num = SHORT[page]
    text = (ROOT / page).read_text(encoding="utf-8")
    names = re.findall(rf"`((?:{first})\.[\w.]+)`", text)
    assert len(names) >= num
    for name in names:
        resolve(f"{package}.{name}")


def test_members_of_the_observations() -> None:
    from polmvs.surface.observations import Observations

    text = (ROOT / "docs" / "how_it_works.md").read_text(encoding="utf-8")
    members = {*vars(Observations), *Observations.__dataclass_fields__}
    names = set(re.findall(r"`Observations\.(\w+)`", text))
    assert names
    assert names <= members


@pytest.mark.parametrize("page", CURRENT, ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_files_that_are_named_exist(page) -> None:
    """Paths of Python files, from the root of the repository or of the package."""
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`([\w/]+/[\w/]+\.py)`", text):
        assert (ROOT / name).is_file() or (ROOT / "polmvs" / name).is_file(), name
