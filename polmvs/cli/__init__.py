"""The command line: the only place that knows flags, and the only one that prints."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from types import FrameType

__all__ = ["EMPTY_STATUS", "INTERRUPTED", "OUT_OF_TOLERANCE", "entry_point", "interrupts", "main"]

# Exit statuses beside those of errors.
EMPTY_STATUS = 3  # the run came to its end, and has no points
OUT_OF_TOLERANCE = 4  # the part deviates from its reference by more than is allowed
INTERRUPTED = 130  # as shells report a program ended by Ctrl-C

interrupts: list[int] = []  # signals that asked this process to end


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``polmvs`` with these arguments, those of the process by default; the exit status."""
    from polmvs.cli.commands import ABOUT, COMMANDS
    from polmvs.cli.running import run

    return run(COMMANDS, "polmvs", argv, ABOUT)


def entry_point() -> None:
    """Run the console command; a plain kill ends it as cleanly as Ctrl-C does."""
    try:
        signal.signal(signal.SIGTERM, _interrupt)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored
            signal.signal(signal.SIGINT, _interrupt)
        status = main()
    except KeyboardInterrupt:  # while modules are imported
        status = INTERRUPTED
    sys.exit(status)


def _interrupt(signum: int, frame: FrameType | None) -> None:
    interrupts.append(signum)
    raise KeyboardInterrupt
