"""What the user sees of a run: progress, warnings, the log file, and one line for every error."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from types import TracebackType

from tqdm import tqdm

from polmvs.colmap.cameras import quiet_colmap
from polmvs.errors import DataError, PolmvsError
from polmvs.pipeline.monitor import OnProgress
from polmvs.pipeline.run_folder import RunFolder

INTERRUPTED = 130  # as shells report a program ended by Ctrl-C
FILE_ONLY = {"file_only": True}  # of records that the terminal gets in another form
LOG_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"

logger = logging.getLogger(__name__)
package_logger = logging.getLogger("polmvs")


class _TerminalHandler(logging.Handler):
    """Lines on stderr that do not break the progress bar; tracebacks are for the log file."""

    def emit(self, record: logging.LogRecord) -> None:
        if not hasattr(record, "file_only"):
            level = "" if record.levelno < logging.WARNING else f"{record.levelname.lower()}: "
            tqdm.write(f"{level}{record.getMessage()}", file=sys.stderr)


class _LogFileHandler(logging.FileHandler):
    """A log on a full disk is no reason to complain in the middle of a run."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Do nothing."""


class Terminal:
    """One call of the command: a :class:`polmvs.pipeline.monitor.Monitor` that shows and logs.

    Parameters
    ----------
    verbose : show every step, and log details.
    """

    def __init__(self, *, verbose: bool) -> None:
        self.verbose = verbose
        self.run_folder: RunFolder | None = None
        self._handlers: list[logging.Handler] = []
        self._scope = ExitStack()

    def __enter__(self) -> Terminal:
        self._scope.enter_context(quiet_colmap())
        handler = _TerminalHandler(logging.INFO if self.verbose else logging.WARNING)
        self._add(handler)
        package_logger.setLevel(logging.DEBUG if self.verbose else logging.INFO)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._scope.close()
        for handler in self._handlers:
            package_logger.removeHandler(handler)
            handler.close()
        self._handlers.clear()

    def opened(self, run_folder: RunFolder) -> None:
        """Log into the output folder from now on."""
        self.run_folder = run_folder
        try:
            handler = _LogFileHandler(run_folder.log, encoding="utf-8")
        except OSError as error:
            reason = f"cannot be written: {error.strerror or error}."
            raise DataError(run_folder.log, reason) from error
        handler.setFormatter(logging.Formatter(LOG_FORMAT))
        self._add(handler)

    @contextmanager
    def stage(self, name: str, total: int | None) -> Iterator[OnProgress]:
        """Show a bar, if this is a terminal."""
        with tqdm(
            total=total, desc=name, disable=None, leave=False, file=sys.stderr, mininterval=0.2
        ) as bar:

            def on_progress(count: int) -> None:
                bar.update(count)

            yield on_progress

    def finished(self, name: str, seconds: float, summary: str) -> None:
        """The log says it."""

    def skipped(self, name: str) -> None:
        """The log says it."""

    def _add(self, handler: logging.Handler) -> None:
        self._handlers.append(handler)
        package_logger.addHandler(handler)


def guarded(command: Callable[[], int], terminal: Terminal, name: str) -> int:
    """Run a command; whatever goes wrong becomes one line on stderr and an exit status.

    Parameters
    ----------
    command : gives the exit status.
    terminal : of this call.
    name : of the command, for the message.
    """
    try:
        return command()
    except KeyboardInterrupt:
        kept = "; finished stages are kept, go on with --resume"
        _complain(name, "interrupted" + (kept if terminal.run_folder is not None else ""))
        return INTERRUPTED
    except PolmvsError as error:
        logger.debug("where it happened:", exc_info=True, extra=FILE_ONLY)
        _complain(name, f"error: {error}")
        return error.exit_status
    except BrokenPipeError:  # the reader of stdout has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (BrokenProcessPool, MemoryError):
        logger.debug("where it happened:", exc_info=True, extra=FILE_ONLY)
        _complain(name, "error: out of memory, or a worker was killed. Give --workers 1.")
        return 1
    except OSError as error:
        logger.debug("where it happened:", exc_info=True, extra=FILE_ONLY)
        place = f"{error.filename}: " if error.filename else ""
        _complain(name, f"error: {place}{error.strerror or error}.")
        return 1
    except Exception as error:
        logger.critical("internal error", exc_info=True, extra=FILE_ONLY)
        where = f"; see {terminal.run_folder.log}" if terminal.run_folder is not None else ""
        text = " ".join(f"{type(error).__name__}: {error}".split())
        _complain(name, f"internal error: {text}{where}")
        return 1


def _complain(name: str, message: str) -> None:
    line = " ".join(message.split())
    logger.error("%s", line, extra=FILE_ONLY)
    print(f"{name}: {line}", file=sys.stderr)
