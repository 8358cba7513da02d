"""The command line: the only place that knows flags, and the only one that prints."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from types import FrameType

from polmvs.cli.exit_status import INTERRUPTED, interrupts

__all__ = ["entry_point", "main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``polmvs`` with these arguments, or those of the process; return the exit status."""
    from polmvs.cli.commands import ABOUT, COMMANDS
    from polmvs.cli.running import run

    return run(COMMANDS, "polmvs", argv, ABOUT)


def entry_point() -> None:
    """Run the console command; SIGTERM ends it as cleanly as Ctrl-C."""
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
