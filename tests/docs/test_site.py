"""The documentation's site: built strictly, whole, without anything from a network."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from pages import ROOT

from polmvs.cli.commands import COMMANDS
from polmvs.config import describe_fields

pytest.importorskip("sphinx")
pytest.importorskip("furo")

# The command of the README, with Python's -P so that the folder it runs in brings no modules.
BUILD = ("-P", "-m", "sphinx", "-W", "-n", "-q", "docs")


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, *BUILD, str(out), "-d", str(out / ".doctrees")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return out


def test_every_page_is_there(site: Path) -> None:
    docs = ROOT / "docs"
    for page in docs.rglob("*.md"):
        assert (site / page.relative_to(docs).with_suffix(".html")).is_file()


def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    for page in site.glob("*.html"):
        loaded = re.findall(
            r"<(?:script|img|link|iframe)\b[^>]*?(?:src|href)=\"(https?:[^\"]+)", page.read_text()
        )
        assert loaded == [], page.name


def test_the_notebook_is_a_page(site: Path) -> None:
    text = (site / "notebook.html").read_text()
    assert "%NOTEBOOK%" not in text
    assert "First steps: from a raw frame" in text
    assert text.count("highlight-python") >= 8


def test_formulas_are_markup_and_not_their_source(site: Path) -> None:
    text = (site / "how_it_works.html").read_text()
    assert text.count("<math ") >= 20
    formulas = re.findall(r"<math .*?</math>", text, re.DOTALL)
    assert [one for one in formulas if "\\" in one] == []


def test_the_command_reference_has_every_option(site: Path) -> None:
    text = (site / "commands.html").read_text()
    assert "%COMMANDS%" not in text
    for command in COMMANDS:
        assert f"polmvs {command.name}" in text
        for cls in (*command.groups, *command.earlier):
            for info in describe_fields(cls):
                assert info.positional or info.flag in text


def test_the_api_reference_has_the_public_names(site: Path) -> None:
    import polmvs

    text = (site / "api.html").read_text()
    for name in polmvs.__all__:
        assert name == "__version__" or f'id="polmvs.{name}"' in text or f".{name}" in text


def test_a_broken_link_fails_the_build(tmp_path: Path) -> None:
    """Also a reference to nothing: the settings are the site's own."""
    conf = (ROOT / "docs" / "conf.py").read_text()
    extensions = str(ROOT / "docs" / "_extensions")
    conf = conf.replace('str(Path(__file__).parent / "_extensions")', repr(extensions))
    (tmp_path / "conf.py").write_text(conf)
    for text in ("[gone](nowhere.md)", "{mod}`polmvs.nowhere`", "![gone](nothing.png)"):
        (tmp_path / "index.md").write_text(f"# Title\n\n{text}\n")
        done = subprocess.run(
            [
                sys.executable,
                "-P",
                "-m",
                "sphinx",
                "-W",
                "-n",
                "-q",
                "-E",
                tmp_path,
                tmp_path / "o",
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode != 0, text


def test_the_figures_are_drawn_from_the_package(tmp_path: Path) -> None:
    """Those that are quick; that their files are in the repository holds for all."""
    done = subprocess.run(
        [sys.executable, "-c", FIGURES, str(tmp_path)],
        cwd=ROOT / "docs",
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    for name in done.stdout.split():
        assert (ROOT / "docs" / "images" / name).is_file()
    assert {path.name for path in tmp_path.iterdir()} == {"geometry.svg", "rows.svg"}


FIGURES = """
import sys
from pathlib import Path
import figures
figures.draw(["geometry.svg", "rows.svg"], Path(sys.argv[1]))
print(*figures.FIGURES)
"""
