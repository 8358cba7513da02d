"""Arrays on disk that are mapped into memory, so that the peak is independent of the views.

An object with stored arrays is pickled as the path of its files, so passing it to a worker costs
nothing.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy import typing as npt
from numpy.typing import NDArray

from polmvs.errors import MAX_QUOTED, DataError
from polmvs.io.images import write_bytes
from polmvs.io.plain_files import require_plain

MADE_AGAIN = "Delete it and give `run.resume`; what is gone is made again."


@dataclass(frozen=True)
class StoredArray:
    """An array on disk, which ``np.asarray`` maps into memory, read only."""

    path: Path

    def __array__(
        self, dtype: npt.DTypeLike | None = None, copy: bool | None = None
    ) -> NDArray[Any]:
        """See :func:`map_array`."""
        return np.asarray(map_array(self.path), dtype)


def save_array(path: Path, array: NDArray[Any]) -> None:
    """Write an ``.npy`` file whole or not at all, into an existing folder.

    A late worker must not create the folder of an aborted stage again.
    """
    buffer = io.BytesIO()
    np.save(buffer, array)
    write_bytes(path, buffer.getvalue())


def kept_array(array: NDArray[Any], path: Path | None) -> NDArray[Any] | StoredArray:
    """The array itself; with a path, the array stored there."""
    if path is None:
        return array
    save_array(path, array)
    return StoredArray(path)


def map_array(path: Path, kind: npt.DTypeLike | None = None) -> NDArray[Any]:
    """Map an ``.npy`` file into memory, read only.

    Parameters
    ----------
    kind : type of its rows, or required kind of number; None: any.

    Raises
    ------
    DataError
        The file is missing, damaged or of another type.
    """
    try:
        require_plain(path)
        stamp = path.stat().st_mtime_ns
        array = _map_array(path, stamp)
    except Exception as error:  # the header goes through Python's own parser
        reason = " ".join(str(error).split())[:MAX_QUOTED]
        raise DataError(path, f"cannot be read ({reason}). {MADE_AGAIN}") from error
    rows = isinstance(kind, np.dtype)
    if kind is not None and not (array.dtype == kind if rows else np.issubdtype(array.dtype, kind)):
        raise DataError(path, f"holds something else. {MADE_AGAIN}")
    return array


# Arrays of the current views: mapped and read pages count as resident memory.
@lru_cache(maxsize=16)
def _map_array(path: Path, stamp: int) -> NDArray[Any]:
    # A plain array over the map: OpenCV takes it without a copy.
    return np.asarray(np.lib.format.open_memmap(path, mode="r"))
