"""Who watches a run: what a terminal, a notebook or a test implements to follow it."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from polmvs.parallel import OnProgress, no_progress
from polmvs.pipeline.run_folder import RunFolder


class Monitor(Protocol):
    """Who watches a run."""

    def opened(self, run_folder: RunFolder) -> None:
        """The run folder is ready."""

    def stage(self, name: str, total: int | None) -> AbstractContextManager[OnProgress]:
        """A stage begins, of ``total`` steps if that is known; gives who is told of its steps."""

    def finished(self, name: str, seconds: float, summary: str) -> None:
        """A stage is finished and recorded; the summary is what it found, in a few words."""

    def skipped(self, name: str) -> None:
        """A stage was finished earlier."""


class NoMonitor:
    """Nobody watches."""

    def opened(self, run_folder: RunFolder) -> None:
        """Do nothing."""

    def stage(self, name: str, total: int | None) -> AbstractContextManager[OnProgress]:
        """Do nothing."""
        return nullcontext(no_progress)

    def finished(self, name: str, seconds: float, summary: str) -> None:
        """Do nothing."""

    def skipped(self, name: str) -> None:
        """Do nothing."""
