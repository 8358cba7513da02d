"""Every code block of the README and of the documentation is run, or says why it is not.

The blocks of a page are run in their order in a folder of its own that holds ``capture``, the
bundled one, and ``out``, what the tutorial's ``polmvs reconstruct`` makes of it.
"""

from __future__ import annotations

import shlex
import shutil
import warnings
from pathlib import Path

import pytest
from pages import DATA, ROOT, RUN, Block, blocks, pages

from polmvs.cli import main

RECONSTRUCT = "polmvs reconstruct capture out --intrinsics 333.75,333.75,230.6475,196.608"
TESTS = "pytest -q -n 2 --dist loadfile"
# Commands that other tests and .ci/run run as they stand here, and where.
RUN_ELSEWHERE = {
    "polmvs demo": "tests/conftest.py",
    "polmvs doctor": "tests/cli/test_doctor.py",
    "pip install .": ".ci/run",
    "pip install '.[docs]'": "tests/docs/test_site.py",
    "pip install '.[dev]'": ".ci/run",
    "sphinx-build -W -n docs site": "tests/docs/test_site.py",
    TESTS: ".ci/run",
    RECONSTRUCT: "tests/docs/test_blocks.py",
}


def runnable(page: Path) -> list[Block]:
    return [block for block in blocks(page) if block.kind in RUN and block.why_not is None]


LONG = ("recipes", "tutorial")  # more commands than others
PAGES = [
    pytest.param(
        page,
        marks=pytest.mark.slow if page.stem in LONG else (),
        id=f"{page.parent.name}-{page.stem}",
    )
    for page in pages()
    if runnable(page)
]


@pytest.fixture(scope="session")
def reconstructed(demo_run: Path, demo_capture: Path, tmp_path_factory) -> Path:
    """What the tutorial's command makes; it goes on with a copy of the demo's run, to be quick."""
    out = tmp_path_factory.mktemp("docs") / "out"
    shutil.copytree(demo_run, out)
    words = shlex.split(RECONSTRUCT)[1:]
    words[1:3] = [str(demo_capture), str(out)]
    assert main([*words, "--resume", "--no-report", "--quiet"]) == 0
    return out


@pytest.fixture
def workplace(
    reconstructed: Path, demo_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    (tmp_path / "capture").mkdir()
    for frame in (demo_capture / "raw").iterdir():
        (tmp_path / "capture" / frame.name).symlink_to(frame)
    shutil.copytree(reconstructed, tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.mark.parametrize("page", pages(), ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_every_block_is_run_or_says_why_not(page: Path) -> None:
    for block in blocks(page):
        assert block.kind in (*RUN, *DATA), f"{block.kind!r}:\n{block.text}"


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", ".ci/run"])
def test_the_command_of_the_tests_is_one(page: str) -> None:
    assert TESTS in (ROOT / page).read_text()


@pytest.mark.parametrize("page", PAGES)
def test_the_blocks_of_a_page(page: Path, workplace: Path) -> None:
    names: dict[str, object] = {}
    for block in runnable(page):
        if block.kind == "toml":
            (workplace / "options.toml").write_text(block.text)
        elif block.kind == "python":
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of other packages' functions
                exec(compile(block.text, str(page), "exec"), names)
        else:
            for line in block.lines:
                for command in line.split("&&"):
                    run(command.strip())


def run(command: str) -> None:
    place = RUN_ELSEWHERE.get(command)
    if place is not None:
        assert (ROOT / place).is_file()
        return
    program, *words = shlex.split(command)
    assert program == "polmvs", f"nothing runs {command!r}"
    assert main(words) == 0, command
