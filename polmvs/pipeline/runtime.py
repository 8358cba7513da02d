"""What a run says about the machine and software that it ran on."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import active_children
from pathlib import Path

from polmvs._version import __version__

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

PACKAGES = ("numpy", "scipy", "opencv-python-headless", "pycolmap", "open3d")


def versions() -> dict[str, str]:
    """Versions of Python, this package and what it stands on."""
    found = {"polmvs": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found


def peak_rss_mb() -> float:
    """Largest resident memory so far of this process and of its live workers, summed, MB.

    An upper bound: the processes need not have had their peaks at the same time, and what they
    share counts for each.
    """
    children = [_peak_of(child.pid) for child in active_children() if child.pid is not None]
    return _own_peak() + sum(children)


def _own_peak() -> float:
    # getrusage starts from the peak of the process that started this one: the second choice.
    peak = _peak_of(os.getpid())
    if peak or resource is None:
        return peak
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest / 1e6 if sys.platform == "darwin" else largest / 1e3


def _peak_of(pid: int) -> float:
    """High-water mark of another process, MB; 0 where the system does not tell."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace")
    except OSError:
        return 0.0
    for line in status.splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1e3
    return 0.0
