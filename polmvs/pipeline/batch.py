"""Reconstruction of a list of captures, in sequence or in parallel, with one table.

A capture is one task (:mod:`polmvs.parallel`) with its own process on this machine, or a worker of
a cluster. A failed capture does not stop the others.
"""

from __future__ import annotations

import csv
import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

from polmvs.cluster import TlsFiles
from polmvs.config import (
    FieldInfo,
    Options,
    PairChoice,
    RunOptions,
    describe_fields,
    groups_of,
    in_table,
    require_table,
    values_from_plain,
    with_absolute_paths,
)
from polmvs.errors import DataError, OptionError, PolmvsError, as_data_error
from polmvs.evaluation.tables import format_table, number
from polmvs.io.images import write_bytes
from polmvs.io.plain_files import parse_toml, read_list
from polmvs.io.typed_json import from_json, parse_json, write_json
from polmvs.parallel import Workers
from polmvs.pipeline.jobs import JobOutcome, reconstruct
from polmvs.pipeline.log_format import LogFormatter
from polmvs.pipeline.run_folder import RunFolder, has_content
from polmvs.pipeline.runner import Job, NoMonitor
from polmvs.pipeline.stages.densify import DensifyResult
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.polarization.kinds import AngleModel

logger = logging.getLogger(__name__)

FOLDER = ("folder", "capture")  # names of the column with a capture's folder
TABLE_FILE, JSON_FILE = "batch.md", "batch.json"
LOST = "its worker was lost: out of memory? Give `run.workers` 1, or workers more memory."


@dataclass(frozen=True, kw_only=True)
class BatchEntry:
    """One capture of a list.

    Attributes
    ----------
    name : name of its folder in OUT.
    capture : folder.
    angle_model : of its reconstruction.
    options : of all stages.
    """

    name: str
    capture: Path
    angle_model: AngleModel
    options: Options


class State(StrEnum):
    """State of a capture."""

    FINISHED = "finished"
    EMPTY = "empty"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class BatchRow:
    """Result of one capture of a list.

    Attributes
    ----------
    name, capture : as in the list.
    state : ``empty`` is a finished run whose cloud has no points.
    num_images, num_views : images of the capture, and those with a pose.
    num_tracks, num_points : sparse and dense points.
    seconds : of all calls.
    peak_rss_mb : the largest of its stages.
    message : why there is no cloud with points.
    """

    name: str
    capture: Path
    state: State
    num_images: int = 0
    num_views: int = 0
    num_tracks: int = 0
    num_points: int = 0
    seconds: float = 0.0
    peak_rss_mb: float = 0.0
    message: str = ""


def read_batch(
    path: Path, options: Options, angle_model: AngleModel = AngleModel.PPA
) -> tuple[BatchEntry, ...]:
    """Captures of a list, a TOML or CSV file; paths in it are relative to its folder.

    TOML: a table ``[[captures]]`` for each capture with its ``folder``, ``name`` (by default that
    of the folder), ``model``, and tables of options by group. CSV: a header with ``folder`` and
    optionally ``name``, ``model`` and options as ``group.name``, and a line for each capture; an
    empty cell means not given. The key ``capture`` may replace ``folder`` if no option of the group
    of this name is given.

    Parameters
    ----------
    path : of the list.
    options, angle_model : defaults for the list.

    Raises
    ------
    DataError
        The list cannot be read or is empty, or a capture's folder is missing.
    OptionError
        A key or value is unusable, or a name occurs twice.
    """
    text = read_list(path, "captures", "utf-8-sig")
    suffix = path.suffix.lower()
    if suffix not in (".toml", ".csv"):
        raise DataError(path, "is no list of captures: its name must end in .toml or .csv.")
    tables = _toml_tables(path, text) if suffix == ".toml" else _csv_tables(path, text)
    if not tables:
        raise DataError(path, "lists no captures.")
    entries = [
        _entry(table, f"{path}: {where}", path.absolute().parent, options, angle_model)
        for where, table in tables
    ]
    seen: dict[str, str] = {}
    for entry in entries:
        if entry.name.casefold() in (TABLE_FILE, JSON_FILE):
            raise OptionError(
                f"{path}: a capture cannot be named {entry.name!r}, as a file in OUT is; give it "
                "another `name`."
            )
        if entry.name.casefold() in seen:  # some systems do not distinguish them
            raise OptionError(f"{path}: two captures are named {entry.name!r}; give `name`s.")
        seen[entry.name.casefold()] = entry.name
    for entry in entries:
        try:
            there = entry.capture.is_dir()
        except OSError as error:  # a name longer than the system has
            raise DataError(path, f"lists a folder that cannot be: {error.strerror}.") from error
        if not there:
            raise DataError(entry.capture, f"no such folder; {path} lists it as {entry.name!r}.")
    return tuple(entries)


def run_batch(
    entries: Sequence[BatchEntry],
    out: Path,
    run_options: RunOptions,
    on_done: Callable[[BatchRow], None] = lambda row: None,
) -> list[BatchRow]:
    """Reconstruct captures, each into ``OUT/NAME``, and update ``OUT/batch.md`` and ``.json``.

    Captures of an earlier list in OUT keep their rows.

    Parameters
    ----------
    entries : from :func:`read_batch`.
    out : folder of all runs.
    run_options : ``workers`` processes are divided among the captures, at least one for each; with
        ``scheduler`` each capture is one task of the cluster.
    on_done : called for each capture, in the list's order.

    Raises
    ------
    OptionError
        A capture's folder in OUT is not empty, and neither ``overwrite`` nor ``resume`` is given.
    DataError
        OUT cannot be created, its ``batch.json`` is not of a batch, or the cluster is unusable.

    Returns
    -------
    The rows of these captures.
    """
    out = out.absolute()
    earlier = _earlier_rows(out, entries)
    for entry in entries:
        folder = out / entry.name
        if has_content(folder) and not (run_options.overwrite or run_options.resume):
            raise OptionError(
                f"{folder}: exists and is not empty. Give `run.overwrite` to delete earlier runs "
                "in it, `run.resume` to go on with them, or another OUT."
            )
    with as_data_error(out, "made"):
        out.mkdir(parents=True, exist_ok=True)
    each = replace(run_options, workers=1, scheduler=None, tls_ca=None, tls_cert=None, tls_key=None)
    if run_options.scheduler is not None:
        captures = [entry.capture for entry in entries]
        tls = TlsFiles.of(run_options)
        workers = Workers.of_cluster(run_options.scheduler, [out], captures, tls)
    else:
        num_beside = min(run_options.workers, len(entries))
        each = replace(each, workers=run_options.workers // num_beside)
        workers = Workers(num_beside)
    rows: list[BatchRow] = []
    with workers:
        outcomes = workers.outcomes(partial(_run_one, out, each), entries)
        for entry, outcome in zip(entries, outcomes, strict=True):
            rows.append(row_of(entry, outcome))
            everything = [*earlier, *rows]
            write_json(out / JSON_FILE, everything)
            write_bytes(out / TABLE_FILE, f"{batch_table(everything)}\n".encode())
            on_done(rows[-1])
    return rows


def batch_table(rows: Sequence[BatchRow]) -> str:
    """One table of all captures."""
    header = ["capture", "state", "views", "sparse", "points", "s", "peak MB", "why"]
    cells = [
        [
            row.name,
            row.state,
            f"{row.num_views} of {row.num_images}",
            f"{row.num_tracks:,}",
            f"{row.num_points:,}",
            number(row.seconds, digits=1),
            number(row.peak_rss_mb, digits=0),
            row.message.replace("|", "\\|"),
        ]
        for row in rows
    ]
    return format_table(header, cells)


def _earlier_rows(out: Path, entries: Sequence[BatchEntry]) -> list[BatchRow]:
    """Rows of captures in OUT that are not of this list."""
    path = out / JSON_FILE
    if not path.is_file():
        return []
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
        rows = from_json(tuple[BatchRow, ...], content)
    except (OSError, ValueError) as error:
        raise DataError(path, f"is no table of a batch ({error}). Give another OUT.") from error
    names = {entry.name.casefold() for entry in entries}
    return [row for row in rows if row.name.casefold() not in names and (out / row.name).is_dir()]


class _LogMonitor(NoMonitor):
    """Writes what happens into the run's log."""

    def __init__(self) -> None:
        self.handler: logging.Handler | None = None

    def opened(self, run_folder: RunFolder) -> None:
        """Begin."""
        self.handler = logging.FileHandler(run_folder.log, encoding="utf-8")
        self.handler.setFormatter(LogFormatter())
        logging.getLogger("polmvs").addHandler(self.handler)

    def close(self) -> None:
        """End."""
        if self.handler is not None:
            logging.getLogger("polmvs").removeHandler(self.handler)
            self.handler.close()


def _run_one(out: Path, run_options: RunOptions, entry: BatchEntry) -> BatchRow:
    """Reconstruct one capture; errors are reported, not raised."""
    package = logging.getLogger("polmvs")
    if package.getEffectiveLevel() > logging.INFO:  # a worker's, which no terminal has set
        package.setLevel(logging.INFO)
    monitor = _LogMonitor()
    job = Job(
        capture=entry.capture,
        out=out / entry.name,
        options=entry.options,
        run_options=run_options,
        monitor=monitor,
        command_line=("polmvs", "batch", entry.name),
    )
    try:
        return _finished(entry, reconstruct(job, entry.angle_model))
    except PolmvsError as error:
        logger.error("%s", error)
        return _failed(entry, str(error))
    except Exception as error:
        logger.exception("internal error")
        return _failed(entry, f"internal error: {type(error).__name__}: {error}")
    finally:
        monitor.close()


def row_of(entry: BatchEntry, outcome: Callable[[], BatchRow]) -> BatchRow:
    """Row of a capture; an error or a lost process also makes a row."""
    try:
        return outcome()
    except BrokenProcessPool:
        return _failed(entry, LOST)
    except (PolmvsError, OSError) as error:
        return _failed(entry, str(error))


def _finished(entry: BatchEntry, outcome: JobOutcome) -> BatchRow:
    poses = outcome.record.result(PosesResult)
    return BatchRow(
        name=entry.name,
        capture=entry.capture,
        state=State.FINISHED if outcome.empty is None else State.EMPTY,
        num_images=len(outcome.record.images),
        num_views=poses.num_views,
        num_tracks=poses.num_tracks,
        num_points=outcome.record.result(DensifyResult, entry.angle_model).num_points,
        seconds=outcome.record.wall_s,
        peak_rss_mb=max(stage.peak_rss_mb for stage in outcome.record.stages),
        message=outcome.empty or "",
    )


def _failed(entry: BatchEntry, message: str) -> BatchRow:
    return BatchRow(
        name=entry.name,
        capture=entry.capture,
        state=State.FAILED,
        message=" ".join(message.split()),
    )


# Lists


def _toml_tables(path: Path, text: str) -> list[tuple[str, dict[str, Any]]]:
    try:
        content = parse_toml(text)
    except ValueError as error:  # of the parser, or an integer of thousands of digits
        hint = ""
        if re.search(r"^\s*\[captures\.capture\]", text, re.MULTILINE):
            hint = " Name the folder of a capture 'folder' where it has a table [captures.capture]."
        raise DataError(path, f"is no TOML file ({error}).{hint}") from error
    listed = content.pop("captures", [])
    if content or not isinstance(listed, list) or not all(isinstance(t, dict) for t in listed):
        found = next(iter(content), "captures")
        raise OptionError(f"{path}: {found!r} is none of its tables, which are [[captures]].")
    return [(f"capture {number}", table) for number, table in enumerate(listed, start=1)]


def _csv_tables(path: Path, text: str) -> list[tuple[str, dict[str, Any]]]:
    reader = csv.DictReader(text.splitlines(), restkey="", skipinitialspace=True)
    infos = {
        info.path: info for cls in groups_of(Options).values() for info in describe_fields(cls)
    }
    known = {*FOLDER, "name", "model", *infos}
    for column in reader.fieldnames or ():
        if column not in known:
            raise OptionError(
                f"{path}: unknown column {column!r}; columns are folder, name, model, and options "
                "as group.name such as sfm.intrinsics."
            )
    tables = []
    for row in reader:
        where = f"line {reader.line_num}"
        if "" in row:
            raise OptionError(f"{path}: {where}: has more cells than the header.")
        table: dict[str, Any] = {}
        for column, cell in row.items():
            if not cell:
                continue
            group, _, name = column.partition(".")
            if column in FOLDER:
                if "folder" in table:
                    raise OptionError(f"{path}: {where}: names its folder twice.")
                table["folder"] = cell
            elif not name:
                table[column] = cell
            else:
                value = _value_of(infos[column], cell, f"{path}: {where}")
                table.setdefault(group, {})[name] = value
        tables.append((where, table))
    return tables


def _value_of(info: FieldInfo, cell: str, where: str) -> Any:
    """A cell as TOML would have it."""
    try:
        if info.kind is bool:
            return {"yes": True, "no": False, "true": True, "false": False}[cell.lower()]
        if info.kind in (int, float):
            return info.kind(cell)
        if getattr(info.kind, "__origin__", None) is tuple:
            kinds = info.kind.__args__
            return [
                (kinds[0] if Ellipsis in kinds else kind)(part.strip())
                for part, kind in zip(cell.split(","), kinds * len(cell), strict=False)
            ]
    except (KeyError, ValueError, TypeError) as error:
        raise OptionError(f"{where}: {info.path} cannot be {cell!r}.") from error
    return cell


def _entry(
    table: Mapping[str, Any], where: str, base: Path, options: Options, angle_model: AngleModel
) -> BatchEntry:
    """A capture of a list from its table."""
    table = dict(table)
    if "folder" not in table and isinstance(table.get("capture"), str):
        table["folder"] = table.pop("capture")
    capture, name, model = (table.pop(key, None) for key in ("folder", "name", "model"))
    if not isinstance(capture, str):
        raise OptionError(f"{where}: needs a 'folder', that of a capture.")
    folder = Path(os.path.normpath(base / capture))
    name = folder.name if name is None else name
    if not isinstance(name, str) or Path(name).name != name or name in ("", ".", ".."):
        raise OptionError(f"{where}: the name {name!r} cannot be that of a folder.")
    if model is not None and model not in set(AngleModel):
        raise OptionError(f"{where}: model must be one of {', '.join(AngleModel)}, not {model!r}.")
    groups = groups_of(Options)
    made: dict[str, Any] = {}
    for group, values in table.items():
        require_table(group, values, groups, where)
        given = values_from_plain(groups[group], values, where)
        for key, value in given.items():
            if isinstance(value, Path):
                given[key] = base / value
            elif (group, key) == ("sfm", "pairs") and value not in set(PairChoice):
                given[key] = str(base / value)
        try:
            made[group] = replace(getattr(options, group), **given)
        except OptionError as error:
            raise in_table(error, where) from error
    return BatchEntry(
        name=name,
        capture=folder,
        angle_model=AngleModel(model or angle_model),
        options=with_absolute_paths(replace(options, **made)),
    )
