"""Memory and CPU time: what the processes of a run used, and what a budget allows.

The kernel keeps the largest resident memory of each process (``VmHWM``). Resetting it gives the
peak of one stage alone. Only Linux has it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from multiprocessing import active_children
from pathlib import Path

from polmvs.errors import OptionError

RESET_PEAK = "5"  # see proc(5), clear_refs


@dataclass(frozen=True, kw_only=True)
class MemoryNeeds:
    """Memory that a process of a run takes.

    Attributes
    ----------
    process_mb : with its libraries. Measured on Linux with Open3D not loaded.
    bytes_per_px : of the current polarization image of a process: all its Stokes images,
        masks and smoothed copies. Measured with 0.3 and 1.3 million pixels.
    bytes_per_row : of points and views that normals are solved from. Derived: rows and rays of
        two kinds of light, in single precision, and as much again in the solver.
    max_rows : rows solved at a time if the budget allows more; more hardly saves time.
    """

    process_mb: float = 170.0
    bytes_per_px: float = 250.0
    bytes_per_row: float = 150.0
    max_rows: int = 4_000_000


@dataclass(frozen=True, kw_only=True)
class MemoryPlan:
    """Workers and tiles that fit into a memory budget.

    Attributes
    ----------
    num_workers : processes that share the views; 1: the run's own process does all of them.
    max_rows : rows of points and views from which normals are solved at a time.
    """

    num_workers: int
    max_rows: int


def plan_memory(
    budget_gb: float | None, num_workers: int, num_px: int, needs: MemoryNeeds = MemoryNeeds()
) -> MemoryPlan:
    """Workers and tiles for a budget.

    Parameters
    ----------
    budget_gb : of all processes of the run together, GB; None: no budget.
    num_workers : that are wanted.
    num_px : of one polarization image.

    Raises
    ------
    OptionError
        The budget does not hold one view.
    """
    if budget_gb is None:
        return MemoryPlan(num_workers=num_workers, max_rows=needs.max_rows)
    view_mb = num_px * needs.bytes_per_px / 1e6
    least_mb = needs.process_mb + view_mb
    left_mb = 1e3 * budget_gb - least_mb
    if left_mb < 0:
        raise OptionError(
            f"{budget_gb:g} GB hold no view of {num_px / 1e6:.1f} million pixels, which takes "
            f"{least_mb / 1e3:.2f} GB. Give more, or smaller images (`capture.resolution` half).",
            field="run.memory",
        )
    # The run's own process waits for the workers, then solves.
    fitting = int(left_mb / least_mb)
    max_rows = int((left_mb + view_mb) * 1e6 / needs.bytes_per_row)
    return MemoryPlan(
        num_workers=min(num_workers, fitting) if fitting >= 2 else 1,
        max_rows=max(1, min(needs.max_rows, max_rows)),
    )


class PeakMemory:
    """Sum of the largest resident memory of a run's processes from now on.

    This is an upper bound: the peaks need not coincide, and shared memory counts for each process.
    If the system cannot reset a peak, it is the peak since the start.
    """

    def __init__(self) -> None:
        self._ended = _rusage_mb("RUSAGE_CHILDREN")
        for pid in _living():
            try:
                Path(f"/proc/{pid}/clear_refs").write_text(RESET_PEAK, encoding="ascii")
            except OSError:  # not Linux, or the process has ended
                continue

    def mb(self) -> float:
        """The sum so far, MB; a process that has ended counts if it is the largest of all such."""
        # getrusage starts from the peak of the process that started this one: the second choice.
        own = _peak_mb(os.getpid()) or _rusage_mb("RUSAGE_SELF")
        total = own + sum(_peak_mb(pid) for pid in _living() if pid != os.getpid())
        ended = _rusage_mb("RUSAGE_CHILDREN")
        return total + (ended if ended > self._ended else 0.0)


def cpu_seconds() -> float:
    """CPU time so far of this process, its workers and its ended children, seconds, all cores.

    Only Linux gives the time of workers that still run.
    """
    total = sum(os.times()[:4])
    for pid in _living():
        if pid != os.getpid():
            try:
                status = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
            except OSError:  # not Linux, or the process has ended
                continue
            ticks = status.rpartition(")")[2].split()[11:15]  # see proc(5)
            total += sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
    return total


def _living() -> Iterable[int]:
    """The run's own process and its workers."""
    return [os.getpid(), *(child.pid for child in active_children() if child.pid is not None)]


def _rusage_mb(who: str) -> float:
    """Peak memory of this process, or the largest of its ended children, MB."""
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    largest = resource.getrusage(getattr(resource, who)).ru_maxrss
    return largest / 1e6 if sys.platform == "darwin" else largest / 1e3


def _peak_mb(pid: int) -> float:
    """Peak memory of a process, MB; 0 if the system does not provide it."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace")
    except OSError:
        return 0.0
    for line in status.splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1e3
    return 0.0
