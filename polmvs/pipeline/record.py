"""The record of a run, ``run.json``: finished stages, their results, and the machine."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from polmvs._version import __version__
from polmvs.cluster import PACKAGES, installed_versions
from polmvs.config import options_from_plain
from polmvs.errors import DataError, OptionError
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import from_json, parse_json, write_json
from polmvs.pipeline.run_folder import RUN_FILE, RunFolder
from polmvs.polarization.kinds import AngleModel

R = TypeVar("R")

# Of ``run.json``; to be raised with every change of the record or of what a stage gives.
# 1: the first releases, which did not name it. 2: stages with their results. 3: SfM as a stage of
# its own, trust, notes on the capture. 4: seeds are sparse points alone. 5: what stages wrote.
# 6: covariances of the poses. 7: what tells the content of the input, number of files.
# 8: views that a surface leaves out. 9: trust's verdict, and what it is told from. 10: silhouettes.
SCHEMA_VERSION = 10
POSE_STAGES = frozenset({"sfm", "poses"})  # nearly all of their time is COLMAP's


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """A finished stage.

    Attributes
    ----------
    name : of the stage.
    angle_model : its angle model; None for stages of all models.
    reads : its input, paths in the run folder.
    wrote : number of its files, by path in the run folder.
    options : values of the options that decided its result, by path, as JSON.
    inputs : digests of the files and folders of these options, by path of the option.
    is_lost : its files are missing and not yet made again. Results from them stay valid if they are
        made with the same options.
    seconds : wall time.
    cpu_s : processor time, see :func:`polmvs.memory.cpu_seconds`; not of a cluster's.
    peak_rss_mb : largest resident memory of the run's processes together during it, see
        :class:`polmvs.memory.PeakMemory`; not of a cluster's.
    warnings : its warnings.
    result : its result, of the type in the stage table.
    """

    name: str
    angle_model: AngleModel | None = None
    reads: tuple[str, ...] = ()
    wrote: Mapping[str, int] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    is_lost: bool = False
    seconds: float
    cpu_s: float
    peak_rss_mb: float
    warnings: tuple[str, ...] = ()
    result: Any = None


@dataclass(frozen=True, kw_only=True)
class CaptureIdentity:
    """Identity of a capture.

    Attributes
    ----------
    folder : of the raw mosaics.
    width, height : of the polarization images, px.
    digests : of each file's content, by its path in the folder.
    """

    folder: Path
    width: int
    height: int
    digests: Mapping[str, str]

    def is_same(self, other: CaptureIdentity) -> bool:
        """Whether the images are the same, in any folder."""
        mine, others = (self.width, self.height), (other.width, other.height)
        return mine == others and self.digests == other.digests


@dataclass(kw_only=True)
class Record:
    """Content of ``run.json``.

    Attributes
    ----------
    schema_version : of the file.
    command_line : of the last call; empty for a script.
    capture : identity of its images.
    images : names of the files in ``images/``.
    notes : what was recognized and decided about the capture, one line each.
    options : resolved options of the last call, as JSON.
    versions : of the software.
    stages : finished ones, in order.
    wall_s : seconds of all calls together.
    finished : whether the last call completed.
    """

    schema_version: int = SCHEMA_VERSION
    command_line: tuple[str, ...] = ()
    capture: CaptureIdentity | None = None
    images: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    stages: tuple[StageRecord, ...] = ()
    wall_s: float = 0.0
    finished: bool = False

    def stage(self, name: str) -> StageRecord | None:
        """A finished stage by its name."""
        return next((stage for stage in self.stages if stage.name == name), None)

    def forget(self, names: Iterable[str]) -> None:
        """Remove stages that must run again."""
        dropped = set(names)
        self.stages = tuple(stage for stage in self.stages if stage.name not in dropped)

    def put(self, stage: StageRecord) -> None:
        """Record a stage, replacing its former record."""
        self.forget([stage.name])
        self.stages = (*self.stages, stage)

    def find(self, kind: type[R], model: AngleModel | None = None) -> R | None:
        """Result of the finished stage with this result type; None if it is not finished.

        Parameters
        ----------
        kind : type of the result; each belongs to one stage, or to one stage of each angle model.
        model : angle model of the stage, if it has one.
        """
        for stage in self.stages:
            if isinstance(stage.result, kind) and stage.angle_model is model:
                return stage.result
        return None

    def result(self, kind: type[R], model: AngleModel | None = None) -> R:
        """As :meth:`find`; KeyError if the stage is not finished."""
        found = self.find(kind, model)
        if found is None:
            raise KeyError(f"no stage with a {kind.__name__} {model or ''} is finished")
        return found


def write_record(run_folder: RunFolder, record: Record) -> None:
    """Write ``run.json``."""
    write_json(run_folder.run_file, record)


def read_record(run_folder: RunFolder, result_types: Mapping[str, type]) -> Record:
    """Read ``run.json``.

    Parameters
    ----------
    result_types : type of the result of each stage by its name.

    Raises
    ------
    DataError
        It is missing, no record of a run, or one of another version.
    """
    content = _read_current(run_folder)
    try:
        record = from_json(Record, content)
        record.stages = tuple(_with_result(stage, result_types) for stage in record.stages)
    except ValueError as error:
        raise _no_record(run_folder, error) from error
    return record


def _with_result(stage: StageRecord, result_types: Mapping[str, type]) -> StageRecord:
    if stage.name not in result_types:
        raise ValueError(f"its stage {stage.name!r} is unknown")
    result: Any = from_json(result_types[stage.name], stage.result, f"{stage.name}.result")
    return StageRecord(**{**vars(stage), "result": result})


def read_options(run_folder: RunFolder) -> Mapping[str, Any]:
    """Options of the run in a folder, as JSON; empty if no stage is finished.

    Raises
    ------
    DataError
        ``run.json`` is no record of a run, or one of another version.
    """
    if not run_folder.run_file.is_file():
        return {}
    content = _read_current(run_folder)
    options = content.get("options")
    if not isinstance(options, dict):
        raise _no_record(run_folder, "it has no options")
    try:
        options_from_plain(options, RUN_FILE)
    except OptionError as error:
        raise _no_record(run_folder, error) from error
    return options if content["stages"] else {}


def is_finished(run_folder: RunFolder, stage: str) -> bool:
    """Whether a run's record lists a stage as finished."""
    if not run_folder.run_file.is_file():
        return False
    stages = _read_current(run_folder)["stages"]
    return any(isinstance(one, dict) and one.get("name") == stage for one in stages)


def read_image_names(run_folder: RunFolder) -> frozenset[str]:
    """Names of the files in ``images/``, from a record of any version.

    Raises
    ------
    DataError
        ``run.json`` is no record of a run.
    """
    images = _read_content(run_folder).get("images")
    if not isinstance(images, list):
        raise _no_record(run_folder, "it names no images")
    return frozenset(map(str, images))


def _read_current(run_folder: RunFolder) -> dict[str, Any]:
    """Content of a ``run.json`` of this version."""
    content = _read_content(run_folder)
    if not isinstance(content.get("stages"), list):
        raise _no_record(run_folder, "it lists no stages")
    found = content.get("schema_version", 1)
    if found != SCHEMA_VERSION:
        versions = content.get("versions")
        program = versions.get("polmvs", "unknown") if isinstance(versions, dict) else "unknown"
        raise DataError(
            run_folder.root,
            f"holds a run of polmvs {program}, whose {RUN_FILE} has schema version {found}; this "
            f"is polmvs {__version__}, which reads version {SCHEMA_VERSION} and cannot go on with "
            "it. Give another OUT, or begin anew there: reconstruct or compare with "
            "`run.overwrite` delete that run.",
        )
    return content


def _read_content(run_folder: RunFolder) -> dict[str, Any]:
    try:
        content = parse_json(read_text(run_folder.run_file))
    except FileNotFoundError as error:
        raise DataError(
            run_folder.root, f"holds no run of polmvs ({RUN_FILE} is missing)."
        ) from error
    except (OSError, ValueError) as error:
        raise _no_record(run_folder, error) from error
    if not isinstance(content, dict):
        raise _no_record(run_folder, "it is no table")
    return content


def _no_record(run_folder: RunFolder, why: object) -> DataError:
    return DataError(run_folder.run_file, f"is no record of a run ({why}). Give another OUT.")


# The machine and the software


def versions() -> dict[str, str]:
    """Versions of Python, this package and its dependencies."""
    installed = installed_versions((*PACKAGES, "open3d"))
    return {"python": platform.python_version(), **installed}
