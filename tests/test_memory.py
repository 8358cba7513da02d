"""Memory: peaks of stages, and what a budget allows."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from polmvs.errors import OptionError
from polmvs.memory import MemoryNeeds, cpu_seconds, plan_memory
from polmvs.parallel import Workers

NEEDS = MemoryNeeds(process_mb=100, bytes_per_px=200, bytes_per_row=100, max_rows=5_000_000)


PEAKS_SCRIPT = """
import numpy as np

from polmvs.memory import PeakMemory
from polmvs.parallel import Workers


def fill(megabytes):
    return int(np.ones(megabytes * 125_000).sum())


if __name__ == "__main__":
    before = PeakMemory().mb()
    first = PeakMemory()
    fill(200)
    own, after = first.mb(), PeakMemory().mb()
    with Workers(2) as workers:
        list(workers.map(fill, [1, 1]))
        idle = PeakMemory().mb()
        second = PeakMemory()
        list(workers.map(fill, [150]))
        print(before, own, after, idle, second.mb())
"""


def spin(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_without_a_budget_all_is_as_wanted() -> None:
    plan = plan_memory(None, 8, 1_000_000, NEEDS)
    assert (plan.num_workers, plan.max_rows) == (8, 5_000_000)


@pytest.mark.parametrize(
    ("budget_gb", "num_workers", "max_rows"),
    [
        # A view takes 0.3 GB: the process itself, then pairs of it and workers.
        (0.3, 1, 2_000_000),
        (0.8, 1, 5_000_000),
        (0.95, 2, 5_000_000),
        (1.25, 3, 5_000_000),
        (10.0, 8, 5_000_000),
    ],
)
def test_workers_and_tiles_fit_the_budget(budget_gb, num_workers, max_rows) -> None:
    plan = plan_memory(budget_gb, 8, 1_000_000, NEEDS)
    assert (plan.num_workers, plan.max_rows) == (num_workers, max_rows)


def test_too_small_for_one_view() -> None:
    message = r"`run\.memory` 0\.2 GB hold no view of 1\.0 million pixels, which takes 0\.30 GB"
    with pytest.raises(OptionError, match=message):
        plan_memory(0.2, 8, 1_000_000, NEEDS)


@pytest.mark.skipif(sys.platform != "linux", reason="peaks are set back on Linux only")
def test_peaks_are_of_their_time(tmp_path: Path) -> None:
    """A large array is seen in its own stage, a worker's too, and not in the next."""
    # In a process of its own: what earlier tests have freed, and their threads, change its memory.
    script = tmp_path / "peaks.py"
    script.write_text(PEAKS_SCRIPT, encoding="utf-8")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    before, own, after, idle, of_workers = map(float, done.stdout.split())
    assert 190 < own - before < 260
    assert after - before < 100
    assert 120 < of_workers - idle < 220


@pytest.mark.skipif(sys.platform != "linux", reason="times of living workers are known on Linux")
def test_processor_time_of_workers_counts_once() -> None:
    first, first_times = cpu_seconds(), os.times()
    with Workers(2) as workers:
        list(workers.map(spin, [0.3, 0.3]))
        alive = cpu_seconds() - first
    all_ended, times = cpu_seconds() - first, os.times()
    own, children = (sum(times[k] - first_times[k] for k in places) for places in ((0, 1), (2, 3)))
    # Workers take time to start and to end, as the machine will: the truth is the system's count
    # of children that have ended. Times come in ticks of 10 ms.
    assert 0.56 < alive <= own + children + 0.04
    assert all_ended == pytest.approx(own + children, abs=0.04)
