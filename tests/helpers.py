"""Shared by tests of whole commands: runs cut short, bytes of folders, one-line errors."""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path


def record_of(out: Path) -> dict:
    return json.loads((out / "run.json").read_text())


def result_of(out: Path, stage: str) -> dict:
    """What a finished stage found."""
    return next(s["result"] for s in record_of(out)["stages"] if s["name"] == stage)


def stages_of(out: Path) -> list[str]:
    return [stage["name"] for stage in record_of(out)["stages"]]


def cut_after(out: Path, last: str) -> None:
    """Make a run one that was stopped after this stage."""
    record = record_of(out)
    names = [stage["name"] for stage in record["stages"]]
    record["stages"] = record["stages"][: names.index(last) + 1]
    record["finished"] = False
    (out / "run.json").write_text(json.dumps(record))


def content_of(folder: Path) -> dict[str, bytes]:
    """Bytes of every file in a folder, by its path there."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def refused(outcome: tuple[int, str, str], status: int = 1) -> str:
    """The one line on stderr of a command that failed, and said nothing else."""
    found, text, err = outcome
    assert (found, text) == (status, ""), err
    assert err.count("\n") == 1, err
    assert ": error: " in err
    return err


def wait_for_the_end(path: Path, on_message: Callable[[str], None]) -> None:
    """Work of a process that is ended from outside; its number is written first."""
    path.write_text(str(os.getpid()))
    time.sleep(60)
