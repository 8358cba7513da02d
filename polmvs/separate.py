"""Run a function in its own process, for libraries that end the process when they fail.

COLMAP aborts if it cannot write its database, and ignores Ctrl-C while it runs. Here an abort
becomes an error, and an interrupt stops the work at once. This does not use `multiprocessing`,
which imports the calling script again. The function must belong to an importable module.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from typing import IO, Any, TypeVar

from polmvs.errors import PolmvsError
from polmvs.safe_path import safe_environment

T = TypeVar("T")

SHOWN_BYTES = 20_000  # of what a library said at its end, for the log; a trace of calls may follow
CODE = "from polmvs.separate import work; work()"

logger = logging.getLogger(__name__)
package_logger = logging.getLogger("polmvs")


class CrashError(PolmvsError):
    """The process of a function ended before the function returned.

    Parameters
    ----------
    status : of the process; the negative number of a signal.
    said : the last lines on its standard error.
    """

    def __init__(self, status: int, said: str) -> None:
        number = f"signal {-status}" if status < 0 else f"status {status}"
        super().__init__(f"a library crashed ({number}); its last words are in the log.")
        self.status = status
        self.said = said

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by constructor arguments; exceptions default to their message."""
        return type(self), (self.status, self.said)


def run_separately(
    function: Callable[..., T],
    *arguments: Any,
    on_message: Callable[[str], None] = lambda text: None,
) -> T:
    """Call a function in its own process and return its result.

    Its log records and errors arrive here unchanged.

    Parameters
    ----------
    function : of a module; called with the arguments and then a function that takes texts.
    arguments : picklable.
    on_message : called here with each text.

    Raises
    ------
    CrashError
        The process ended before the function returned.
    """
    with (
        tempfile.TemporaryFile() as complaints,
        subprocess.Popen(
            [sys.executable, "-P", "-c", CODE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=complaints,
            env={**safe_environment(), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        ) as process,
    ):
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            task = (function, arguments, package_logger.getEffectiveLevel())
            _send(process.stdin, task)
            result: T = _result(process.stdout, on_message)
            return result
        except (EOFError, pickle.UnpicklingError, BrokenPipeError):
            status = process.wait()
            complaints.seek(0, os.SEEK_END)
            complaints.seek(max(complaints.tell() - SHOWN_BYTES, 0))
            said = complaints.read().decode(errors="replace")
            logger.error("last words: %s", said, extra={"file_only": True})
            raise CrashError(status, said) from None
        finally:
            process.kill()


def _send(stream: IO[bytes], content: Any) -> None:
    pickle.dump(content, stream)
    stream.flush()


def _result(stream: IO[bytes], on_message: Callable[[str], None]) -> Any:
    """Result of the process; messages and log records before it are passed on."""
    while True:
        kind, content = pickle.load(stream)
        match kind:
            case "message":
                on_message(content)
            case "log":
                logging.getLogger(content.name).handle(content)
            case "error":
                raise content
            case _:
                return content


# In the process


class _Sender(logging.Handler):
    """Sends log records to the parent."""

    def __init__(self, stream: IO[bytes]) -> None:
        super().__init__()
        self.stream = stream

    def emit(self, record: logging.LogRecord) -> None:
        """Send the text, as arguments and tracebacks may not pickle."""
        record.msg, record.args, record.exc_info = record.getMessage(), None, None
        _send(self.stream, ("log", record))


def work() -> None:
    """Do the task from standard input and write its result to standard output."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no result
    function, arguments, level = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    package_logger.addHandler(_Sender(results))
    package_logger.setLevel(level)
    package_logger.propagate = False
    try:
        content = function(*arguments, lambda text: _send(results, ("message", text)))
        _send(results, ("result", content))
    except Exception as error:
        _send(results, ("error", error))
    # Without the destructors of libraries, which may crash once more.
    os._exit(0)


def _end_with_parent() -> None:
    """End this process when the parent's end of the pipe closes, as when it is killed."""
    sys.stdin.buffer.read()
    os._exit(1)
