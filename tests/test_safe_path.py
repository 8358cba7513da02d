"""A folder of data that holds Python files: none of them runs, whatever command is called there.

`polmvs` is started as its console script is. Each decoy leaves a mark and goes on as if nothing
were; what they are called is imported first by a process that starts.
"""

import ast
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import polmvs
from polmvs.parallel import Workers
from polmvs.safe_path import VARIABLE, safe_path
from polmvs.separate import run_separately

PACKAGE = Path(polmvs.__file__).parent
DECOYS = ("polmvs", "multiprocessing", "numpy", "pickle", "cv2", "pycolmap", "open3d", "scipy")
DECOY = """
import os
with open(os.path.join({folder!r}, "ran"), "a") as file:
    file.write(__name__ + "\\n")
raise ImportError("a decoy")
"""


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A capture with decoys beside its images."""
    folder = tmp_path / "capture"
    folder.mkdir()
    for name in DECOYS:
        (folder / f"{name}.py").write_text(DECOY.format(folder=str(tmp_path)))
    rng = np.random.default_rng(0)
    for index in range(3):
        mosaic = rng.integers(0, 200, (128, 160)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{index}.png"), mosaic)
    return folder


@pytest.fixture
def script(tmp_path: Path) -> list[str]:
    """The console script, in a folder of its own; warnings of imports are no matter here."""
    path = tmp_path / "bin" / "polmvs"
    path.parent.mkdir()
    path.write_text(
        "import sys\n"
        f"sys.path.append({str(PACKAGE.parent)!r})\n"
        "from polmvs.cli import entry_point\n"
        "if __name__ == '__main__':\n"
        "    entry_point()\n"
    )
    return [sys.executable, str(path)]


def which_process(index: int) -> int:
    return os.getpid()


def path_of_process(on_message) -> tuple[int, list[str]]:
    return os.getpid(), sys.path


def test_processes_of_both_kinds(hostile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(hostile)
    with Workers(2) as workers:
        assert os.getpid() not in list(workers.map(which_process, range(2)))
    process, path = run_separately(path_of_process)
    assert process != os.getpid()
    assert str(hostile) not in path
    assert "" not in path
    assert not (hostile.parent / "ran").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("sfm", ".", "../out", "--workers", "2"), "no model"),
        (("batch", "list.csv", "../out", "--workers", "2"), "2 failed"),
    ],
)
def test_commands_that_start_processes(
    hostile: Path, script: list[str], arguments: tuple[str, ...], said: str
) -> None:
    (hostile.parent / "empty").mkdir()
    (hostile / "list.csv").write_text("capture,name\n../empty,a\n../empty,b\n")
    done = subprocess.run(
        [*script, *arguments],
        cwd=hostile,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert not (hostile.parent / "ran").exists(), (hostile.parent / "ran").read_text()
    assert said in done.stdout + done.stderr


def test_as_a_module(hostile: Path) -> None:
    """Python itself finds what is called polmvs; the rest is not looked for there."""
    (hostile / "polmvs.py").unlink()
    done = subprocess.run(
        [sys.executable, "-m", "polmvs", "inspect", "."],
        cwd=hostile,
        env={**os.environ, "PYTHONPATH": str(PACKAGE.parent)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert not (hostile.parent / "ran").exists()


def test_the_variable_is_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    for before in (None, ""):
        monkeypatch.delenv(VARIABLE, raising=False)
        if before is not None:
            monkeypatch.setenv(VARIABLE, before)
        with safe_path(), safe_path():
            assert os.environ[VARIABLE] == "1"
        assert os.environ.get(VARIABLE) == before


def test_only_two_modules_start_processes() -> None:
    """What is checked above is all there is."""
    starting = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Import(names=names):
                    found = {alias.name for alias in names}
                case ast.ImportFrom(module=str(module), names=names):
                    found = {f"{module}.{alias.name}" for alias in names}
                case ast.Attribute(attr=attr):
                    found = {attr}
                case _:
                    continue
            if found & {
                "subprocess",
                "multiprocessing.get_context",
                "multiprocessing.Process",
                "multiprocessing.Pool",
                "concurrent.futures.ProcessPoolExecutor",
                "asyncio.subprocess",
                "system",
                "popen",
                "posix_spawn",
                "execv",
                "fork",
            }:
                starting.add(path.relative_to(PACKAGE).as_posix())
    assert starting == {"parallel.py", "separate.py"}
