"""Damaged files of every kind: each ends well or in an error that names the file.

In a process of its own, so that a crash of the interpreter is a failure of the test. A run with
other seeds: ``python tests/fuzzing/fuzz.py FOLDER SEED ROUNDS [KIND ...]``; CI runs it for minutes.
"""

import subprocess
import sys
from pathlib import Path

import pytest
from fuzzing.readers import KINDS

ROUNDS = 25


@pytest.mark.slow
def test_every_reader_survives_damaged_files(tmp_path: Path) -> None:
    script = Path(__file__).parent / "fuzzing" / "fuzz.py"
    done = subprocess.run(
        [sys.executable, script, tmp_path / "files", "0", str(ROUNDS)],
        capture_output=True,
        text=True,
        check=False,
    )
    lines = [line for line in done.stdout.splitlines() if ", round " in line]
    assert done.returncode == 0, f"{lines[-1:]}\n{done.stderr[-3000:]}"
    assert len(lines) == ROUNDS * len(KINDS) >= 1000


@pytest.mark.slow
def test_a_fault_is_found(tmp_path: Path) -> None:
    """Neither another exception, nor an error without a name, nor a hang passes."""
    script = """
import sys, time
sys.path.insert(0, sys.argv[2])
from fuzzing import fuzz, readers
from polmvs.errors import DataError

def fail(path):
    if path.read_bytes() == b"sound":
        return
    if sys.argv[1] == "hang":
        time.sleep(60)
    raise {"name": DataError("a", "is bad"), "other": KeyError("a")}[sys.argv[1]]

fuzz.MAX_SECONDS = 1
readers.KINDS = {"a": readers.text("a.txt", "sound", fail)}
from pathlib import Path
sys.exit(fuzz.fuzz(Path(sys.argv[3]), 0, 3, []))
"""
    for index, kind in enumerate(("name", "other", "hang")):
        arguments = [kind, str(Path(__file__).parent), tmp_path / str(index)]
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments], capture_output=True, check=False
        )
        assert done.returncode in ((1, 2, 3) if kind != "hang" else (-14,)), done.stderr
