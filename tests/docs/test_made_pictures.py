"""The pictures of the documentation: made by their script, and no older than what they show."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from pages import ROOT, pages

sys.path.insert(0, str(ROOT / "docs"))
import pictures as script


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None, path
    return image.astype(float)


def assert_alike(made: Path, kept: Path, *, most: float) -> None:
    """Mean difference, of 255."""
    one, other = read(made), read(kept)
    assert one.shape == other.shape, f"make it anew: python docs/pictures.py {kept.name}"
    difference = np.abs(one - other).mean()
    assert difference < most, f"make it anew: python docs/pictures.py {kept.name}"


def test_every_picture_is_as_the_script_made_it(demo_run: Path) -> None:
    shown = {
        "site.png": script.words_of_site(),
        "report.png": script.words_of_page(demo_run / "report.html"),
    }
    assert script.faults(shown=shown) == []
    for name in shown:
        assert len(script.read_made(script.IMAGES)[name]["words"]) >= 8


def test_pictures_are_those_that_pages_show() -> None:
    named = {
        Path(link).name
        for page in pages()
        for link in re.findall(r"\]\(([^)]+\.(?:png|svg|jpg))\)", page.read_text())
    }
    assert named == set(script.pictures())


def test_what_is_wrong_with_a_picture_is_said(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    shutil.copytree(script.IMAGES, folder)
    assert script.faults(folder) == []
    (folder / "sheet.png").write_bytes((folder / "site.png").read_bytes())
    (folder / "rows.svg").unlink()
    (folder / "soup.png").write_bytes(b"")
    found = script.faults(folder, {"site.png": "How it works", "dolp.svg": ""})
    assert [text.split(":")[0] for text in found] == [
        *("rows.svg", "sheet.png", "site.png", "soup.png")
    ]
    assert "is not made. Make it by: python docs/pictures.py rows.svg" in found[0]
    assert "is not what docs/pictures.py made" in found[1]
    assert "shows what is gone: " in found[2]
    assert "'From camera to mesh'" in found[2]
    assert "no function of docs/pictures.py makes it" in found[3]


def test_the_sheet_and_a_drawing_are_of_this_version(tmp_path: Path) -> None:
    sources = script.Sources(tmp_path, None)
    script.sheet(sources, tmp_path / "sheet.png")
    assert_alike(tmp_path / "sheet.png", script.IMAGES / "sheet.png", most=1.0)
    script.drawn("phase_error.png")(sources, tmp_path / "phase_error.png")
    # Fonts differ from machine to machine.
    assert_alike(tmp_path / "phase_error.png", script.IMAGES / "phase_error.png", most=5.0)


def test_the_clouds_of_both_models_look_like_this_versions(demo_run: Path, tmp_path: Path) -> None:
    work = tmp_path / "work"
    work.mkdir()
    (work / "demo").symlink_to(demo_run)
    script.opa_ppa(script.Sources(work, None), tmp_path / "opa_ppa.png")
    assert_alike(tmp_path / "opa_ppa.png", script.IMAGES / "opa_ppa.png", most=5.0)


def test_captures_that_are_not_here_are_named(tmp_path: Path) -> None:
    found = script.make(["hero.png"], script.Sources(tmp_path, None), tmp_path)
    assert found == ["hero.png: needs the capture 'mug' in --captures FOLDER"]
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SystemExit, match=r"soup.png: no such picture; there are report.png, "):
        script.make(["soup.png"], script.Sources(tmp_path, None), tmp_path)
