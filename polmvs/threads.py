"""Threads that libraries start on their own, kept to what serves this program.

OpenBLAS shares each product of more than some 10,000 numbers among all cores and waits for all of
them busily. The solver's are little longer: on idle cores that gains nothing, and where another
process has one of them, most of the time is spent waiting. The last bits of a sum depend on the
number of threads as well, so that two machines gave two results.
"""

from __future__ import annotations

import importlib
from contextlib import AbstractContextManager
from typing import Any

import cv2
from threadpoolctl import threadpool_limits


def one_blas_thread() -> AbstractContextManager[Any]:
    """Linear algebra of NumPy and SciPy on the thread that asks for it, meanwhile."""
    importlib.import_module("scipy.linalg")  # a library can be told only once it is loaded
    limits: AbstractContextManager[Any] = threadpool_limits(1, user_api="blas")
    return limits


def keep_to_one_core() -> None:
    """Have this process, one of several workers, leave the other cores to the others."""
    cv2.setNumThreads(1)
    one_blas_thread()  # for good: nothing leaves it
