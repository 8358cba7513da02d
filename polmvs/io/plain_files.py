"""Opening of a user's files: plain files only.

Reading a pipe would wait until something is written, and a device may never end. All user files are
opened here; libraries that open a path get one that was checked here.
"""

from __future__ import annotations

import errno
import os
import stat
import tomllib
from collections.abc import Iterator
from io import BufferedReader
from os import PathLike
from pathlib import Path
from typing import Any

from polmvs.errors import DataError, as_data_error

MAX_TEXT_BYTES = 1 << 28  # largest text; lists of a million pairs have 2^26


def require_plain(path: str | PathLike[str]) -> None:
    """Refuse anything but a plain file or a link to one.

    Raises
    ------
    OSError
        It is a folder, a pipe, a device or a socket, or is missing.
    """
    _require_regular(os.stat(path), path)


def open_plain(path: str | PathLike[str]) -> BufferedReader:
    """Open a plain file for reading bytes.

    Raises
    ------
    OSError
        As of :func:`require_plain`, or the system refuses.
    """
    require_plain(path)  # first: to open a device may do something
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    file = os.fdopen(os.open(path, flags), "rb")
    try:
        _require_regular(os.fstat(file.fileno()), path)
    except OSError:
        file.close()
        raise
    return file


def read_text(path: str | PathLike[str], encoding: str = "utf-8", errors: str = "strict") -> str:
    """The text of a plain file, with newlines as line ends.

    ``errors`` is as in :meth:`bytes.decode`.

    Raises
    ------
    OSError
        As of :func:`open_plain`, or it is too long.
    UnicodeDecodeError
        The text has another encoding.
    """
    with open_plain(path) as file:
        data = file.read(MAX_TEXT_BYTES + 1)
    if len(data) > MAX_TEXT_BYTES:
        raise OSError(errno.EFBIG, "it is too large for a text", os.fspath(path))
    return data.decode(encoding, errors).replace("\r\n", "\n").replace("\r", "\n")


def read_list(path: Path, what: str, encoding: str = "utf-8") -> str:
    """The text of a list that a user gives; DataError where it is no readable list of that."""
    try:
        return read_text(path, encoding)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8"
        raise DataError(path, f"is no readable list of {what} ({reason}).") from error


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text; ValueError where it is none, or nested too deeply."""
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def read_head(path: str | PathLike[str], most: int) -> tuple[bytes, int]:
    """The first bytes of a plain file, and how many it has; OSError as of :func:`open_plain`."""
    with open_plain(path) as file:
        return file.read(most), file.seek(0, os.SEEK_END)


def read_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Words of a plain text file's lines, with their numbers; no empty lines, no ``#`` comments.

    Raises
    ------
    DataError
        It cannot be read.
    """
    with as_data_error(path, "read"):
        text = read_text(path, errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield number, words


def _require_regular(found: os.stat_result, path: str | PathLike[str]) -> None:
    if stat.S_ISREG(found.st_mode):
        return
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    raise OSError(errno.EINVAL, "it is a pipe, socket or device, no plain file", os.fspath(path))
