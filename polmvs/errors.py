"""Errors that a user can act on; the command turns each into one line and an exit status."""

from __future__ import annotations

from os import PathLike
from typing import ClassVar


class PolmvsError(Exception):
    """A run cannot go on; the message is one line that says why and what to do."""

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
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason

    def __reduce__(self) -> tuple[type[DataError], tuple[str | PathLike[str], str]]:
        """Pickle the parts, so that the error of a worker process arrives whole."""
        return type(self), (self.path, self.reason)


class OptionError(PolmvsError):
    """An option is malformed or contradicts another one or the data."""

    exit_status: ClassVar[int] = 2
