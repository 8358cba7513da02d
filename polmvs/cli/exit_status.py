"""Exit statuses other than those of errors, and whether this process was asked to end."""

from __future__ import annotations

EMPTY_STATUS = 3  # the run completed without points
OUT_OF_TOLERANCE = 4  # the part deviates from its reference by more than is allowed
INTERRUPTED = 130  # as shells report a program ended by Ctrl-C

interrupts: list[int] = []  # signals that asked this process to end
