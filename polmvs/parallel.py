"""One interface to parallel work over views, with three backends that give the same results.

The backends are this process, processes on this machine, and a ``dask.distributed`` cluster
(:mod:`polmvs.cluster`). A function given to :meth:`Workers.map` depends only on its arguments and
writes its files whole, so it may run anywhere and again.

On one machine polmvs uses processes and not threads: the sparse solver and many small array
operations hold Python's lock. They are spawned, not forked, because a fork after OpenCV, OpenBLAS
and COLMAP have started threads may hang.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import connection, get_context, parent_process, resource_tracker
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

from polmvs.safe_path import safe_path
from polmvs.threads import keep_to_one_core

if TYPE_CHECKING:
    from polmvs.cluster import TlsFiles

T = TypeVar("T")
OnProgress: TypeAlias = Callable[[int], None]  # called with the steps done since the last call
OnStep: TypeAlias = Callable[[str], None]  # called with the name of a step that begins

HELD_BACK = (signal.SIGINT, signal.SIGTERM)
# The parent's to its workers. COLMAP's log takes SIGTERM while it is imported and prints a stack.
STOP = getattr(signal, "SIGUSR1", signal.SIGTERM)
GRACE_S = 3.0  # for a worker that is stopped to clear up
POSIX = hasattr(signal, "pthread_sigmask")


def no_progress(count: int) -> None:
    """Ignore the progress."""


def no_step(name: str) -> None:
    """Ignore the step that begins."""


class Backend(Protocol):
    """Interface of what runs submitted tasks."""

    def submit(self, function: Callable[..., Any], task: tuple[Any, ...]) -> Any:
        """Submit a task; return a handle of its result."""

    def result(
        self,
        function: Callable[..., Any],
        tasks: list[tuple[Any, ...]],
        futures: list[Any],
        index: int,
    ) -> Any:
        """Result of a task of those submitted, in order; lost tasks are submitted again."""

    def close(self, *, cancel: bool) -> None:
        """Finish the running tasks, or cancel them with ``cancel``; a later map restarts them."""


class Workers:
    """The workers that run tasks in parallel.

    Functions and arguments given to :meth:`map` must be picklable. As with any spawned process, a
    script that asks for more than one worker needs ``if __name__ == "__main__":``.

    Parameters
    ----------
    num : number of processes, started at the first use; 1 means this process itself.
    backend : other backend that runs the tasks, ``num`` at a time.
    """

    def __init__(self, num: int = 1, backend: Backend | None = None) -> None:
        if num < 1:
            raise ValueError(f"{num=} but expected at least one worker.")
        self.num = num
        self._backend = backend or (None if num == 1 else _Processes(num))

    @property
    def are_processes_here(self) -> bool:
        """Whether tasks run in parallel processes of this machine."""
        return isinstance(self._backend, _Processes)

    @classmethod
    def of_cluster(
        cls,
        address: str,
        storage: Sequence[Path] = (),
        sources: Sequence[Path] = (),
        tls: TlsFiles | None = None,
    ) -> Workers:
        """The workers of a Dask scheduler; see :class:`polmvs.cluster.Cluster`."""
        from polmvs.cluster import Cluster

        cluster = Cluster(address, storage, sources, tls=tls)
        return cls(cluster.num_threads, cluster)

    def map(self, function: Callable[..., T], *iterables: Any) -> Iterator[T]:
        """Results in order, as of ``map``; the first error stops it."""
        return (outcome() for outcome in self.outcomes(function, *iterables))

    def outcomes(self, function: Callable[..., T], *iterables: Any) -> Iterator[Callable[[], T]]:
        """For each task, in order, a function to call once; it returns the result or raises.

        An error of one task does not stop the others. A task whose worker is lost runs again. A
        task that loses every worker raises ``BrokenProcessPool`` or a ``DataError``.
        """
        if self._backend is None:  # done here, when it is asked for
            return map(partial(partial, function), *iterables)
        tasks = list(zip(*iterables, strict=False))
        futures = [self._backend.submit(function, task) for task in tasks]
        ask = partial(self._backend.result, function, tasks, futures)
        return (partial(ask, index) for index in range(len(tasks)))

    @contextmanager
    def stopped_on_error(self) -> Iterator[None]:
        """Stop the running tasks on an error, before their files are deleted."""
        try:
            yield
        except BaseException:
            self._close(cancel=True)
            raise

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._close(cancel=kind is not None)

    def _close(self, *, cancel: bool) -> None:
        if self._backend is not None:
            self._backend.close(cancel=cancel)


class _Processes:
    """A pool of processes on this machine, started at the first use."""

    def __init__(self, num: int) -> None:
        self.num = num
        self._pool: ProcessPoolExecutor | None = None

    def result(
        self,
        function: Callable[..., T],
        tasks: list[tuple[Any, ...]],
        futures: list[Future[T]],
        index: int,
    ) -> T:
        """Result of a task; a task that was lost with its worker runs again alone.

        A killed worker takes all tasks with it, and which one killed it is not known.
        """
        task, future = tasks[index], futures[index]
        tasks[index], futures[index] = (), Future()  # nothing of it is held for those to come
        try:
            return future.result()
        except BrokenProcessPool:
            self.close(cancel=True)
            try:
                return self.submit(function, task).result()
            finally:
                for later in range(index + 1, len(tasks)):
                    done = futures[later].done() and not futures[later].cancelled()
                    if not done or isinstance(futures[later].exception(), BrokenProcessPool):
                        futures[later] = self.submit(function, tasks[later])

    def submit(self, function: Callable[..., T], task: tuple[Any, ...]) -> Future[T]:
        """Start the processes, if there are none, and queue a task."""
        if self._pool is None:
            with safe_path():  # it starts a process that keeps account of semaphores
                self._pool = ProcessPoolExecutor(
                    self.num, mp_context=get_context("spawn"), initializer=_start_worker
                )
        with _signals_held_back(), safe_path():
            try:
                return self._pool.submit(_at_work, function, task)
            except BrokenProcessPool as error:  # by one of the tasks before, as is told of them
                lost: Future[T] = Future()
                lost.set_exception(error)
                return lost

    def close(self, *, cancel: bool) -> None:
        """End the processes; if their work is cancelled, that which they are at as well."""
        if self._pool is not None:
            if cancel and POSIX:  # elsewhere a process cannot be told to clear up and end
                for process in list((self._pool._processes or {}).values()):
                    if process.pid is not None:
                        with suppress(ProcessLookupError):  # it has ended
                            os.kill(process.pid, STOP)
            self._pool.shutdown(wait=True, cancel_futures=cancel)
            self._pool = None


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """Start workers undisturbed: one that is stopped half-started prints a traceback.

    Ctrl-C reaches all processes of a terminal. A worker inherits that it is blocked and never
    sees it; this process handles it when the workers have been started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with safe_path():
        resource_tracker.ensure_running()  # it unblocks SIGINT when it is started
    arrived: list[int] = []
    before = {n: signal.signal(n, lambda n, _: arrived.append(n)) for n in HELD_BACK}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if POSIX else set()
    try:
        yield
    finally:
        if POSIX:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for held, handler in before.items():
            signal.signal(held, handler)
        for number in arrived:
            signal.raise_signal(number)


class _Stopped(BaseException):
    """Raised in a worker that has to end, so that its task removes its temporary files."""


_works = False  # whether this process, a worker, is at a task


def _at_work(function: Callable[..., T], task: tuple[Any, ...]) -> T:
    """Do a task in a worker, which may be stopped during it."""
    global _works
    try:
        _works = True
        return function(*task)
    except _Stopped:
        os._exit(1)
    finally:
        _works = False


def _stop_worker(number: int, frame: FrameType | None) -> None:
    """End this worker: at once, or after its running task has cleaned up, which must be quick.

    An exception that arrives in a callback of a library is lost; what is left then is the parent's
    to clear away.
    """
    for asking in (STOP, signal.SIGTERM):
        # Not SIG_IGN: if both are pending, Python prints that one was ignored.
        signal.signal(asking, lambda *_: None)
    if not _works:
        os._exit(1)
    timer = threading.Timer(GRACE_S, os._exit, (1,))
    timer.daemon = True
    timer.start()
    raise _Stopped


def _start_worker() -> None:
    """Ctrl-C is the parent's to handle, and one worker is one core."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for asking in (STOP, signal.SIGTERM):
        signal.signal(asking, _stop_worker)
    keep_to_one_core()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A killed parent cannot stop its workers, and they would wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
