"""Parallel work over views on all cores.

Processes rather than threads: the sparse solver and many small array operations hold Python's
lock. They are spawned, not forked, because forking after OpenCV, OpenBLAS and COLMAP have started
threads may hang.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from types import TracebackType
from typing import Any, TypeVar

import cv2

T = TypeVar("T")


class Workers:
    """A pool of processes, started at the first use; one worker means this process itself.

    Functions and arguments given to :meth:`map` must be picklable. As with any spawned process, a
    script that asks for more than one worker needs ``if __name__ == "__main__":``.
    """

    def __init__(self, num: int = 1) -> None:
        if num < 1:
            raise ValueError(f"{num=} but expected at least one worker.")
        self.num = num
        self._pool: ProcessPoolExecutor | None = None

    def map(self, function: Callable[..., T], *iterables: Any) -> Iterator[T]:
        """Results in order, as ``map`` gives them."""
        if self.num == 1:
            return map(function, *iterables)
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                self.num, mp_context=get_context("spawn"), initializer=_start_worker
            )
        return self._pool.map(function, *iterables)

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=kind is not None)
            self._pool = None


def _start_worker() -> None:
    """Ctrl-C is the parent's to handle, and one worker is one core."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
