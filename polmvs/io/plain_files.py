"""Opening of a user's files: plain files only.

Reading a pipe would wait until something is written, and a device may never end. All user files are
opened here; libraries that open a path get one that was checked here.
"""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from os import PathLike

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


def read_text(path: str | PathLike[str], encoding: str = "utf-8") -> str:
    """The text of a plain file, with newlines as line ends.

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
    return data.decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def _require_regular(found: os.stat_result, path: str | PathLike[str]) -> None:
    if stat.S_ISREG(found.st_mode):
        return
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    raise OSError(errno.EINVAL, "it is a pipe, socket or device, no plain file", os.fspath(path))
