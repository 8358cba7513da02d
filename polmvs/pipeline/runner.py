"""A run in a run folder: checks before the start, a record after each stage, and resume.

A stage is recorded in ``run.json`` when its files are complete. A resumed run skips recorded
stages; their options must be the same. Every stage reads its input from the run folder, so a run
that was stopped and resumed gives the same result. Decisions about a stage are made when it begins,
when all of its input is known.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from polmvs.cluster import TlsFiles
from polmvs.colmap.cameras import quiet_colmap
from polmvs.config import (
    Options,
    RunOptions,
    options_from_plain,
    plain_options,
    replace_option,
    show_value,
    to_plain,
    with_absolute_paths,
)
from polmvs.errors import DataError, OptionError, PolmvsError, as_data_error
from polmvs.io.folders import require_unicode
from polmvs.io.temporary import TOKEN, work_for
from polmvs.memory import MemoryPlan, PeakMemory, cpu_seconds, plan_memory
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.pipeline.checks import (
    check_input,
    digest_of,
    identity_of,
    inputs_of,
    require_apart,
    require_same_capture,
)
from polmvs.pipeline.record import (
    CaptureIdentity,
    Record,
    StageRecord,
    read_image_names,
    read_record,
    versions,
    write_record,
)
from polmvs.pipeline.run_folder import (
    RUN_FILE,
    RunFolder,
    discard,
    has_content,
    num_files,
    require_no_link,
    require_own,
)
from polmvs.pipeline.run_lock import left_over_names, locked
from polmvs.pipeline.stage_table import (
    StageInput,
    StageSpec,
    needed_by,
    result_types,
    with_dependent,
    written_names,
)
from polmvs.pipeline.stages.densify import DensifyResult
from polmvs.pipeline.stages.images import image_names
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import AngleModel
from polmvs.threads import one_thread_each

logger = logging.getLogger(__name__)

FILE_ONLY = {"file_only": True}  # of records that a monitor is told of as well


class Monitor(Protocol):
    """Interface to follow a run, for a terminal, a notebook or a test."""

    def opened(self, run_folder: RunFolder) -> None:
        """The run folder is ready."""

    def stage(self, name: str, total: int | None) -> AbstractContextManager[OnProgress]:
        """A stage begins, with ``total`` steps if known; gives the function for its steps."""

    def finished(self, name: str, seconds: float, summary: str) -> None:
        """A stage is finished and recorded; the summary is its result in a few words."""

    def skipped(self, name: str) -> None:
        """A stage was finished earlier."""


class NoMonitor:
    """A monitor that ignores everything."""

    def opened(self, run_folder: RunFolder) -> None:
        """Do nothing."""

    def stage(self, name: str, total: int | None) -> AbstractContextManager[OnProgress]:
        """Do nothing."""
        return nullcontext(no_progress)

    def finished(self, name: str, seconds: float, summary: str) -> None:
        """Do nothing."""

    def skipped(self, name: str) -> None:
        """Do nothing."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """Arguments of every job.

    Attributes
    ----------
    capture : folder of raw mosaics.
    out : run folder.
    options : of all stages.
    run_options : workers, overwrite and resume.
    monitor : follows the run, if given.
    command_line : for the record.
    """

    capture: Path
    out: Path
    options: Options = Options()
    run_options: RunOptions = RunOptions()
    monitor: Monitor | None = None
    command_line: Sequence[str] = ()

    def absolute(self) -> Job:
        """The same with paths that any working folder can read."""
        return replace(
            self,
            capture=self.capture.absolute(),
            out=self.out.absolute(),
            options=with_absolute_paths(self.options),
        )


@dataclass(kw_only=True)
class Run(StageInput):
    """A run in progress; stages get their input as :class:`StageInput`.

    Attributes
    ----------
    monitor : follows the run.
    table : all stages, in order.
    budget_gb : memory budget of the stages; None: none.
    """

    monitor: Monitor
    table: Sequence[StageSpec]
    budget_gb: float | None = None
    _started: float = field(default_factory=time.perf_counter)
    _digests: dict[str, str] = field(default_factory=dict)

    def is_finished(self, spec: StageSpec) -> bool:
        """Whether a stage is recorded and its files still exist."""
        finished = self.record.stage(spec.name)
        return finished is not None and not finished.is_lost and not self._lost(finished)

    def _lost(self, finished: StageRecord) -> list[str]:
        """Files and folders of a finished stage that are gone or incomplete."""
        root, wrote = self.run_folder.root, finished.wrote
        return [path for path, number in wrote.items() if num_files(root / path) < number]

    def do(self, spec: StageSpec) -> None:
        """Run a stage, unless it is finished, and record it; see :meth:`do_all`."""
        self.do_all([spec])

    def do_all(self, specs: Sequence[StageSpec]) -> None:
        """Run independent stages, unless they are finished, and record them.

        They run in parallel if they can (``StageSpec.call``), if this machine has workers for them,
        and without a memory budget.

        Raises
        ------
        DataError
            A stage that one reads from is not finished.
        """
        due = [spec for spec in specs if self._is_due(spec)]
        calls = [call for spec in due if (call := spec.call(self)) is not None]
        alone = self.budget_gb is not None or not self.workers.are_processes_here
        if alone or len(calls) < max(len(due), 2):
            for spec in due:
                self._carry_out(spec)
        else:
            self._carry_out_side_by_side(due, calls)

    def _is_due(self, spec: StageSpec) -> bool:
        """Whether a stage has to be done; if so, its remains are deleted.

        One whose files are gone is done again, and alone: what was made of them stays, for the same
        options give the same files.

        Raises
        ------
        DataError
            A stage that it reads from is not finished.
        """
        finished = self.record.stage(spec.name)
        if finished is not None and not finished.is_lost and (lost := self._lost(finished)):
            logger.warning(
                "%s: %s is gone, or part of it, and is made again.", spec.name, ", ".join(lost)
            )
            self._delete([spec], replace(finished, is_lost=True))
        is_finished = self.is_finished(spec)
        if finished is not None and is_finished and not self._is_redone(spec, finished):
            logger.info("%s: finished earlier", spec.name, extra=FILE_ONLY)
            self.monitor.skipped(spec.name)
            return False
        for other in needed_by(spec, self.table):
            if not self.is_finished(other):
                state = "is not finished" if self.record.stage(other.name) is None else "lost files"
                raise DataError(
                    self.run_folder.root,
                    f"its stage {other.name!r} {state}, which {spec.name!r} reads. "
                    f"Run 'polmvs {other.command}' first.",
                )
        if is_finished:
            self.forget([spec.name])
        return True

    def _carry_out(self, spec: StageSpec) -> None:
        """Run a stage whose input exists, and record it."""
        logger.info("%s: begins", spec.name)
        start, cpu_start, memory = time.perf_counter(), cpu_seconds(), PeakMemory()
        with (
            self.monitor.stage(spec.name, spec.num_steps(self)) as self.on_progress,
            _kept(logging.WARNING) as said,
            one_thread_each(),
        ):
            result = spec.work(self)
            peak_mb = memory.mb()
            if self.budget_gb is not None and peak_mb > 1e3 * self.budget_gb:
                logger.warning(
                    "%s took %.2f GB, more than the %g GB of `run.memory`: not all that it holds "
                    "depends on the number of workers.",
                    spec.name,
                    peak_mb / 1e3,
                    self.budget_gb,
                )
        done = _Done(result, time.perf_counter() - start, cpu_seconds() - cpu_start)
        self._record(spec, done, peak_mb, said)

    def _carry_out_side_by_side(
        self, specs: Sequence[StageSpec], calls: Sequence[Callable[[], Any]]
    ) -> None:
        """Run each stage in a process of its own, and record them in order.

        The memory of each is that of all together.
        """
        for spec in specs:
            logger.info("%s: begins", spec.name)
        memory = PeakMemory()
        name = f"{len(specs)} side by side"
        with (
            self.monitor.stage(name, len(specs)) as on_progress,
            self.workers.stopped_on_error(),
        ):
            work = self.workers.map(partial(_done_apart, TOKEN), calls)
            for spec, done in zip(specs, work, strict=True):
                with _kept(logging.WARNING) as said:
                    for logged in done.logged:
                        logging.getLogger(logged.logger).log(logged.level, "%s", logged.text)
                self._record(spec, done, memory.mb(), said)
                on_progress(1)

    def _record(
        self, spec: StageSpec, done: _Done, peak_mb: float, said: Sequence[_Logged]
    ) -> None:
        """Record a finished stage and report it."""
        result, seconds = done.result, round(done.seconds, 3)
        logger.info("%s: %.1f s, %s", spec.name, seconds, result, extra=FILE_ONLY)
        finished = StageRecord(
            name=spec.name,
            angle_model=spec.angle_model,
            reads=_names(spec.reads),
            wrote={
                path.as_posix(): number
                for path in spec.writes
                if (number := num_files(self.run_folder.root / path))
            },
            options=plain_options(self.options, spec.decides),
            inputs=self._inputs(spec),
            seconds=seconds,
            cpu_s=round(done.cpu_s, 3),
            peak_rss_mb=round(peak_mb, 1),
            warnings=tuple(dict.fromkeys(one.text for one in said if one.level == logging.WARNING)),
            result=result,
        )
        order = [other.name for other in self.table]
        self.record.put(finished)
        self.record.stages = tuple(sorted(self.record.stages, key=lambda s: order.index(s.name)))
        self.save()
        self.monitor.finished(spec.name, seconds, str(result))

    def _is_redone(self, spec: StageSpec, finished: StageRecord) -> bool:
        """Whether a finished stage was made from others than now, and is one to be done again."""
        if not spec.is_redone:
            return False
        now = (plain_options(self.options, spec.decides), self._inputs(spec), _names(spec.reads))
        return (finished.options, finished.inputs, finished.reads) != now

    def _inputs(self, spec: StageSpec) -> dict[str, str]:
        """Digests of what the options name that decide a stage's result, by path of the option.

        Not of ``fusion.workspace``, in which a run may write (``export.in_place``).
        """
        named, decides = inputs_of(self.options), plain_options(self.options, spec.decides)
        used = sorted((named.keys() & decides.keys()) - {"fusion.workspace"})
        for path in used:
            if path not in self._digests:
                self._digests[path] = digest_of(named[path])
        return {path: self._digests[path] for path in used}

    def forget(self, names: Collection[str]) -> None:
        """Forget stages and all stages made from their files, and delete their files.

        Raises
        ------
        DataError
            One of their folders has files that no run wrote; nothing is deleted.
        """
        self._delete(with_dependent(names, self.table))

    def take_out(self, names: Sequence[str], reasons: Sequence[str]) -> None:
        """Remove images from the model; stages that used them run again without them.

        Parameters
        ----------
        names : of the images.
        reasons : sentences for the record.
        """
        without = tuple(dict.fromkeys((*self.options.sfm.without, *names)))
        self.options = replace_option(self.options, "sfm.without", without)
        self.record.options = to_plain(self.options)
        self.record.notes = (*self.record.notes, *reasons)
        self.forget(["poses"])

    def _delete(self, stale: Sequence[StageSpec], remembered: StageRecord | None = None) -> None:
        """Delete the files of stages and their records, except the remembered ones."""
        paths = [self.run_folder.root / path for spec in stale for path in spec.writes]
        paths.append(self.run_folder.report)  # which shows them
        images = frozenset(self.record.images)
        for path in paths:
            if path.is_dir():
                require_own(path, images)
        self.record.forget(spec.name for spec in stale)
        if remembered is not None:
            self.record.put(remembered)
        self.save()  # before the files go: a stage that is recorded has its files
        discard(paths, images)

    def require_same_options(self, names: Collection[str]) -> None:
        """Refuse to reuse finished stages with other options.

        Raises
        ------
        OptionError
            An option differs (the message has both values), or a file of an option has changed.
        """
        for spec in self.table:
            finished = self.record.stage(spec.name)
            if finished is None or spec.name not in names or spec.is_redone:
                continue
            for path, now in plain_options(self.options, spec.decides).items():
                earlier = finished.options.get(path)
                if earlier != now:
                    raise OptionError(
                        f"is {show_value(now)} but the finished stage {spec.name!r} in "
                        f"{self.run_folder.root} used {show_value(earlier)}. Give the same value, "
                        "or `run.overwrite`.",
                        field=path,
                    )
            for path, digest in self._inputs(spec).items():
                if finished.inputs.get(path) != digest:
                    raise OptionError(
                        f"names what has changed since the finished stage {spec.name!r} in "
                        f"{self.run_folder.root} used it. Give the same files, or `run.overwrite`.",
                        field=path,
                    )

    def record_origin(self, identity: CaptureIdentity, command_line: Sequence[str]) -> None:
        """Record what the run is made of, with what options and versions."""
        record, capture = self.record, self.capture
        record.capture, record.images = identity, tuple(image_names(capture))
        record.notes, record.options = capture.notes, to_plain(self.options)
        record.command_line, record.versions = tuple(command_line), versions()

    def save(self, *, finished: bool = False) -> None:
        """Write ``run.json``."""
        now = time.perf_counter()
        self.record.wall_s = round(self.record.wall_s + now - self._started, 3)
        self._started = now
        self.record.finished = finished
        write_record(self.run_folder, self.record)


@dataclass(frozen=True)
class _Logged:
    """One log message: the name of its logger, the level and the text."""

    logger: str
    level: int
    text: str


@dataclass(frozen=True)
class _Done:
    """Finished work of a stage: its result, its duration, and messages of its process."""

    result: Any
    seconds: float
    cpu_s: float
    logged: Sequence[_Logged] = ()


class _Keeper(logging.Handler):
    """Collects messages."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.said: list[_Logged] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record."""
        self.said.append(_Logged(record.name, record.levelno, record.getMessage()))


@contextmanager
def _kept(level: int) -> Iterator[list[_Logged]]:
    """Log messages of this package in this block, from a level on."""
    keeper, package = _Keeper(level), logging.getLogger("polmvs")
    package.addHandler(keeper)
    try:
        yield keeper.said
    finally:
        package.removeHandler(keeper)


def _done_apart(token: str, call: Callable[[], Any]) -> _Done:
    """Run a stage in this process, a worker of the run with a token."""
    work_for(token)
    package = logging.getLogger("polmvs")
    package.setLevel(logging.INFO)
    package.propagate = False
    start, cpu_start = time.perf_counter(), cpu_seconds()
    with _kept(logging.INFO) as said, quiet_colmap():
        result = call()
    seconds, cpu_s = time.perf_counter() - start, cpu_seconds() - cpu_start
    return _Done(result, seconds, cpu_s, said)


@contextmanager
def open_run(
    job: Job,
    *,
    table: Sequence[StageSpec],
    min_images: int,
    taken_over: Collection[str],
    continues: bool = False,
) -> Iterator[Run]:
    """Check the input, prepare the run folder, and give the run.

    Nothing is written or deleted before all input is checked. No other run may use the folder at
    the same time.

    Parameters
    ----------
    job : from the user.
    table : all stages, in order.
    min_images : least number of images.
    taken_over : names of the stages that are reused if they are finished.
    continues : the folder must have a run, whose finished stages are kept for any ``run_options``.

    Raises
    ------
    DataError, OptionError
        The input or the run folder is unusable, or another run uses the folder.
    """
    monitor = job.monitor if job.monitor is not None else NoMonitor()
    run_options = job.run_options
    if run_options.scheduler is not None:  # whose workers have other working folders
        job = job.absolute()
    run_folder, others = RunFolder(job.out), list(inputs_of(job.options).values())
    for path in (job.capture, job.out, *others):
        require_unicode(path)
    require_apart(run_folder, capture=job.capture, others=others, written=written_names())
    overwrite, resume = run_options.overwrite and not continues, run_options.resume or continues
    with quiet_colmap():
        capture = open_capture(job.capture, job.options.capture)
        identity = identity_of(capture)
        if run_folder.run_file.is_file() and (run_options.resume or continues):
            require_same_capture(load_record(run_folder), identity, run_folder)
        plan = plan_memory(run_options.memory, run_options.workers, capture.width * capture.height)
        given_model = check_input(capture, job.options, min_images)
        if continues:
            load_record(run_folder)
        require_usable(run_folder, overwrite=overwrite, resume=resume)
    # Workers end before the lock: what they were at may be cleared away then.
    with (
        quiet_colmap(),
        locked(job.out),
        _workers(job, plan) as workers,
    ):
        record = prepare_output(run_folder, overwrite=overwrite, resume=resume)
        require_same_capture(record, identity, run_folder)
        run = Run(
            run_folder=run_folder,
            capture=capture,
            options=job.options,
            workers=workers,
            monitor=monitor,
            table=table,
            given_model=given_model,
            record=record,
            max_rows=plan.max_rows,
            budget_gb=run_options.memory,
        )
        run.require_same_options(taken_over)
        run.record_origin(identity, job.command_line)
        run.save()
        monitor.opened(run_folder)
        try:
            yield run
        except BaseException:
            with suppress(PolmvsError):  # the first error is the one to report
                run.save()
            raise


def _workers(job: Job, plan: MemoryPlan) -> Workers:
    """Processes here, or those of a cluster that sees what they need."""
    if job.run_options.scheduler is None:
        return Workers(plan.num_workers)
    existing = next(folder for folder in (job.out, *job.out.parents) if folder.is_dir())
    sources = [path for path in (job.capture, *inputs_of(job.options).values()) if path.exists()]
    tls = TlsFiles.of(job.run_options)
    return Workers.of_cluster(job.run_options.scheduler, [existing], sources, tls)


def load_record(run_folder: RunFolder) -> Record:
    """Read ``run.json``.

    Raises
    ------
    DataError
        It is missing, no record of a run, or one of another version.
    """
    return read_record(run_folder, result_types())


def load_run(run_folder: RunFolder) -> tuple[Record, Options]:
    """The record of a run and its options; errors as of :func:`load_record`."""
    record = load_record(run_folder)
    return record, options_from_plain(record.options, str(run_folder.run_file))


def dense_models(record: Record) -> tuple[AngleModel, ...]:
    """Models with a dense cloud in a run."""
    return tuple(m for m in AngleModel if record.find(DensifyResult, m) is not None)


def prepare_output(run_folder: RunFolder, *, overwrite: bool, resume: bool) -> Record:
    """Prepare the locked run folder, and give the initial record of the run.

    Parameters
    ----------
    overwrite : delete the results of an earlier run. Only files of polmvs are deleted.
    resume : keep them and continue.

    Raises
    ------
    OptionError
        The folder is not empty and neither option is given.
    DataError
        It cannot be created, or has files with names of results that no run of polmvs wrote.
    """
    occupied = require_usable(run_folder, overwrite=overwrite, resume=resume)
    if occupied and resume:
        return load_record(run_folder)
    if occupied:
        _remove_results(run_folder)
    return Record()


def require_usable(run_folder: RunFolder, *, overwrite: bool, resume: bool) -> bool:
    """Refuse a run folder with content that is neither reused nor deleted.

    Returns
    -------
    Whether it has content; unfinished files of a killed run do not count.

    Raises
    ------
    DataError, OptionError
        As :func:`prepare_output`; nothing is changed.
    """
    root = run_folder.root
    if not has_content(root, left_over_names(root)):
        return False
    if not (overwrite or resume):
        raise OptionError(
            f"{root}: exists and is not empty. Give `run.overwrite` to delete an earlier run in "
            "it, `run.resume` to go on with it, or another OUT."
        )
    for name in written_names():
        require_no_link(root / name)
    return True


def _remove_results(run_folder: RunFolder) -> None:
    """Delete what an earlier run wrote, of any version; other files stay."""
    root = run_folder.root
    present = [root / name for name in written_names() if os.path.lexists(root / name)]
    if not present:
        return
    if run_folder.run_file not in present:
        raise DataError(
            present[0],
            f"was not written by polmvs ({RUN_FILE} is missing) and is not overwritten. "
            "Give another OUT.",
        )
    images = read_image_names(run_folder)
    with as_data_error(root, "emptied"):
        discard(present, images)


def _names(paths: Iterable[Path]) -> tuple[str, ...]:
    return tuple(path.as_posix() for path in paths)
