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

from polmvs.capture import Capture, open_capture
from polmvs.colmap_io import SparseModel
from polmvs.config import Model, Options, RunOptions
from polmvs.errors import DataError, OptionError, PolmvsError
from polmvs.groundtruth import open_ground_truth
from polmvs.image_io import read_mask
from polmvs.option_values import to_plain
from polmvs.parallel import Workers
from polmvs.runtime import peak_rss_mb, versions
from polmvs.sfm import check_intrinsics
from polmvs.stages import find_mask, fit_model, image_names
from polmvs.workspace import Record, StageRecord, Workspace, prepare_output, require_apart

logger = logging.getLogger(__name__)

Report = Callable[[int], None]
Facts = dict[str, Any]

EVALUATE = "evaluate"
POSES = ("sfm", "sparse")  # two ways to the same files


def normals_stage(model: Model) -> str:
    """Name of the stage of the track normals; PPA's is the first and selects the seeds."""
    return "normals" if model is Model.PPA else f"normals_{model}"


def densify_stage(model: Model) -> str:
    """Name of the stage of the dense cloud."""
    return f"densify_{model}"


# Stages by what they follow, and the groups of options that decide their results.
STAGE_OPTIONS: dict[str, tuple[str, ...]] = {
    "capture": ("capture",),
    **{name: ("sfm",) for name in POSES},
    "maps": ("region",),
    normals_stage(Model.PPA): ("normals",),
    **{normals_stage(model): ("normals",) for model in Model},
    **{densify_stage(model): ("propagation", "fusion") for model in Model},
    EVALUATE: ("evaluation",),
}
STAGE_RANK = {
    "capture": 0,
    **dict.fromkeys(POSES, 1),
    "maps": 2,
    **{normals_stage(model): 4 for model in Model},
    normals_stage(Model.PPA): 3,
    **{densify_stage(model): 5 for model in Model},
    EVALUATE: 6,
}


class Monitor(Protocol):
    """Who watches a run."""

    def opened(self, workspace: Workspace) -> None:
        """The output folder is ready."""

    def stage(self, name: str, total: int | None) -> AbstractContextManager[Report]:
        """A stage begins; the report is called with the number of steps done."""


class Silence:
    """Nobody watches."""

    def opened(self, workspace: Workspace) -> None:
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

    workspace: Workspace
    capture: Capture
    options: Options
    workers: Workers
    monitor: Monitor
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
            if not self.record.is_done(*_alternatives(name)):
                raise DataError(
                    self.workspace.root,
                    f"its stage {name!r} is not finished, which {stage.name!r} reads. "
                    f"Run 'polmvs {_command_of(name)}' first.",
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
        rank = STAGE_RANK[name]
        names = [n for n, r in STAGE_RANK.items() if r > rank or n in _alternatives(name)]
        self.record.forget(names)
        self.save()
        for forgotten in names:
            for path in self.workspace.files_of(forgotten):
                path.unlink(missing_ok=True)

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
    monitor: Monitor | None = None,
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
    workspace = Workspace(out)
    require_apart(workspace, capture=capture_folder, others=_inputs(options))
    capture = open_capture(capture_folder, options.capture)
    given_model = _check_input(capture, options, min_images)
    if goes_on:
        workspace.load()
    record = prepare_output(
        workspace,
        overwrite=how.overwrite and not goes_on,
        resume=how.resume or goes_on,
    )
    identity = _identity(capture)
    _require_same_capture(record, identity, workspace)
    _require_same_options(record, options, uses, workspace)
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


def _command_of(name: str) -> str:
    """The command that does a stage alone."""
    if STAGE_RANK[name] <= STAGE_RANK["sfm"]:
        return "sfm"
    return "normals" if STAGE_RANK[name] < STAGE_RANK[densify_stage(Model.PPA)] else "densify"


def _alternatives(name: str) -> tuple[str, ...]:
    return POSES if name in POSES else (name,)


def _inputs(options: Options) -> list[Path]:
    """Folders that are read beside the capture."""
    paths = (options.sfm.sparse, options.region.mask, options.evaluation.gt)
    return [path for path in paths if path is not None]


def _identity(capture: Capture) -> dict[str, Any]:
    """What tells this capture from another one, as in ``run.json``."""
    return {
        "folder": str(capture.folder.absolute()),
        "width": capture.width,
        "height": capture.height,
        "bytes": {path.name: path.stat().st_size for path in capture.paths},
    }


def _check_input(capture: Capture, options: Options, min_images: int) -> SparseModel | None:
    """All that can be known to be wrong before the work begins; gives the model of ``--sparse``."""
    num_images = len(image_names(capture))
    if num_images < min_images:
        raise DataError(
            capture.folder,
            f"holds {num_images} image{'s' * (num_images != 1)}; {min_images} or more are needed, "
            "better ten: views of the part from all around.",
        )
    if options.region.mask is not None:
        for image in image_names(capture):
            read_mask(find_mask(options.region.mask, image), (capture.height, capture.width))
    if options.evaluation.gt is not None:
        open_ground_truth(options.evaluation.gt)
    if options.sfm.sparse is not None:
        return fit_model(capture, options.sfm.sparse)
    if options.sfm.intrinsics is not None:
        check_intrinsics(options.sfm.intrinsics, capture.width, capture.height)
    return None


def _require_same_capture(record: Record, identity: dict[str, Any], workspace: Workspace) -> None:
    """Finished stages must be of this capture."""
    same = all(record.capture.get(key) == identity[key] for key in ("width", "height", "bytes"))
    if record.stages and not same:
        raise DataError(
            workspace.root,
            f"holds a run of another capture ({record.capture.get('folder')}), or its images have "
            "changed. Give another OUT, or --overwrite.",
        )


def _require_same_options(
    record: Record, options: Options, uses: Collection[str], workspace: Workspace
) -> None:
    """Finished stages that are taken over must be of these options."""
    for stage in record.stages:
        if stage.name not in uses:
            continue
        before = record.stage_options.get(stage.name, {})
        for group, now in options_of(stage.name, options).items():
            for key, value in now.items():
                earlier = before.get(group, {}).get(key)
                if earlier != value:
                    flag = "--" + key.replace("_", "-")
                    raise OptionError(
                        f"{flag} is {_text(value)} but the finished stage {stage.name!r} in "
                        f"{workspace.root} used {_text(earlier)}. Give the same value, or "
                        "--overwrite."
                    )


def options_of(stage: str, options: Options) -> dict[str, Any]:
    """Options that decide the result of a stage, by group, in terms of JSON."""
    return {group: to_plain(getattr(options, group)) for group in STAGE_OPTIONS[stage]}


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(str(item) for item in value)
    return "not set" if value is None else str(value)
