"""Limits on the threads that libraries start.

OpenBLAS divides each product of more than about 10,000 numbers among all cores and waits for them
in a busy loop. The solver's products are only slightly longer. On idle cores threads gain nothing;
if another process uses a core, most of the time is spent waiting. The last bits of a sum also
depend on the number of threads, so two machines would give two results.
"""

from __future__ import annotations

import importlib
from contextlib import AbstractContextManager
from typing import Any

import cv2
from threadpoolctl import threadpool_limits


def one_blas_thread() -> AbstractContextManager[Any]:
    """Run the linear algebra of NumPy and SciPy on the calling thread in this block."""
    importlib.import_module("scipy.linalg")  # a library can be told only once it is loaded
    limits: AbstractContextManager[Any] = threadpool_limits(1, user_api="blas")
    return limits


def keep_to_one_core() -> None:
    """Limit this process, one of several workers, to one core."""
    cv2.setNumThreads(1)
    one_blas_thread()  # for good: nothing leaves it
