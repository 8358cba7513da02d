"""Folders that are written whole or not at all, and checks of their names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from polmvs.errors import DataError
from polmvs.io.temporary import remove_temporary, temporary_path


def require_unicode(path: str | PathLike[str]) -> None:
    """Refuse a name that is not valid text: COLMAP's binding rejects it or crashes.

    Raises
    ------
    DataError
        The name's bytes are not UTF-8, or Python's locale cannot represent the name.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise DataError(
            ascii(str(path)),
            "is a name that is not UTF-8 here. Rename it, or set PYTHONUTF8=1 if it is.",
        ) from error


def resolved(path: Path) -> Path:
    """A path without links.

    Raises
    ------
    DataError
        Its links form a circle.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError) as error:  # the latter of Python 3.12 and earlier
        raise DataError(path, "is a link that leads in a circle. Give another path.") from error


@contextmanager
def new_folder(folder: str | PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder that gets its final name on success and is removed otherwise.

    Parameters
    ----------
    overwrite : replace an existing folder, with its content, at the end.

    Raises
    ------
    DataError
        The folder exists and is not empty, without ``overwrite``, or the system refuses.
    """
    target = Path(folder)
    if target.exists() and not overwrite and not (target.is_dir() and not any(target.iterdir())):
        raise DataError(target, "exists already. Remove it or choose another folder.")
    temporary = temporary_path(target)
    content = temporary / "content"
    try:
        content.mkdir(parents=True)
        yield content
        replaced = temporary / "replaced"
        if target.exists():
            target.rename(replaced)
        try:
            content.rename(target)
        except OSError:
            if replaced.exists():
                replaced.rename(target)
            raise
    except OSError as error:
        raise DataError(target, f"cannot be written: {error.strerror or error}.") from error
    finally:
        remove_temporary(temporary)
