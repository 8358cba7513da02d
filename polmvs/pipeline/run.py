"""A run in an output folder: checked before it begins, recorded stage by stage, able to go on.

A stage is recorded in ``run.json`` when its files are whole. A run that goes on skips recorded
stages; the options that these used must be the same. Every stage reads its input from the output
folder, so that a run that was stopped gives the same result as one that was not.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from polmvs.config import Options, RunOptions, to_plain
from polmvs.errors import DataError, PolmvsError
from polmvs.parallel import Workers
from polmvs.pipeline.checks import (
    alternatives,
    check_input,
    command_of,
    followers,
    identity_of,
    inputs_of,
    options_of,
    require_same_capture,
    require_same_options,
)
from polmvs.pipeline.record import Record, StageRecord
from polmvs.pipeline.run_folder import RunFolder, prepare_output, require_apart
from polmvs.pipeline.runtime import peak_rss_mb, versions
from polmvs.pipeline.stages.capture import image_names
from polmvs.polarization.capture import Capture, open_capture
from polmvs.scene import SparseModel

logger = logging.getLogger(__name__)

Report = Callable[[int], None]
Facts = dict[str, Any]


class Watcher(Protocol):
    """Who watches a run."""

    def opened(self, workspace: RunFolder) -> None:
        """The output folder is ready."""

    def stage(self, name: str, total: int | None) -> AbstractContextManager[Report]:
        """A stage begins; the report is called with the number of steps done."""


class Silence:
    """Nobody watches."""

    def opened(self, workspace: RunFolder) -> None:
        """Do nothing."""

    def stage(self, name: str, total: int | None) -> AbstractContextManager[Report]:
        """Do nothing."""
        return nullcontext(lambda count: None)


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One step of a run.

    Attributes
    ----------
    name : in ``run.json``; a key of ``STAGE_OPTIONS``.
    work : does it; gets the report of its progress, gives the facts found.
    after : stages that it reads from.
    total : how many steps it reports; None if that is not known.
    """

    name: str
    work: Callable[[Report], Facts]
    after: tuple[str, ...] = ()
    total: int | None = None


@dataclass(kw_only=True)
class Run:
    """A run in progress.

    Attributes
    ----------
    workspace, capture, options, workers, monitor : what it works with.
    given_model : the model of ``--sparse``, fitted to the capture.
    record : what is finished, as in ``run.json``.
    """

    workspace: RunFolder
    capture: Capture
    options: Options
    workers: Workers
    monitor: Watcher
    given_model: SparseModel | None
    record: Record
    _started: float = field(default_factory=time.perf_counter)

    def do(self, stage: Stage) -> None:
        """Do a stage, unless it is finished, and record it.

        Raises
        ------
        DataError
            A stage that it reads from is not finished.
        """
        if self.record.is_done(stage.name):
            logger.info("%s: finished earlier", stage.name)
            return
        for name in stage.after:
            if not self.record.is_done(*alternatives(name)):
                raise DataError(
                    self.workspace.root,
                    f"its stage {name!r} is not finished, which {stage.name!r} reads. "
                    f"Run 'polmvs {command_of(name)}' first.",
                )
        logger.info("%s: begins", stage.name)
        start = time.perf_counter()
        with self.monitor.stage(stage.name, stage.total) as report:
            facts = stage.work(report)
        seconds = round(time.perf_counter() - start, 3)
        logger.info("%s: %.1f s, %s", stage.name, seconds, facts)
        self.record.results.update(facts)
        peak = round(peak_rss_mb(), 1)
        self.record.stages.append(StageRecord(name=stage.name, seconds=seconds, peak_rss_mb=peak))
        self.record.stage_options[stage.name] = options_of(stage.name, self.options)
        self.save()

    def forget(self, name: str) -> None:
        """Have a stage done again, and all that follow it; their files go."""
        names = followers(name)
        paths = [path for forgotten in names for path in self.workspace.files_of(forgotten)]
        for path in paths:
            self.workspace.require_own(path)
        self.record.forget(names)
        self.save()
        for path in paths:
            self.workspace.discard(path)

    def save(self, *, finished: bool = False) -> None:
        """Write ``run.json``."""
        now = time.perf_counter()
        self.record.wall_s = round(self.record.wall_s + now - self._started, 3)
        self._started = now
        self.record.finished = finished
        self.workspace.save(self.record)


@contextmanager
def open_run(
    capture_folder: Path,
    out: Path,
    options: Options,
    how: RunOptions,
    *,
    min_images: int,
    uses: Collection[str],
    goes_on: bool = False,
    monitor: Watcher | None = None,
    command_line: Sequence[str] = (),
) -> Iterator[Run]:
    """Check the input, make the output folder ready, and give the run.

    Nothing is written or deleted before all input is found sound.

    Parameters
    ----------
    capture_folder, out : as the user gave them.
    options : of all stages.
    how : workers, overwrite and resume.
    min_images : the fewest that will do.
    uses : names of the stages that are taken over if they are finished.
    goes_on : the folder must hold a run, and its finished stages stay, whatever ``how`` says.
    monitor : who watches.
    command_line : for the record.

    Raises
    ------
    DataError, OptionError
        The input is unusable, or the output folder is.
    """
    monitor = monitor if monitor is not None else Silence()
    workspace = RunFolder(out)
    require_apart(workspace, capture=capture_folder, others=inputs_of(options))
    capture = open_capture(capture_folder, options.capture)
    given_model = check_input(capture, options, min_images)
    if goes_on:
        workspace.load()
    record = prepare_output(
        workspace,
        overwrite=how.overwrite and not goes_on,
        resume=how.resume or goes_on,
    )
    identity = identity_of(capture)
    require_same_capture(record, identity, workspace)
    require_same_options(record, options, uses, workspace)
    record.capture, record.images = identity, list(image_names(capture))
    record.command_line, record.versions = list(command_line), versions()
    record.options = to_plain(options)
    with Workers(how.workers) as workers:
        run = Run(
            workspace=workspace,
            capture=capture,
            options=options,
            workers=workers,
            monitor=monitor,
            given_model=given_model,
            record=record,
        )
        run.save()
        monitor.opened(workspace)
        try:
            yield run
        except BaseException:
            with suppress(PolmvsError):  # the first error is the one to report
                run.save()
            raise
