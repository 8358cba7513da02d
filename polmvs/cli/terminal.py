"""Output of a run for the user: progress, a line for each stage, warnings, and the log file."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from polmvs.cli.call import TerminalOptions
from polmvs.cli.flags import in_flags
from polmvs.config import to_plain
from polmvs.errors import DataError, printable
from polmvs.parallel import OnProgress, no_progress
from polmvs.pipeline.log_format import LogFormatter

if TYPE_CHECKING:  # heavy
    from rich.console import Console

    from polmvs.pipeline.run_folder import RunFolder

package_logger = logging.getLogger("polmvs")


@dataclass(frozen=True, kw_only=True)
class StageLine:
    """The line of a finished stage.

    Attributes
    ----------
    stage : its name.
    seconds : wall time.
    summary : its main number.
    """

    stage: str
    seconds: float
    summary: str


class _TerminalHandler(logging.Handler):
    """Shows log records; tracebacks are for the log file."""

    def __init__(self, terminal: Terminal, level: int) -> None:
        super().__init__(level)
        self.terminal = terminal

    def emit(self, record: logging.LogRecord) -> None:
        if not hasattr(record, "file_only"):
            text = in_flags(record.getMessage())
            if record.levelno >= logging.WARNING:
                self.terminal.warn(text)
            else:
                self.terminal.say(text)


class _LogFileHandler(logging.FileHandler):
    """Log file whose write errors, such as a full disk, do not interrupt a run."""

    def _open(self) -> TextIOWrapper:
        """Append to a file, not to what a link or a pipe of its name leads to."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        # A name of a file need not be UTF-8.
        return open(
            os.open(self.baseFilename, flags, 0o666),
            "a",
            encoding="utf-8",
            errors="backslashreplace",
        )

    def handleError(self, record: logging.LogRecord) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Close the file; a full disk may not take the rest of the log."""
        with suppress(OSError):
            super().close()


class Terminal:
    """Monitor of the run of a command, which shows and logs.

    Parameters
    ----------
    options : what to show.
    """

    def __init__(self, options: TerminalOptions) -> None:
        self.options = options
        self.log: Path | None = None
        self.warnings: list[str] = []
        self.stages: list[StageLine] = []
        self._silent = options.quiet or options.json
        self._unrepeated: list[str] = []  # shown, and since then something else
        self._handlers: list[logging.Handler] = []
        self._console: Console | None = None  # that of the bar in progress

    def __enter__(self) -> Terminal:
        level = logging.INFO if self.options.verbose else logging.WARNING
        self._add(_TerminalHandler(self, level))
        package_logger.setLevel(logging.DEBUG if self.options.verbose else logging.INFO)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.repeat_warnings()
        for handler in self._handlers:
            package_logger.removeHandler(handler)
            handler.close()
        self._handlers.clear()

    def say(self, text: str) -> None:
        """Print a line on stderr without breaking the progress bar."""
        if self._silent:
            return
        text = printable(text)
        if self._console is not None:
            self._console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(text, file=sys.stderr)

    def warn(self, text: str) -> None:
        """Show a warning now, and again at the end if other lines follow."""
        if text not in self.warnings:
            self.warnings.append(text)
            self.say(f"warning: {text}")

    def repeat_warnings(self) -> None:
        """Show all warnings again if other lines followed; an error comes after them."""
        if self._unrepeated:
            sys.stdout.flush()
            self.say(f"{len(self.warnings)} warning{'s' * (len(self.warnings) != 1)}:")
            for text in self.warnings:
                self.say(f"  {text}")
        self._unrepeated = []

    def show(self, text: str | Sequence[str], content: Any) -> None:
        """Print the result of the command on stdout.

        Parameters
        ----------
        text : for people. One text keeps its lines; of several texts each becomes one line.
        content : the same for machines: a dataclass, or JSON values.
        """
        if self.options.json:
            print(json.dumps(to_plain(content), indent=1))
        elif isinstance(text, str):
            print(printable(text, keep="\n"))
        else:
            print("\n".join(map(printable, text)))

    def opened(self, run_folder: RunFolder) -> None:
        """Start to log into the output folder."""
        self.log = run_folder.log
        try:
            handler = _LogFileHandler(run_folder.log, encoding="utf-8")
        except OSError as error:
            reason = f"cannot be written: {error.strerror or error}."
            raise DataError(run_folder.log, reason) from error
        handler.setFormatter(LogFormatter())
        self._add(handler)

    @contextmanager
    def stage(self, name: str, total: int | None) -> Iterator[OnProgress]:
        """Show a progress bar with the remaining time, if this is a terminal."""
        if self._silent or not sys.stderr.isatty():
            yield no_progress
            return
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        columns = (
            TextColumn("{task.description:<18}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left", style="dim"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task(name, total=total)
            self._console = progress.console
            try:
                yield lambda count: progress.advance(task, count)
            finally:
                self._console = None

    def finished(self, name: str, seconds: float, summary: str) -> None:
        """Show the line of a finished stage."""
        self.stages.append(StageLine(stage=name, seconds=seconds, summary=summary))
        self.say(f"{name:<20} {seconds:7.1f} s  {summary}".rstrip())
        self._unrepeated = list(self.warnings)

    def skipped(self, name: str) -> None:
        """Show that an earlier call finished a stage."""
        if self.options.verbose:
            self.say(f"{name:<20} finished earlier")

    def _add(self, handler: logging.Handler) -> None:
        self._handlers.append(handler)
        package_logger.addHandler(handler)
