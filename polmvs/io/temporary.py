"""Names of unfinished files and folders: each carries a token that only this run knows.

Whoever must clean up after a process that was killed removes what has its token in the name, and
nothing else: no file of a user's can look like it by chance.
"""

from __future__ import annotations

import itertools
import os
import re
import secrets
import shutil
from collections.abc import Collection
from pathlib import Path

TOKEN = secrets.token_hex(8)
PREFIX = ".polmvs-"
SHOWN = (
    24  # characters of the final name that a temporary one ends in, so that it never is too long
)

_NAME = re.compile(re.escape(PREFIX) + r"([0-9a-f]{16})-\d{1,10}-\d{1,10}-(.+)", re.DOTALL)
_numbers = itertools.count()


def work_for(token: str) -> None:
    """Give names with the token of the run that this process, a worker, is at work for."""
    global TOKEN
    TOKEN = token


def temporary_path(target: Path) -> Path:
    """A new name beside ``target``, of the same suffix, for what will take its place."""
    number = f"{os.getpid()}-{next(_numbers)}"
    return target.with_name(f"{PREFIX}{TOKEN}-{number}-{target.name[-SHOWN:]}")


def is_temporary(path: Path, token: str, names: Collection[str]) -> bool:
    """Whether a name is one that the process with this token gave to what would have one of these.

    A file that lists tokens may be forged: what it can name is no more than this.
    """
    found = _NAME.fullmatch(path.name)
    if found is None or found[1] != token:
        return False
    return any(found[2] == name[-SHOWN:] for name in names)


def remove_temporary(path: Path) -> None:
    """Remove a file or folder that may not exist, without hiding the error that led here."""
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    except OSError:
        return
