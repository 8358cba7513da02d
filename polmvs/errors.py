"""Errors that a user can act on; a command turns each into one line and an exit status.

A message names an option by its path between backquotes, as in "Give `run.overwrite`.". The
command line replaces the path by the flag; a notebook shows the path.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from typing import ClassVar

MAX_SHOWN = 900  # characters of a name, and of a reason
_LAYOUT = "\n\t"
MAX_QUOTED = 120  # of these, of words that are a file's or another library's

# What a terminal acts on: controls of both sets, ends of lines, changes of writing direction; and
# halves of characters, which stand for bytes of a name that is not UTF-8.
_ACTED_ON = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


# Prefix of polmvs.io.temporary before the final name of a file.
_UNFINISHED = re.compile(r"\.polmvs-[0-9a-f]{16}-\d+-\d+-")


def printable(text: object, *, keep: str = "") -> str:
    r"""Text that is safe to show: control characters are escaped, as in ``\x1b[31m``.

    Parameters
    ----------
    text : such as a path; names of files may hold anything.
    keep : characters that are not escaped, such as a newline.
    """
    return _ACTED_ON.sub(lambda found: _written_out(found[0], keep), str(text))


def final_name(path: object) -> str:
    """A path with final names instead of the temporary names of unfinished files."""
    return _UNFINISHED.sub("", str(path))


def _written_out(character: str, keep: str) -> str:
    return character if character in keep else character.encode("unicode_escape").decode()


class PolmvsError(Exception):
    """A run cannot continue; the message is one line with the reason and the remedy."""

    exit_status: ClassVar[int] = 1


class DataError(PolmvsError):
    """A file or folder is at fault.

    Parameters
    ----------
    path : path-like
        The file or folder at fault.
    reason : str
        What is wrong with it and the remedy.
    """

    def __init__(self, path: str | PathLike[str], reason: str) -> None:
        super().__init__(
            f"{_short(printable(final_name(path)))}: {_short(printable(reason, keep=_LAYOUT))}"
        )
        self.path = path
        self.reason = reason

    def __reduce__(self) -> tuple[type[DataError], tuple[str | PathLike[str], str]]:
        """Pickle the parts, so that the error of a worker process arrives whole."""
        return type(self), (self.path, self.reason)


class OptionError(PolmvsError):
    """An option is malformed or contradicts another one or the data.

    Parameters
    ----------
    reason : str
        What is wrong, without the option's name if ``field`` is given. Other options are named by
        their paths between backquotes.
    field : str or None
        Path of the option at fault, such as ``propagation.step_px``; the command line names its
        flag instead.
    """

    exit_status: ClassVar[int] = 2

    def __init__(self, reason: str, *, field: str | None = None) -> None:
        text = _short(printable(reason))
        super().__init__(f"`{field}` {text}" if field is not None else text)
        self.reason = reason
        self.field = field

    def __reduce__(self) -> tuple[Callable[[str, str | None], OptionError], tuple[str, str | None]]:
        """Pickle the parts, so that the error of a worker process arrives whole."""
        return _option_error, (self.reason, self.field)


@contextmanager
def as_data_error(path: str | PathLike[str], done: str, missing: str = "") -> Iterator[None]:
    """Turn an ``OSError`` into a DataError that names the file or folder and the failed action.

    Parameters
    ----------
    missing : what is said of one that there is not; where it is empty, what the system says.

    Raises
    ------
    DataError
        In place of an ``OSError`` in the block.
    """
    try:
        yield
    except OSError as error:
        if missing and isinstance(error, FileNotFoundError):
            raise DataError(path, missing) from error
        raise DataError(path, f"cannot be {done}: {error.strerror or error}.") from error


def _short(text: str) -> str:
    """A text with its middle cut out if it is far too long."""
    if len(text) <= MAX_SHOWN:
        return text
    half = MAX_SHOWN // 2
    return f"{text[:half]} ... {text[-half:]}"


def _option_error(reason: str, field: str | None) -> OptionError:
    return OptionError(reason, field=field)
