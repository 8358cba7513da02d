"""Lock of a run folder, and clean-up after a killed run.

The lock is a system lock on an open file in the run folder: it ends with its process in any case.
The file lists the tokens of the runs whose temporary names may still exist there (see
:mod:`polmvs.io.temporary`). A run first adds its own token, and removes files with tokens of
earlier runs. No other file counts as unfinished. A run that ends, with or without an error, removes
the file.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from polmvs.errors import DataError, as_data_error
from polmvs.io.plain_files import open_plain
from polmvs.io.temporary import TOKEN, is_temporary, remove_temporary
from polmvs.pipeline.run_folder import FOLDER_FILES, HERE
from polmvs.pipeline.stage_table import written_names

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

logger = logging.getLogger(__name__)

LOCK_FILE = ".polmvs-lock"
MAX_BYTES = 1 << 16
_LINE = re.compile(r"([0-9a-f]{16}) (\d{1,10})")  # token and number of a process
# Folders in which a run uses temporary names, and their final names.
_PLACES = {Path(): written_names(), HERE.seeds.parent: FOLDER_FILES[HERE.seeds.parent.name]}
_HELD_ELSEWHERE = (errno.EWOULDBLOCK, errno.EACCES)


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """Lock a run folder, which is created if necessary, and clean up after killed runs.

    Raises
    ------
    DataError
        Another run uses it, or it cannot be written.
    """
    path = root / LOCK_FILE
    is_new = not root.exists()
    with as_data_error(root, "made"):
        root.mkdir(parents=True, exist_ok=True)
    descriptor = _open_locked(path)
    try:
        tokens = {TOKEN: os.getpid(), **_read(path)}
        _write(descriptor, path, tokens)
        try:
            _remove_left_over(root, set(tokens) - {TOKEN})
            yield
        finally:
            # Once more: a worker may have outlived its run by a moment.
            left = _remove_left_over(root, set(tokens))
            if left:
                _write(descriptor, path, {token: tokens[token] for token in left})
            else:
                with suppress(OSError):
                    path.unlink()
                    if is_new:  # and nothing came of it
                        root.rmdir()
    finally:
        os.close(descriptor)


def left_over_names(root: Path) -> frozenset[str]:
    """Names of the lock and of files of a killed run in a run folder; no results or user files."""
    path = root / LOCK_FILE
    if not path.is_file() or path.is_symlink():
        return frozenset()
    tokens = _read(path)
    found = [
        entry.name
        for entry in root.iterdir()
        if any(is_temporary(entry, token, written_names()) for token in tokens)
    ]
    return frozenset((LOCK_FILE, *found))


def _open_locked(path: Path) -> int:
    """Descriptor of the lock's file, which is locked."""
    while True:
        with as_data_error(path, "written"):
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
            descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise DataError(path, "was not written by polmvs. Move it out of the way.")
        try:
            _lock(descriptor)
        except OSError as error:
            os.close(descriptor)
            if error.errno not in _HELD_ELSEWHERE:
                raise DataError(path, f"cannot be locked: {error.strerror or error}.") from error
            numbers = [str(number) for number in _read(path).values()]
            who = f" (process {numbers[0]})" if numbers else ""
            raise DataError(
                path.parent,
                f"another run is at work in it{who}. Wait for its end, or give another OUT.",
            ) from error
        # The run that held it may have removed the file since it was opened here.
        with suppress(OSError):
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                return descriptor
        os.close(descriptor)


def _lock(descriptor: int) -> None:
    """Lock a file at once; OSError where another process has."""
    if sys.platform == "win32":
        # Far beyond the content, which others may read all the same.
        os.lseek(descriptor, MAX_BYTES, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP):
            raise
        logger.warning(
            "OUT lies on a file system without locks: a second run in it would not be noticed."
        )


def _read(path: Path) -> dict[str, int]:
    """Process by token.

    Raises
    ------
    DataError
        The file is not one that a run wrote.
    """
    try:
        with as_data_error(path, "read"), open_plain(path) as file:
            text = file.read(MAX_BYTES).decode("ascii")
    except ValueError as error:
        raise DataError(path, "was not written by polmvs. Move it out of the way.") from error
    found = [_LINE.fullmatch(line) for line in text.splitlines()]
    if text and not any(found):
        raise DataError(path, "was not written by polmvs. Move it out of the way.")
    # A line that was cut when its writer was killed names nothing: nothing was made by then.
    return {match[1]: int(match[2]) for match in found if match is not None}


def _write(descriptor: int, path: Path, tokens: dict[str, int]) -> None:
    """Overwrite the list; a process killed during this leaves surplus entries at worst."""
    data = "".join(f"{token} {number}\n" for token, number in tokens.items()).encode()
    with as_data_error(path, "written"):
        os.lseek(descriptor, 0, os.SEEK_SET)
        if os.write(descriptor, data) != len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.ftruncate(descriptor, len(data))


def _remove_left_over(root: Path, tokens: set[str]) -> set[str]:
    """Remove what carries one of these tokens; the tokens of what could not be removed."""
    left = set()
    for place, names in _PLACES.items():
        folder = root / place
        if folder.is_symlink() and place != Path():
            continue
        for path in list(folder.iterdir()) if folder.is_dir() else []:
            token = next((token for token in tokens if is_temporary(path, token, names)), None)
            if token is not None:
                remove_temporary(path)
                if os.path.lexists(path):
                    left.add(token)
    return left
