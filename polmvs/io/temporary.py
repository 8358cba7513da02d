"""Names of unfinished files and folders; each has a token that only this run knows.

The clean-up after a killed process removes only names with its token; no file of a user has such a
name by chance.
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
    24  # characters of the final name at the end of a temporary one, so that it is never too long
)

_NAME = re.compile(re.escape(PREFIX) + r"([0-9a-f]{16})-\d{1,10}-\d{1,10}-(.+)", re.DOTALL)
_numbers = itertools.count()


def work_for(token: str) -> None:
    """Use the token of the run for which this process, a worker, works."""
    global TOKEN
    TOKEN = token


def temporary_path(target: Path) -> Path:
    """A temporary name beside ``target``, with the same suffix, for its replacement."""
    number = f"{os.getpid()}-{next(_numbers)}"
    return target.with_name(f"{PREFIX}{TOKEN}-{number}-{target.name[-SHOWN:]}")


def is_temporary(path: Path, token: str, names: Collection[str]) -> bool:
    """Whether a name is a temporary one with this token for one of these final names.

    A file that lists tokens may be forged; it can only name such files.
    """
    found = _NAME.fullmatch(path.name)
    if found is None or found[1] != token:
        return False
    return any(found[2] == name[-SHOWN:] for name in names)


def remove_temporary(path: Path) -> None:
    """Remove a file or folder that may not exist, without hiding the current error."""
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    except OSError:
        return
