"""Child processes of this program import nothing from the current directory.

For a process started with ``-c``, as :mod:`multiprocessing` and :mod:`polmvs.separate` do, Python
puts the current directory first on the path. A file ``numpy.py`` or ``polmvs.py`` in the folder of
a capture would run. PYTHONSAFEPATH prevents that, also in their children.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

VARIABLE = "PYTHONSAFEPATH"  # Python 3.11 and later
SAFE = "1"  # any text that is not empty

_lock = threading.Lock()
_inside: list[str | None] = []  # what the variable was before each block that is open


def safe_environment() -> dict[str, str]:
    """The environment of this process with a safe path, for a child."""
    return {**os.environ, VARIABLE: SAFE}


@contextmanager
def safe_path() -> Iterator[None]:
    """Processes that start in this block inherit a safe path; for those that take no environment.

    The variable is restored when the last thread leaves the block.
    """
    with _lock:
        _inside.append(os.environ.get(VARIABLE) if not _inside else _inside[0])
        os.environ[VARIABLE] = SAFE
    try:
        yield
    finally:
        with _lock:
            before = _inside.pop()
            if not _inside:
                if before is None:
                    os.environ.pop(VARIABLE, None)
                else:
                    os.environ[VARIABLE] = before
