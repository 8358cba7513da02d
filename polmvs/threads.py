"""Limits on the threads that libraries start.

OpenBLAS divides each product of more than about 10,000 numbers among all cores and waits for them
in a busy loop, and so does OpenMP, which Open3D uses, with its loops. The solver's products are
only slightly longer. On idle cores threads gain nothing; if another thread uses a core, most of the
time is spent waiting. The last bits of a sum also depend on the number of threads, so two machines
would give two results.
"""

from __future__ import annotations

import importlib
import os
from contextlib import AbstractContextManager
from typing import Any

import cv2
from threadpoolctl import threadpool_limits


def one_thread_each() -> AbstractContextManager[Any]:
    """Run linear algebra, and loops of OpenMP, on the calling thread in this block.

    It holds for the libraries that are loaded when the block begins.
    """
    importlib.import_module("scipy.linalg")
    limits: AbstractContextManager[Any] = threadpool_limits(1)
    return limits


def keep_to_one_core() -> None:
    """Limit this process, one of several workers, to one core."""
    cv2.setNumThreads(1)
    one_thread_each()  # for good: nothing leaves it
    os.environ["OMP_NUM_THREADS"] = "1"  # for what is not loaded yet
