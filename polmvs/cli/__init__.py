"""The command line."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from types import FrameType

__all__ = ["entry_point", "main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``polmvs`` with these arguments, those of the process by default; the exit status."""
    from polmvs.cli.parsers import build_parser
    from polmvs.cli.terminal import Terminal, guarded

    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        args = build_parser().parse_args(arguments)
    except SystemExit as stop:  # --help, --version and usage errors
        return int(stop.code or 0)
    args.command_line = ["polmvs", *arguments]
    with Terminal(verbose=args.verbose) as terminal:
        return guarded(lambda: args.run(args, terminal), terminal, f"polmvs {args.command}")


def entry_point() -> None:
    """Run the console command; a plain kill ends it as cleanly as Ctrl-C does."""
    try:
        # COLMAP's log takes SIGTERM for itself when it is imported: after that.
        import_module("polmvs.colmap.models")
        signal.signal(signal.SIGTERM, _interrupt)
        status = main()
    except KeyboardInterrupt:  # while modules are imported
        status = 130
    sys.exit(status)


def _interrupt(signum: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
