"""Arrays on disk that are mapped into memory: what keeps the peak independent of the views.

An object whose arrays are stored is pickled as the path of its files, so that handing it to a
worker costs nothing.
"""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.errors import DataError
from polmvs.io.images import write_bytes


def save_array(path: Path, array: NDArray[Any]) -> None:
    """Write an ``.npy`` file whole or not at all, into a folder that there is.

    A worker that is late must not make the folder of a stage again that was given up.
    """
    buffer = io.BytesIO()
    np.save(buffer, array)
    write_bytes(path, buffer.getvalue())


def map_array(path: Path) -> NDArray[Any]:
    """Map an ``.npy`` file into memory, read only.

    Raises
    ------
    DataError
        If the file is missing or damaged.
    """
    try:
        stamp = path.stat().st_mtime_ns
        return _map_array(path, stamp)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(
            path, f"cannot be read ({error}); run again with `run.overwrite`."
        ) from error


# Those of the views that are being looked at: what is mapped and read counts as resident memory.
@lru_cache(maxsize=32)
def _map_array(path: Path, stamp: int) -> NDArray[Any]:
    # A plain array over the map: OpenCV takes it without a copy.
    return np.asarray(np.load(path, mmap_mode="r"))
