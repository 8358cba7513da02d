"""Format of a run's log."""

from __future__ import annotations

import logging

from polmvs.errors import printable

LOG_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class LogFormatter(logging.Formatter):
    """Escapes control characters in the log.

    Further lines of a record are indented, so that no name can look like a new record.
    """

    def __init__(self) -> None:
        super().__init__(LOG_FORMAT)

    def format(self, record: logging.LogRecord) -> str:
        """One record, with its traceback."""
        lines = super().format(record).split("\n")
        return "\n    ".join(printable(line, keep="\t") for line in lines)
